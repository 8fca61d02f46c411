"""`train_tokenizer`: fit the small video tokenizer of the embedded default."""

from __future__ import annotations

from tasks.artifact_task import artifact_task
from tasks.command_line import run_task_command

train_tokenizer = artifact_task("train_tokenizer")


def main() -> None:
    """Run this step alone, without a Prefect server."""
    run_task_command("train_tokenizer")


if __name__ == "__main__":
    main()
