"""`distill`: Stage III: teacher forcing, trajectory regression, distribution matching."""

from tasks.execution.artifact_task import ArtifactTask

distill = ArtifactTask(
    name="distill",
    version=15,
    function="worldline_core.distillation.distill:distill",
    config="worldline_core.distillation.distill_config:DistillConfig",
    inputs=("episodes", "stage2", "tokenizer"),
    optional_inputs=("tracks", "latents", "causal"),
    distributed=True,
)

if __name__ == "__main__":
    distill.main()
