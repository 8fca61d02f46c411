"""`merge_adapter`: a LoRA adapter and the checkpoint that it started from as one checkpoint."""

from tasks.execution.artifact_task import ArtifactTask

merge_adapter = ArtifactTask(
    name="merge_adapter",
    version=1,
    function="worldline_core.training.adapters:merge_adapter",
    config="worldline_core.training.training_config:MergeAdapterConfig",
    inputs=("adapter", "start"),
)

if __name__ == "__main__":
    merge_adapter.main()
