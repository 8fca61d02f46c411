"""`import_backbone`: turn pretrained Cosmos3 weights into the base checkpoint."""

from __future__ import annotations

from tasks.artifact_task import artifact_task
from tasks.command_line import run_task_command

import_backbone = artifact_task("import_backbone")


def main() -> None:
    """Run this step alone, without a Prefect server."""
    run_task_command("import_backbone")


if __name__ == "__main__":
    main()
