"""`curate`: read recordings of any source into one EpisodeSet."""

from __future__ import annotations

from tasks.artifact_task import artifact_task
from tasks.command_line import run_task_command

curate = artifact_task("curate")


def main() -> None:
    """Run this step alone, without a Prefect server."""
    run_task_command("curate")


if __name__ == "__main__":
    main()
