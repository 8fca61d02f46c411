"""Qwen3-VL from a local folder (transformers): BF16, greedy, at most 256 new tokens, no thinking."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import torch
from einops import rearrange

from worldline_core.errors import UnavailableError
from worldline_core.evaluation.vlm.message import MAX_NEW_TOKENS, Image, Part, Text, Video


class Qwen3VLModel:
    """One user message in, greedy text out; there is no system prompt.

    Args:
        model, processor: a Qwen3VLForConditionalGeneration and its Qwen3VLProcessor (transformers).
    """

    def __init__(self, model: Any, processor: Any, name: str = "qwen3-vl") -> None:
        self.model = model.eval()
        self.processor = processor
        self.name = name

    @classmethod
    def load(cls, folder: Path, *, device: torch.device | str | None = None) -> Qwen3VLModel:
        """Open weights from a local folder; nothing is downloaded.

        Raises: UnavailableError when the folder has no Qwen3-VL.
        """
        if not (folder / "config.json").is_file():
            raise UnavailableError(
                "Qwen3-VL weights not found",
                where=folder,
                expected="a downloaded Qwen/Qwen3-VL-8B-Instruct folder with config.json",
                next_step="download it, use judge: openai with a server, or judge: measured",
            )
        from transformers import AutoProcessor, Qwen3VLForConditionalGeneration

        target = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
        try:
            model = Qwen3VLForConditionalGeneration.from_pretrained(folder, dtype=torch.bfloat16, local_files_only=True)
            processor = AutoProcessor.from_pretrained(folder, local_files_only=True)
        except (OSError, ValueError) as error:
            raise UnavailableError("Qwen3-VL weights cannot be opened", where=folder, got=str(error)) from error
        return cls(cast(Any, model).to(target), processor, folder.name)

    @torch.inference_mode()
    def answer(self, parts: Sequence[Part]) -> str:
        """Greedy text of at most MAX_NEW_TOKENS tokens."""
        content: list[dict[str, Any]] = []
        images: list[torch.Tensor] = []
        videos: list[torch.Tensor] = []
        metadata: list[dict[str, Any]] = []
        for part in parts:
            if isinstance(part, Text):
                content.append({"type": "text", "text": part.text})
            elif isinstance(part, Image):
                content.append({"type": "image"})
                images.append(rearrange(torch.from_numpy(part.pixels.copy()), "h w c -> c h w"))
            else:
                content.append({"type": "video"})
                videos.append(rearrange(torch.from_numpy(part.frames.copy()), "n h w c -> n c h w"))
                metadata.append(_metadata(part))
        text = self.processor.apply_chat_template(
            [{"role": "user", "content": content}], tokenize=False, add_generation_prompt=True, enable_thinking=False
        )
        inputs = self.processor(
            text=[text],
            images=images or None,
            videos=videos or None,
            # Frames were chosen already: sampling again would show others, at times that do not fit them.
            **({"video_metadata": metadata, "do_sample_frames": False} if videos else {}),
            return_tensors="pt",
        ).to(self.model.device)
        tokens = self.model.generate(**inputs, do_sample=False, max_new_tokens=MAX_NEW_TOKENS)
        new = tokens[:, inputs["input_ids"].shape[1] :]
        return self.processor.batch_decode(new, skip_special_tokens=True, clean_up_tokenization_spaces=False)[0]


def _metadata(video: Video) -> dict[str, Any]:
    """Times of the chosen frames, from which the processor writes its time stamps."""
    return {
        "fps": video.fps,
        "total_num_frames": video.total_frames,
        "frames_indices": list(video.indices),
        "duration": video.total_frames / video.fps,
    }
