"""Task text as Cosmos3 was trained to read it: Qwen2 ids of a chat with a system prompt and the clip's facts."""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from worldline_core.errors import CheckpointError, UnavailableError

SYSTEM_PROMPT = "You are a helpful assistant who will generate videos from a give prompt."
"""As in training, the missing letter included."""
VISION_START = "<|vision_start|>"


def video_prompt(instruction: str, *, num_frames: int, fps: float, image_size: tuple[int, int]) -> str:
    """The instruction followed by the clip's duration and resolution."""
    facts = (
        f"The video is {num_frames / fps:.1f} seconds long and is of {fps:.0f} FPS.",
        f"This video is of {image_size[0]}x{image_size[1]} resolution.",
    )
    text = instruction.strip()
    for fact in facts:
        text = f"{text.rstrip('.')}. {fact}" if text else fact
    return text


class Cosmos3Text:
    """Instructions to right-padded ids ``(b m)`` and a mask that is True on real tokens.

    Args:
        folder: local folder of the Qwen2 tokenizer (``text_tokenizer`` of the diffusers pipeline).
        num_frames, fps, image_size: of the clips; they are part of the prompt.

    Raises:
        UnavailableError: there is no such folder.
        CheckpointError: its tokenizer lacks the chat template or the vision token.
    """

    def __init__(self, folder: Path, *, num_frames: int, fps: float, image_size: tuple[int, int]) -> None:
        if not folder.is_dir():
            raise UnavailableError(
                "The text tokenizer is not here",
                where=folder,
                expected="a folder with a Qwen2 tokenizer",
                next_step="download the text_tokenizer folder of nvidia/Cosmos3-Nano",
            )
        from transformers import AutoTokenizer

        self.tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True)
        self.num_frames, self.fps, self.image_size = num_frames, fps, image_size
        start = self.tokenizer.get_vocab().get(VISION_START)
        if start is None or self.tokenizer.eos_token_id is None or self.tokenizer.chat_template is None:
            raise CheckpointError(
                "Not the tokenizer of a Cosmos3 model",
                where=folder,
                expected=f"a chat template, an end token, and {VISION_START}",
                got=type(self.tokenizer).__name__,
            )
        self._ending = [int(self.tokenizer.eos_token_id), int(start)]

    def ids(self, instruction: str) -> list[int]:
        """Ids of one prompt: chat template, end of text, start of vision."""
        prompt = video_prompt(instruction, num_frames=self.num_frames, fps=self.fps, image_size=self.image_size)
        chat = [{"role": "system", "content": SYSTEM_PROMPT}, {"role": "user", "content": prompt}]
        text = self.tokenizer.apply_chat_template(chat, tokenize=False, add_generation_prompt=True)
        return [*self.tokenizer(text, add_special_tokens=False)["input_ids"], *self._ending]

    def __call__(self, texts: list[str]) -> tuple[Int[Tensor, "b m"], Bool[Tensor, "b m"]]:
        coded = [self.ids(text) for text in texts]
        length = max(len(row) for row in coded)
        ids = torch.full((len(coded), length), self._ending[0], dtype=torch.long)
        mask = torch.zeros(len(coded), length, dtype=torch.bool)
        for row, values in enumerate(coded):
            ids[row, : len(values)] = torch.tensor(values)
            mask[row, : len(values)] = True
        return ids, mask
