"""Attention among video tokens: all at once, block by block, or to a cache of finished blocks.

A block of latent frames sees itself and the clean blocks before it. Block 0 is the observed latent frame; block
``i >= 1`` holds ``block_size`` latent frames.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from einops import rearrange
from torch import Tensor

from worldline_core.errors import DataError
from worldline_core.model.layers import Rotation, grouped_attention, rotate


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


def window_bounds(block: int, sink_blocks: int, recent_blocks: int) -> tuple[int, int]:
    """``(stop, start)``: of the blocks before ``block``, it sees those below ``stop`` (the sink) and those from ``start``.

    The one rule of which finished blocks stay visible, in training and in a rollout.
    """
    stop = min(sink_blocks, block)
    return stop, max(stop, block - recent_blocks)


@dataclass
class FullAttention:
    """Every video token sees every video token and the text (Stage I and II)."""

    by: Rotation
    text_mask: Tensor | None = None
    """``(b m)``, True for real text tokens; None when no text is padded."""
    ignores_text: bool = False

    def __call__(
        self, layer: int, queries: Tensor, keys: Tensor, values: Tensor, text: tuple[Tensor, Tensor] | None
    ) -> Tensor:
        queries, keys = rotate(queries, self.by), rotate(keys, self.by)
        if text is None:
            return grouped_attention(queries, keys, values)
        if self.ignores_text:
            return grouped_attention(queries, keys, values) + 0.0 * (text[0].sum() + text[1].sum())
        mask = None
        if self.text_mask is not None:
            video = torch.ones(len(keys), keys.shape[-2], dtype=torch.bool, device=keys.device)
            mask = torch.cat((self.text_mask, video), dim=1)[:, None, None, :]
        keys, values = torch.cat((text[0], keys), dim=-2), torch.cat((text[1], values), dim=-2)
        return grouped_attention(queries, keys, values, mask)


@dataclass
class TeacherForcingAttention:
    """One pass over ``[clean blocks 0..k-1, noisy blocks 1..k]`` in which every block sees what a rollout shows it.

    A block, clean or noisy, sees itself and the clean blocks of its window, at positions counted from the start of that
    window, as :class:`KVCache` holds them. Blocks with windows of one length are one unmasked call of attention, with the
    blocks as batch: a mask of sequence length squared would hold 10^9 entries at full size.
    """

    by: Rotation
    """Rotation of positions from 0 on, as many as the longest window and the block after it have."""
    sizes: tuple[int, ...]
    """Tokens of each block, the observed frame first."""
    sink_blocks: int
    recent_blocks: int

    def __call__(
        self, layer: int, queries: Tensor, keys: Tensor, values: Tensor, text: tuple[Tensor, Tensor] | None
    ) -> Tensor:
        starts = [0, *itertools.accumulate(self.sizes)]
        clean = [(block, starts[block]) for block in range(len(self.sizes) - 1)]
        noisy = [(block, starts[-2] - self.sizes[0] + starts[block]) for block in range(1, len(self.sizes))]
        alike: dict[int, list[tuple[int, list[slice]]]] = {}
        for place, (block, start) in enumerate(clean + noisy):
            sink, recent = window_bounds(block, self.sink_blocks, self.recent_blocks)
            window = [slice(0, starts[sink]), slice(starts[recent], starts[block])]
            own = slice(start, start + self.sizes[block])
            alike.setdefault(sum(part.stop - part.start for part in window), []).append((place, [*window, own]))
        mixed: list[Tensor] = [queries] * len(clean + noisy)
        for length, group in alike.items():
            own = torch.stack([queries[..., parts[-1], :] for _, parts in group])
            seen_keys, seen_values = (
                torch.stack([torch.cat([source[..., part, :] for part in parts], dim=-2) for _, parts in group])
                for source in (keys, values)
            )
            cosine, sine = (angles[..., : seen_keys.shape[-2], :] for angles in self.by)
            own = rotate(own, (cosine[..., length:, :], sine[..., length:, :]))
            seen_keys = rotate(seen_keys, (cosine, sine))
            found = grouped_attention(own.flatten(0, 1), seen_keys.flatten(0, 1), seen_values.flatten(0, 1))
            for (place, _), part in zip(group, rearrange(found, "(g b) n d -> g b n d", g=len(group)), strict=True):
                mixed[place] = part
        return torch.cat(mixed, dim=1)


@dataclass(frozen=True)
class CachedBlock:
    """Unrotated keys and values of a finished block, ``(b heads n d)``, by layer."""

    frames: int
    layers: dict[int, tuple[Tensor, Tensor]]


class CacheWindow:
    """The finished blocks that the next block sees. It never changes: a cache that takes a block gets a new window.

    So a pass that is computed again in a backward pass (activation checkpointing) reads what it read the first time.
    """

    def __init__(self, blocks: Sequence[CachedBlock] = ()) -> None:
        self.blocks = tuple(blocks)
        self._rotated: dict[int, tuple[Tensor, Tensor]] = {}

    @property
    def frames(self) -> int:
        """Latent frames in the window: the temporal position of the next block's first frame."""
        return sum(block.frames for block in self.blocks)

    @property
    def joined(self) -> list[tuple[Tensor, Tensor]]:
        """Bytes that `read` keeps of the layers, as many again as the blocks take: every Euler step of a block reads them."""
        return list(self._rotated.values())

    def read(self, layer: int, by: Rotation) -> tuple[Tensor, Tensor] | None:
        """Keys (rotated by the window's rotation) and values of ``layer``, ``(b heads n d)``; None while empty."""
        if not self.blocks:
            return None
        if layer not in self._rotated:
            keys, values = (
                _joined(parts) for parts in zip(*(block.layers[layer] for block in self.blocks), strict=True)
            )
            self._rotated[layer] = (rotate(keys, by), values)
        return self._rotated[layer]


