"""Block-causal attention: a block of latent frames sees itself and the clean blocks before it.

Block 0 is the observed latent frame; block ``i >= 1`` holds ``block_size`` latent frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from worldline_core.errors import DataError
from worldline_core.model.layers import grouped_attention
from worldline_core.model.rope import Rotation, rotate


def block_bounds(latent_frames: int, block_size: int) -> list[tuple[int, int]]:
    """First and one-past-last latent frame of every block, the observed frame first.

    Raises:
        DataError: the frames after the first do not divide into blocks.
    """
    if block_size < 1 or latent_frames < 1 or (latent_frames - 1) % block_size:
        raise DataError(
            "The clip does not divide into blocks",
            expected=f"1 + k * {block_size} latent frames",
            got=latent_frames,
            next_step="cut the clip, or change the block size",
        )
    return [(0, 1), *((start, start + block_size) for start in range(1, latent_frames, block_size))]


def visible_blocks(block: int, sink_blocks: int | None = None, recent_blocks: int | None = None) -> list[int]:
    """Earlier blocks that ``block`` attends to: all of them, or the first ``sink_blocks`` and last ``recent_blocks``."""
    if sink_blocks is None or recent_blocks is None:
        return list(range(block))
    return [earlier for earlier in range(block) if earlier < sink_blocks or earlier >= block - recent_blocks]


def block_causal_mask(bounds: Sequence[tuple[int, int]], tokens_per_frame: int) -> Bool[Tensor, "n n"]:
    """Dense mask (True: may attend) of one clean sequence, for reference and for tests."""
    block_of = torch.cat(
        [torch.full(((stop - start) * tokens_per_frame,), i) for i, (start, stop) in enumerate(bounds)]
    )
    return block_of[:, None] >= block_of[None, :]


def teacher_forcing_mask(bounds: Sequence[tuple[int, int]], tokens_per_frame: int) -> Bool[Tensor, "n n"]:
    """Dense mask of the sequence ``[clean blocks 0..k-1, noisy blocks 1..k]``: the reference of the pattern below."""
    sizes = [(stop - start) * tokens_per_frame for start, stop in bounds]
    clean = torch.cat([torch.full((size,), i) for i, size in enumerate(sizes[:-1])])
    noisy = torch.cat([torch.full((size,), i) for i, size in enumerate(sizes) if i > 0])
    clean_to_clean = clean[:, None] >= clean[None, :]
    clean_to_noisy = torch.zeros(len(clean), len(noisy), dtype=torch.bool)
    noisy_to_clean = noisy[:, None] > clean[None, :]
    noisy_to_noisy = noisy[:, None] == noisy[None, :]
    return torch.cat(
        (torch.cat((clean_to_clean, clean_to_noisy), dim=1), torch.cat((noisy_to_clean, noisy_to_noisy), dim=1))
    )


@dataclass
class FullAttention:
    """Every video token sees every video token and the text (Stage I and II)."""

    by: Rotation
    text_mask: Tensor | None = None
    """``(b m)``, True for real text tokens; None when no text is padded."""

    def __call__(
        self, layer: int, queries: Tensor, keys: Tensor, values: Tensor, text: tuple[Tensor, Tensor] | None
    ) -> Tensor:
        queries, keys = rotate(queries, self.by), rotate(keys, self.by)
        if text is None:
            return grouped_attention(queries, keys, values)
        mask = None
        if self.text_mask is not None:
            video = torch.ones(len(keys), keys.shape[-2], dtype=torch.bool, device=keys.device)
            mask = torch.cat((self.text_mask, video), dim=1)[:, None, None, :]
        keys, values = torch.cat((text[0], keys), dim=-2), torch.cat((text[1], values), dim=-2)
        return grouped_attention(queries, keys, values, mask)


@dataclass
class TeacherForcingAttention:
    """One pass over ``[clean blocks 0..k-1, noisy blocks 1..k]`` with the mask of :func:`teacher_forcing_mask`.

    Each block is one unmasked call on its own keys: nothing is computed only to be masked away, and no mask of
    sequence length squared exists (at full size it would hold 10^9 entries).
    """

    by: Rotation
    sizes: tuple[int, ...]
    """Tokens of each block, the observed frame first."""

    def __call__(
        self, layer: int, queries: Tensor, keys: Tensor, values: Tensor, text: tuple[Tensor, Tensor] | None
    ) -> Tensor:
        queries, keys = rotate(queries, self.by), rotate(keys, self.by)
        clean_length = sum(self.sizes[:-1])
        mixed = []
        stop = 0
        for size in self.sizes[:-1]:
            start, stop = stop, stop + size
            mixed.append(grouped_attention(queries[..., start:stop, :], keys[..., :stop, :], values[..., :stop, :]))
        history, start = 0, clean_length
        for earlier, size in zip(self.sizes[:-1], self.sizes[1:], strict=True):
            history, own = history + earlier, slice(start, start + size)
            seen_keys = torch.cat((keys[..., :history, :], keys[..., own, :]), dim=-2)
            seen_values = torch.cat((values[..., :history, :], values[..., own, :]), dim=-2)
            mixed.append(grouped_attention(queries[..., own, :], seen_keys, seen_values))
            start += size
        return torch.cat(mixed, dim=1)
