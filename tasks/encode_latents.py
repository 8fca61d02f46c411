"""`encode_latents`: cache the video tokenizer's latents."""

from __future__ import annotations

from tasks.artifact_task import artifact_task
from tasks.command_line import run_task_command

encode_latents = artifact_task("encode_latents")


def main() -> None:
    """Run this step alone, without a Prefect server."""
    run_task_command("encode_latents")


if __name__ == "__main__":
    main()
