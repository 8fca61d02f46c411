"""`encode_latents`: cache the video tokenizer's latents."""

from tasks.execution.artifact_task import ArtifactTask

encode_latents = ArtifactTask(
    name="encode_latents",
    version=6,
    function="worldline_core.training.encode_latents:encode_latents",
    config="worldline_core.training.clip_config:EncodeLatentsConfig",
    inputs=("episodes", "tokenizer"),
    mapped=True,
)

if __name__ == "__main__":
    encode_latents.main()
