"""Keys and values of finished blocks: one sink block and the most recent ones.

Keys are kept *unrotated* and rotated when read, at positions counted from the start of the cache window. With rotated
keys either the positions grow without end, past anything seen in training, or evicting a block leaves keys at the
wrong distance. Here the sink always sits at the clip's start, the recent blocks follow it without a gap, and the block
being made comes next: the distances between recent blocks are the true ones, only the distance to the sink stops
growing, and the largest position is that of a trained clip. Rotated keys are remembered until the cache changes, so the
rotation costs once a block, not once a denoising step.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from worldline_core.errors import ConfigError
from worldline_core.model.layers import grouped_attention
from worldline_core.model.rope import Rotation, rotate


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