def _joined(parts: Sequence[Tensor]) -> Tensor:
    """Keys or values one after the other; those of a history that all clips share have a batch of one."""
    batch = max(len(part) for part in parts)
    return torch.cat([part.expand(batch, -1, -1, -1) for part in parts], dim=-2)


class KVCache:
    """Keys and values of the finished blocks that stay visible: the first ones (the sink) and the most recent ones.

    Keys are kept *unrotated* and rotated when read, at positions counted from the start of the window. With rotated keys
    either the positions grow past anything seen in training, or evicting a block leaves keys at the wrong distance. Here the
    sink sits at the clip's start, the recent blocks follow it without a gap, and the block being made comes next: only the
    distance to the sink stops growing, and the largest position is that of a trained clip. Rotated keys are remembered until
    the window changes.

    Args:
        sink_blocks: blocks kept from the start of the rollout (block 0 is the observed latent frame).
        recent_blocks: finished blocks kept besides the sink.
        fps: frames per second of each clip, ``(b)``; None: as the model's config says.
    """

    def __init__(self, sink_blocks: int, recent_blocks: int, fps: Tensor | None = None) -> None:
        self.sink_blocks = sink_blocks
        self.recent_blocks = recent_blocks
        self.fps = fps
        self.reference: Tensor | None = None
        """Latents of the observed frame, ``(b v c 1 h w)``; None while the cache is empty."""
        self.window = CacheWindow()

    @property
    def frames(self) -> int:
        return self.window.frames

    @property
    def nbytes(self) -> int:
        """Bytes of keys and values: those stored block by block, and the window's, rotated and joined, once it was read."""
        stored = [pair for block in self.window.blocks for pair in block.layers.values()]
        return sum(part.nbytes for pair in [*stored, *self.window.joined] for part in pair)

    def append(self, block: CachedBlock, clean: Tensor) -> None:
        """Take a finished block into the window and let go of what falls out of it.

        Args:
            clean: its latents; of the first block, the observed frame, they are the reference.
        """
        if self.reference is None:
            self.reference = clean[:, :, :, :1].detach()
        self.window = CacheWindow(self._visible((*self.window.blocks, block)))

    def _visible[T](self, blocks: tuple[T, ...]) -> tuple[T, ...]:
        stop, start = window_bounds(len(blocks), self.sink_blocks, self.recent_blocks)
        return blocks[:stop] + blocks[start:]

    def window_beside_next(self) -> CacheWindow | None:
        """The blocks that the next finished block will share the window with; None if that block leaves the window at once."""
        visible = self._visible((*self.window.blocks, None))
        kept = [block for block in visible if block is not None]
        if len(kept) == len(visible):
            return None
        return self.window if len(kept) == len(self.window.blocks) else CacheWindow(kept)

    def select(self, clips: Sequence[int]) -> KVCache:
        """The window of these clips, to go on separately. Tensors are never changed, so what can be shared is: what all clips share
        (a batch of one) serves any number of branches without a copy.
        """
        index = list(clips)
        return self.map(lambda x: x if len(x) == 1 or index == list(range(len(x))) else x[index])

    def map(self, change: Callable[[Tensor], Tensor]) -> KVCache:
        """A cache of the same blocks with other tensors, always visited in the same order."""
        other = KVCache(self.sink_blocks, self.recent_blocks, None if self.fps is None else change(self.fps))
        other.reference = None if self.reference is None else change(self.reference)
        other.window = CacheWindow(
            [
                CachedBlock(
                    block.frames, {n: (change(keys), change(values)) for n, (keys, values) in block.layers.items()}
                )
                for block in self.window.blocks
            ]
        )
        return other


@dataclass
class CachedAttention:
    """The current block, or the last part of it, sees the block and the window of a cache, which itself stays as it is.

    Attributes:
        by: rotation of the current block; ``window_by``: of the frames in the window.
        written: filled with the current block's unrotated keys and values by layer; None: they are not kept.
    """

    by: Rotation
    window: CacheWindow
    window_by: Rotation
    written: dict[int, tuple[Tensor, Tensor]] | None = None

    def __call__(
        self, layer: int, queries: Tensor, keys: Tensor, values: Tensor, text: tuple[Tensor, Tensor] | None
    ) -> Tensor:
        if self.written is not None:
            self.written[layer] = (keys, values)
        last = queries.shape[-2]
        queries, keys = rotate(queries, (self.by[0][..., -last:, :], self.by[1][..., -last:, :])), rotate(keys, self.by)
        window = self.window.read(layer, self.window_by)
        if window is not None:
            keys, values = _joined((window[0], keys)), _joined((window[1], values))
        return grouped_attention(queries, keys, values)


@dataclass
class FollowedAttention:
    """A finished block that is written to a cache, and after it in the same pass the next block, which sees it.

    Attributes:
        following: attention of the next block, the last part of both together.
        tokens: of the finished block.
    """

    finished: CachedAttention
    following: CachedAttention
    tokens: int

    def __call__(
        self, layer: int, queries: Tensor, keys: Tensor, values: Tensor, text: tuple[Tensor, Tensor] | None
    ) -> Tensor:
        # Copies, so that a cache does not hold the next block too.
        known_keys, known_values = (part[..., : self.tokens, :].clone() for part in (keys, values))
        seen = self.finished(layer, queries[..., : self.tokens, :], known_keys, known_values, text)
        return torch.cat((seen, self.following(layer, queries[..., self.tokens :, :], keys, values, text)), dim=1)
