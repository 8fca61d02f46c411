"""`train_teacher`: train the small relational teacher of the embedded default."""

from __future__ import annotations

from tasks.artifact_task import artifact_task
from tasks.command_line import run_task_command

train_teacher = artifact_task("train_teacher")


def main() -> None:
    """Run this step alone, without a Prefect server."""
    run_task_command("train_teacher")


if __name__ == "__main__":
    main()
