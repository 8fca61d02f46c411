"""`evaluate_planning`: bracket selection among candidate controls, success of the choice."""

from __future__ import annotations

from tasks.artifact_task import artifact_task
from tasks.command_line import run_task_command

evaluate_planning = artifact_task("evaluate_planning")


def main() -> None:
    """Run this step alone, without a Prefect server."""
    run_task_command("evaluate_planning")


if __name__ == "__main__":
    main()
