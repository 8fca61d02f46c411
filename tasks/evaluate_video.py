"""`evaluate_video`: PSNR, SSIM, LPIPS and robot-mask IoU."""

from __future__ import annotations

from tasks.artifact_task import artifact_task
from tasks.command_line import run_task_command

evaluate_video = artifact_task("evaluate_video")


def main() -> None:
    """Run this step alone, without a Prefect server."""
    run_task_command("evaluate_video")


if __name__ == "__main__":
    main()
