"""`report`: one static page with tables, plots and videos."""

from __future__ import annotations

from tasks.artifact_task import artifact_task
from tasks.command_line import run_task_command

report = artifact_task("report")


def main() -> None:
    """Run this step alone, without a Prefect server."""
    run_task_command("report")


if __name__ == "__main__":
    main()
