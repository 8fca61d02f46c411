"""`estimate_cameras`: uncalibrated cameras, estimated from the recorded episodes alone."""

from tasks.execution.artifact_task import ArtifactTask

estimate_cameras = ArtifactTask(
    name="estimate_cameras",
    version=10,
    function="worldline_core.calibration.estimate.estimate:estimate_cameras",
    config="worldline_core.calibration.estimate.estimate_config:EstimateConfig",
    optional_inputs=("source.*",),
)

if __name__ == "__main__":
    estimate_cameras.main()
