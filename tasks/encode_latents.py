"""`encode_latents`: cache the video tokenizer's latents."""

from tasks.artifact_task import artifact_task

encode_latents = artifact_task("encode_latents")

if __name__ == "__main__":
    encode_latents.main()
