"""`train_teacher`: train the small relational teacher of the embedded default."""

from tasks.execution.artifact_task import ArtifactTask

train_teacher = ArtifactTask(
    name="train_teacher",
    version=2,
    function="worldline_core.training.video_teacher:train_teacher",
    config="worldline_core.training.training_config:TeacherConfig",
    inputs=("episodes",),
)

if __name__ == "__main__":
    train_teacher.main()
