"""`distill`: Stage III: teacher forcing, trajectory regression, distribution matching."""

from __future__ import annotations

from tasks.artifact_task import artifact_task
from tasks.command_line import run_task_command

distill = artifact_task("distill")


def main() -> None:
    """Run this step alone, without a Prefect server."""
    run_task_command("distill")


if __name__ == "__main__":
    main()
