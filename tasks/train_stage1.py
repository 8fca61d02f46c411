"""`train_stage1`: Stage I: action-free, text-conditioned video prediction."""

from __future__ import annotations

from tasks.artifact_task import artifact_task
from tasks.command_line import run_task_command

train_stage1 = artifact_task("train_stage1")


def main() -> None:
    """Run this step alone, without a Prefect server."""
    run_task_command("train_stage1")


if __name__ == "__main__":
    main()
