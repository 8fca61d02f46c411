"""`rollout`: predict videos from a first observation and controls."""

from __future__ import annotations

from tasks.artifact_task import artifact_task
from tasks.command_line import run_task_command

rollout = artifact_task("rollout")


def main() -> None:
    """Run this step alone, without a Prefect server."""
    run_task_command("rollout")


if __name__ == "__main__":
    main()
