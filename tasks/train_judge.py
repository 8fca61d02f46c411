"""`train_judge`: train the small judge of outcomes."""

from tasks.execution.artifact_task import ArtifactTask

train_judge = ArtifactTask(
    name="train_judge",
    version=1,
    function="worldline_core.evaluation.policy.learned_judge:train_judge",
    config="worldline_core.evaluation.evaluation_config:JudgeConfig",
    inputs=("episodes",),
    optional_inputs=("tokenizer",),
)

if __name__ == "__main__":
    train_judge.main()
