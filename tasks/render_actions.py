"""`render_actions`: project the controls into every view: action tracks and overlay previews."""

from __future__ import annotations

from tasks.artifact_task import artifact_task
from tasks.command_line import run_task_command

render_actions = artifact_task("render_actions")


def main() -> None:
    """Run this step alone, without a Prefect server."""
    run_task_command("render_actions")


if __name__ == "__main__":
    main()
