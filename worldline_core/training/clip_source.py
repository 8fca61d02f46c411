"""What training draws clips from: cached latents, or the frames of an EpisodeSet. Samplers and loaders know only this.

Reading is split in two, so that it can go on in other processes: `read` touches files and gives an array, `latents`
makes of it what a model sees, on the model's device.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float
from torch import Tensor

TEMPORAL_COMPRESSION = 4


class ClipRow(Protocol):
    """One episode as a sampler sees it. ``num_frames`` counts the frames with images."""

    @property
    def episode_id(self) -> str: ...
    @property
    def num_frames(self) -> int: ...
    @property
    def views(self) -> tuple[str, ...]: ...
    @property
    def source(self) -> str: ...
    @property
    def split(self) -> str: ...
    @property
    def instruction(self) -> str: ...
    @property
    def primary_view(self) -> str: ...


def named_rows(rows: Sequence[ClipRow]) -> list[list[Any]]:
    """What clips are drawn by, as JSON: two runs whose rows differ here train on other clips."""
    return [[row.episode_id, row.num_frames, list(row.views), row.source, row.split, row.instruction] for row in rows]


@dataclass(frozen=True)
class Clip:
    """``num_frames`` frames at ``start``, ``start + stride``, ... of an episode."""

    episode_id: str
    start: int
    num_frames: int
    stride: int

    @property
    def frames(self) -> range:
        """Frame numbers, counted from the first frame of the row's segment."""
        return range(self.start, self.start + self.stride * self.num_frames, self.stride)

    def __str__(self) -> str:
        return f"{self.episode_id}, frames {self.frames[0]}..{self.frames[-1]}" + (
            f" by {self.stride}" if self.stride > 1 else ""
        )


class ClipSource[RowT: ClipRow](Protocol):
    """Episodes whose clips can be read.

    Attributes:
        start_step: clips start at multiples of it.
        latent_shape: (c, h, w) of one view's latent frame.
        image_size: (H, W) of the frames that the latents are of.
        description: ``tokenizer`` (its fingerprint) and ``views``, at least.
        dtype: of what `read` gives.
    """

    start_step: int
    latent_shape: tuple[int, int, int]
    image_size: tuple[int, int]
    description: dict[str, Any]
    dtype: np.dtype[Any]

    @property
    def rows(self) -> Sequence[RowT]: ...

    def __len__(self) -> int: ...

    def row(self, episode_id: str) -> RowT: ...

    def max_frames(self, row: ClipRow, start: int, stride: int) -> int:
        """Longest clip length (4 k + 1 frames) that starts at ``start`` with ``stride``."""
        ...

    def shape(self, num_frames: int) -> tuple[int, ...]:
        """Shape of what `read` gives for one view of a clip."""
        ...

    def read(self, clip: Clip, views: tuple[str, ...], out: np.ndarray) -> None:
        """Fill ``out`` (v, *shape) with the views of a clip. Works in any process.

        Raises:
            DataError: the clip is damaged; the message names it.
            ArtifactError: the clip does not belong to this source.
        """
        ...

    def latents(self, read: Tensor, device: str) -> Float[Tensor, "b v c t h w"]:
        """Latents (float32) of clips that were read, on ``device``."""
        ...


def longest_clip(num_frames: int, start: int, stride: int) -> int:
    """Most frames, 4 k + 1, of a clip at ``start`` with ``stride`` in an episode of ``num_frames``."""
    steps = (num_frames - 1 - start) // stride
    return 1 + TEMPORAL_COMPRESSION * (steps // TEMPORAL_COMPRESSION)
