"""`filter`: drop static, reset, corrupted, moving-base, misaligned and badly calibrated segments."""

from __future__ import annotations

from tasks.artifact_task import artifact_task
from tasks.command_line import run_task_command

filter_episodes = artifact_task("filter")


def main() -> None:
    """Run this step alone, without a Prefect server."""
    run_task_command("filter")


if __name__ == "__main__":
    main()
