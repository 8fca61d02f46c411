"""`train_tokenizer`: fit the small video tokenizer of the embedded default, or a small decoder for any tokenizer's latents."""

from tasks.execution.artifact_task import ArtifactTask

train_tokenizer = ArtifactTask(
    name="train_tokenizer",
    version=6,
    function="worldline_core.training.train_tokenizer:train_tokenizer",
    config="worldline_core.training.training_config:TokenizerConfig",
    inputs=("episodes",),
    optional_inputs=("encoder", "start", "held_out"),
)

if __name__ == "__main__":
    train_tokenizer.main()
