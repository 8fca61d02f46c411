"""`evaluate_video`: PSNR, SSIM, LPIPS and robot-mask IoU."""

from tasks.artifact_task import artifact_task

evaluate_video = artifact_task("evaluate_video")

if __name__ == "__main__":
    evaluate_video.main()
