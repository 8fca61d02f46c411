"""`rollout`: predict videos from a first observation and controls."""

from tasks.execution.artifact_task import ArtifactTask

rollout = ArtifactTask(
    name="rollout",
    version=9,
    function="worldline_core.rollout.rollout:rollout",
    config="worldline_core.rollout.rollout_config:RolloutConfig",
    inputs=("episodes",),
    optional_inputs=("tracks", "tokenizer", "checkpoint"),
)

if __name__ == "__main__":
    rollout.main()
