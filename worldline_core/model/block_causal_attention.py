"""Block-causal attention: a block of latent frames sees itself and the clean blocks before it.

Block 0 is the observed latent frame; block ``i >= 1`` holds ``block_size`` latent frames.

Keys and values of finished blocks: one sink block and the most recent ones.

Keys are kept *unrotated* and rotated when read, at positions counted from the start of the cache window. With rotated
keys either the positions grow without end, past anything seen in training, or evicting a block leaves keys at the
wrong distance. Here the sink always sits at the clip's start, the recent blocks follow it without a gap, and the block
being made comes next: the distances between recent blocks are the true ones, only the distance to the sink stops
growing, and the largest position is that of a trained clip. Rotated keys are remembered until the cache changes, so the
rotation costs once a block, not once a denoising step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool
from torch import Tensor

from worldline_core.errors import ConfigError, DataError
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


@dataclass
class _Block:
    frames: int
    keys: dict[int, Tensor] = field(default_factory=dict)
    values: dict[int, Tensor] = field(default_factory=dict)


class KVCache:
    """A rolling window over finished blocks.

    Args:
        sink_blocks: blocks kept from the start of the rollout (block 0 is the observed latent frame).
        recent_blocks: finished blocks kept besides the sink.
    """

    def __init__(self, sink_blocks: int = 1, recent_blocks: int = 3) -> None:
        if sink_blocks < 1 or recent_blocks < 0:
            raise ConfigError(
                "The cache keeps at least the observed frame",
                expected="sink_blocks >= 1, recent_blocks >= 0",
                got=f"{sink_blocks}, {recent_blocks}",
            )
        self.sink_blocks = sink_blocks
        self.recent_blocks = recent_blocks
        self.blocks_seen = 0
        self.reference: Tensor | None = None
        """Clean latents of the first frame written, ``(b v c 1 h w)``."""
        self._blocks: list[_Block] = []
        self._pending: _Block | None = None
        self._rotated: dict[int, tuple[Tensor, Tensor]] = {}
        self._rotation: Rotation | None = None

    @property
    def frames(self) -> int:
        """Latent frames held; also the temporal position of the next block's first frame."""
        return sum(block.frames for block in self._blocks)

    @property
    def nbytes(self) -> int:
        """Bytes of the stored keys and values."""
        return sum(
            part.numel() * part.element_size()
            for block in self._blocks
            for part in (*block.keys.values(), *block.values.values())
        )

    def set_rotation(self, by: Rotation) -> None:
        """Rotation of the held frames, ``(n, head_dim)``; kept while the window does not change."""
        self._rotation = by

    @property
    def needs_rotation(self) -> bool:
        """Whether the window changed since :meth:`set_rotation`."""
        return self._rotation is None and bool(self._blocks)

    def read(self, layer: int) -> tuple[Tensor, Tensor] | None:
        """Rotated keys and values of the window for ``layer``, ``(b heads n d)``; None while empty."""
        if not self._blocks:
            return None
        if layer not in self._rotated:
            if self._rotation is None:
                raise ConfigError("The cache was read before its rotation was set")
            keys = torch.cat([block.keys[layer] for block in self._blocks], dim=-2)
            values = torch.cat([block.values[layer] for block in self._blocks], dim=-2)
            self._rotated[layer] = (rotate(keys, self._rotation), values)
        return self._rotated[layer]

    def begin_block(self, frames: int) -> None:
        """Announce a finished block; :meth:`write` then receives it layer by layer."""
        self._pending = _Block(frames)

    def write(self, layer: int, keys: Tensor, values: Tensor) -> None:
        """Store unrotated keys and values of the announced block."""
        if self._pending is None:
            raise ConfigError("The cache was written outside begin_block .. end_block")
        self._pending.keys[layer] = keys.detach()
        self._pending.values[layer] = values.detach()

    def end_block(self) -> None:
        """Take the block into the window and let go of what falls out of it."""
        if self._pending is None:
            raise ConfigError("end_block without begin_block")
        self._blocks.append(self._pending)
        self._pending = None
        self.blocks_seen += 1
        if len(self._blocks) > self.sink_blocks + self.recent_blocks:
            del self._blocks[self.sink_blocks]
        self._rotated.clear()
        self._rotation = None

    def copy(self) -> KVCache:
        """A cache with the same window that can go on separately (tensors are shared; they are never changed)."""
        other = KVCache(self.sink_blocks, self.recent_blocks)
        other.blocks_seen = self.blocks_seen
        other.reference = self.reference
        other._blocks = list(self._blocks)
        return other


@dataclass
class CachedAttention:
    """The current block sees itself and the window; in a write pass its keys and values are stored as well."""

    by: Rotation
    cache: KVCache
    store: bool

    def __call__(
        self, layer: int, queries: Tensor, keys: Tensor, values: Tensor, text: tuple[Tensor, Tensor] | None
    ) -> Tensor:
        if self.store:
            self.cache.write(layer, keys, values)
        queries, keys = rotate(queries, self.by), rotate(keys, self.by)
        window = self.cache.read(layer)
        if window is not None:
            keys, values = torch.cat((window[0], keys), dim=-2), torch.cat((window[1], values), dim=-2)
        return grouped_attention(queries, keys, values)
