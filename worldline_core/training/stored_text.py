"""Keys and values of every prompt of a Stage I run, made once, in place of a text tower that is not trained."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from worldline_core.errors import ConfigError
from worldline_core.model.layers import TextContext
from worldline_core.model.text import padded
from worldline_core.model.world_model import WorldModel
from worldline_core.progress import with_progress
from worldline_core.training.clip_config import ClipSampling
from worldline_core.training.clip_loader import ClipLoader
from worldline_core.training.clip_sampler import Clip, ClipRow

MOST_BYTES = 2**32
"""Of the machine's memory, for the keys and values of all prompts."""


def prompts_of(loader: ClipLoader, rows: Sequence[ClipRow], clips: ClipSampling) -> list[tuple[int, ...]]:
    """Token ids of every text that clips of some episodes can have: a prompt may also state length and rate."""
    if loader.text is None:
        return []
    asked = dict.fromkeys(
        (row.instruction, loader.clip_facts(Clip(row.episode_id, 0, length, stride)))
        for row in rows
        for length in clips.lengths
        for stride in clips.strides
    )
    found = (loader.text([instruction], [facts])[0][0] for instruction, facts in asked)
    return list(dict.fromkeys(tuple(ids.tolist()) for ids in found))


class StoredText:
    """Reads texts as `WorldModel.encode_text` does, from the machine's memory.

    Args:
        model: with its text tower on ``device``; it is not kept.

    Raises:
        ConfigError: the prompts are too many.
    """

    @torch.no_grad()
    def __init__(self, model: WorldModel, prompts: Sequence[tuple[int, ...]], device: str) -> None:
        self._numbers = {prompt: number for number, prompt in enumerate(prompts)}
        self._device = device
        # All at one width, as in a batch with the longest: a text's place in time depends on it.
        ids, self._mask = padded(prompts, 0)
        layers: list[tuple[list[Tensor], list[Tensor]]] = [([], []) for _ in model.layers]
        for number in with_progress(range(len(prompts)), "reading prompts", "prompt"):
            context = model.encode_text(ids[number, None].to(device), self._mask[number, None].to(device))
            size = sum(value.nbytes for pair in context.layers for value in pair)
            if size * len(prompts) > MOST_BYTES:
                raise ConfigError(
                    "The keys and values of all prompts are too much to keep", where="train_stage1.text_tower: stored",
                    expected=f"at most {MOST_BYTES / 1e9:.1f} GB", next_step="set text_tower to frozen, or cut text.max_length",
                    got=f"{size * len(prompts) / 1e9:.1f} GB, of {len(prompts)} prompts of up to {ids.shape[1]} tokens",
                )  # fmt: skip
            for kept, pair in zip(layers, context.layers, strict=True):
                for values, one in zip(kept, pair, strict=True):
                    values.append(one.cpu())
        self._layers = [(torch.cat(keys), torch.cat(values)) for keys, values in layers]

    def __call__(self, text_ids: Int[Tensor, "b m"], text_mask: Bool[Tensor, "b m"] | None = None) -> TextContext:
        """What the layers read of right-padded texts, each among the prompts."""
        mask = torch.ones_like(text_ids, dtype=torch.bool) if text_mask is None else text_mask
        texts = [tuple(ids[real].tolist()) for ids, real in zip(text_ids, mask, strict=True)]
        rows = torch.tensor([self._numbers[text] for text in texts])
        layers = tuple((keys[rows].to(self._device), values[rows].to(self._device)) for keys, values in self._layers)
        return TextContext(layers, self._mask[rows].to(self._device), self._mask.shape[1])
