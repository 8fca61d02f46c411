"""`evaluate_video`: PSNR, SSIM, LPIPS, robot-mask and object IoU."""

from tasks.execution.artifact_task import ArtifactTask

evaluate_video = ArtifactTask(
    name="evaluate_video",
    version=13,
    function="worldline_core.evaluation.video.evaluate_video:evaluate_video",
    config="worldline_core.evaluation.evaluation_config:VideoEvaluationConfig",
    inputs=("episodes", "rollouts.*"),
    optional_inputs=("tracks", "segmenter"),
)

if __name__ == "__main__":
    evaluate_video.main()
