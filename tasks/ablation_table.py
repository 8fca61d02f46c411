"""`ablation_table`: the paper's ablations as one table beside the paper's numbers."""

from __future__ import annotations

from tasks.artifact_task import artifact_task
from tasks.command_line import run_task_command

ablation_table = artifact_task("ablation_table")


def main() -> None:
    """Run this step alone, without a Prefect server."""
    run_task_command("ablation_table")


if __name__ == "__main__":
    main()
