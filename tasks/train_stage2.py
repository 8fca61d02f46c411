"""`train_stage2`: Stage II: action-driven three-view prediction on successes and failures."""

from tasks.execution.artifact_task import ArtifactTask

train_stage2 = ArtifactTask(
    name="train_stage2",
    version=17,
    function="worldline_core.training.stage2:train_stage2",
    config="worldline_core.training.training_config:Stage2Config",
    inputs=("episodes", "stage1"),
    optional_inputs=("tracks", "latents", "tokenizer", "teacher"),
    distributed=True,
)

if __name__ == "__main__":
    train_stage2.main()
