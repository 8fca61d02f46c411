"""`record`: simulated robots, scenes and scripted controllers into an EpisodeSet."""

from tasks.execution.artifact_task import ArtifactTask

record = ArtifactTask(
    name="record",
    version=2,
    function="worldline_core.recorder.attempts:record_artifact",
    config="worldline_core.recorder.attempts:RecordingConfig",
)

if __name__ == "__main__":
    record.main()
