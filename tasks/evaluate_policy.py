"""`evaluate_policy`: evidence, rules, accuracy against the recorded outcome."""

from __future__ import annotations

from tasks.artifact_task import artifact_task
from tasks.command_line import run_task_command

evaluate_policy = artifact_task("evaluate_policy")


def main() -> None:
    """Run this step alone, without a Prefect server."""
    run_task_command("evaluate_policy")


if __name__ == "__main__":
    main()
