"""`train_stage2`: Stage II: action-driven three-view prediction on successes and failures."""

from __future__ import annotations

from tasks.artifact_task import artifact_task
from tasks.command_line import run_task_command

train_stage2 = artifact_task("train_stage2")


def main() -> None:
    """Run this step alone, without a Prefect server."""
    run_task_command("train_stage2")


if __name__ == "__main__":
    main()
