"""`train_stage1`: Stage I: action-free, text-conditioned video prediction."""

from tasks.execution.artifact_task import ArtifactTask

train_stage1 = ArtifactTask(
    name="train_stage1",
    version=8,
    function="worldline_core.training.stage1:train_stage1",
    config="worldline_core.training.training_config:Stage1Config",
    inputs=("episodes",),
    optional_inputs=("latents", "tokenizer", "base"),
    distributed=True,
)

if __name__ == "__main__":
    train_stage1.main()
