"""`import_rollouts`: any folder of predicted videos as a set of rollouts, every file accounted for."""

from __future__ import annotations

from tasks.artifact_task import artifact_task
from tasks.command_line import run_task_command

import_rollouts = artifact_task("import_rollouts")


def main() -> None:
    """Run this step alone, without a Prefect server."""
    run_task_command("import_rollouts")


if __name__ == "__main__":
    main()
