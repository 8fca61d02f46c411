"""`train_segmenter`: train the small robot segmenter of the embedded default."""

from __future__ import annotations

from tasks.artifact_task import artifact_task
from tasks.command_line import run_task_command

train_segmenter = artifact_task("train_segmenter")


def main() -> None:
    """Run this step alone, without a Prefect server."""
    run_task_command("train_segmenter")


if __name__ == "__main__":
    main()
