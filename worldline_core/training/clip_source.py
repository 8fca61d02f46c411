"""Training clips: what one is, which episodes they are drawn from, and what a source of them can do.

Reading is split in two so that it can run in other processes: `ClipSource.read` touches files and fills an array;
`ClipSource.latents` turns that array into what the model sees, on the model's device.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from jaxtyping import Float
from torch import Tensor

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ArtifactError, DataError

logger = logging.getLogger(__name__)

PRIMARY = "primary"
"""In place of a view's name: the task-facing view of each episode (Stage I)."""


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


@dataclass(frozen=True)
class ClipBatch:
    """Clips of equal length that share their views.

    ``view`` is None for all views but the ``absent`` ones (which no clip of the batch has), else one view or "primary".
    """

    clips: tuple[Clip, ...]
    view: str | None
    absent: tuple[str, ...] = ()

    def slots(self, views: tuple[str, ...]) -> tuple[str, ...]:
        """The model's view slots, of ``views``, that the clips fill: the task-facing view always takes the first."""
        if self.view is None:
            return tuple(view for view in views if view not in self.absent)
        return (views[0],) if self.view == PRIMARY else (self.view,)


def latent_frame_count(num_frames: int) -> int:
    """T_l = 1 + (T - 1) / 4 (docs/method.md section 2).

    Raises:
        DataError: if ``num_frames`` is not one more than a multiple of four.
    """
    if num_frames < 1 or (num_frames - 1) % TEMPORAL_FACTOR:
        raise DataError(
            "A clip has a length that the causal tokenizer cannot encode.", expected="4 k + 1 frames", got=num_frames
        )
    return 1 + (num_frames - 1) // TEMPORAL_FACTOR


def longest_clip(num_frames: int, start: int, stride: int) -> int:
    """Most frames, 4 k + 1, of a clip at ``start`` with ``stride`` in an episode of ``num_frames``."""
    steps = (num_frames - 1 - start) // stride
    return 1 + TEMPORAL_FACTOR * (steps // TEMPORAL_FACTOR)


@dataclass(frozen=True)
class ClipRow:
    """One episode (or kept segment) that clips are drawn from. ``num_frames`` counts the frames with images."""

    episode_id: str
    num_frames: int
    views: tuple[str, ...]
    source: str
    embodiment: str
    split: str
    instruction: str
    primary_view: str

    @classmethod
    def of(cls, row: EpisodeRow, views: Sequence[str], **more: Any) -> Self:
        """The row of an EpisodeSet's row, with those of its views that clips have."""
        copied = ("episode_id", "source", "embodiment", "split", "instruction", "primary_view")
        named = {name: getattr(row, name) for name in copied}
        return cls(num_frames=row.video_frames, views=tuple(views), **named, **more)


def named_rows(rows: Sequence[ClipRow]) -> list[list[Any]]:
    """What clips are drawn by, as JSON: two runs whose rows differ here train on other clips."""
    return [[row.episode_id, row.num_frames, list(row.views), row.source, row.split, row.instruction] for row in rows]


class ClipSource(ABC):
    """Episodes whose clips can be read.

    Attributes:
        root: folder, for error messages.
        start_step: clips start at multiples of it.
        latent_shape: (c, h, w) of one view's latent frame.
        image_size: (H, W) of the frames that the latents are of.
        description: at least ``tokenizer`` (its fingerprint) and ``views``.
        dtype: of what `read` gives.
    """

    root: Path
    start_step: int
    latent_shape: tuple[int, int, int]
    image_size: tuple[int, int]
    description: dict[str, Any]
    dtype: np.dtype[Any]

    def __init__(self, rows: Sequence[ClipRow]) -> None:
        self.rows = list(rows)
        self._by_id = {row.episode_id: row for row in self.rows}

    def __len__(self) -> int:
        return len(self.rows)

    def row(self, episode_id: str) -> ClipRow:
        """The row of an episode.

        Raises:
            ArtifactError: the source does not hold it.
        """
        if episode_id not in self._by_id:
            raise ArtifactError(
                f"The {type(self).__name__} does not hold this episode (or not all the views that are trained on).",
                where=self.root,
                got=episode_id,
                next_step="encode the latents of the same EpisodeSet that is trained on",
            )
        return self._by_id[episode_id]

    @abstractmethod
    def shape(self, num_frames: int) -> tuple[int, ...]:
        """Shape of what `read` gives for one view of a clip."""

    @abstractmethod
    def read(self, clip: Clip, views: tuple[str, ...], out: np.ndarray) -> None:
        """Fill ``out`` (v, *shape) with the views of a clip. Works in any process.

        Raises:
            DataError: the clip is damaged; the message names it.
            ArtifactError: the clip does not belong to this source.
        """

    @abstractmethod
    def latents(self, read: Tensor, device: str) -> Float[Tensor, "b v c t h w"]:
        """Latents (float32) of clips that were read, on ``device``."""

    def recorded_views(self, clip: Clip, batch: ClipBatch, views: tuple[str, ...]) -> tuple[str, ...]:
        """The views of a clip of the batch that fill its slots, by the names they have in the recording."""
        return (self.row(clip.episode_id).primary_view,) if batch.view == PRIMARY else batch.slots(views)

    def batch_array(self, batch: ClipBatch, views: tuple[str, ...], memory: np.ndarray | None = None) -> np.ndarray:
        """An array (b, v, *shape) for a batch: at the start of ``memory`` (uint8) when it is given, else of its own."""
        shape = (len(batch.clips), len(batch.slots(views)), *self.shape(batch.clips[0].num_frames))
        if memory is None:
            return np.empty(shape, self.dtype)
        return memory[: int(np.prod(shape)) * self.dtype.itemsize].view(self.dtype).reshape(shape)


def training_rows(
    source: ClipSource,
    episodes: EpisodeSet,
    *,
    stage: Literal[1, 2],
    tracks: ActionTracks | None = None,
    outcomes: Sequence[str] | None = None,
    views: Sequence[str] | None = None,
) -> list[ClipRow]:
    """Rows of the source whose episode is in the set, fit for the stage, ended in one of ``outcomes``, and (Stage II) has
    action tracks.

    Args:
        views: those that an episode needs for Stage II; None: all of the source's.

    Raises:
        DataError: if none is left.
    """

    def fit_for_stage2(row: EpisodeRow) -> bool:
        # Where it is said which views are needed, that another one is missing makes no episode unfit.
        return row.stage2_ok or (views is not None and row.stage2_reason == "missing_view")

    fit = [row for row in episodes.rows if (row.stage1_ok if stage == 1 else fit_for_stage2(row))]
    allowed = {row.episode_id for row in fit if outcomes is None or row.outcome in outcomes}
    # Episodes encoded by their task-facing view alone are for Stage I, however fit their other views are.
    every_view = set(source.description.get("views", ()) if views is None else views) if stage == 2 else set()
    rows = [row for row in source.rows if row.episode_id in allowed and every_view <= set(row.views)]
    fitting = [row for row in rows if tracks is None or row.episode_id in tracks]
    if len(fitting) < len(rows):
        logger.warning("%d of %d episodes have no action tracks and are left out.", len(rows) - len(fitting), len(rows))
    if not fitting:
        raise DataError(
            "No episode is left to train on.",
            where=f"stage {stage}",
            expected="episodes that are in the EpisodeSet, the source of clips and (Stage II) the action tracks",
            got=f"{len(allowed)} fit episodes in the set, {len(source)} in the source",
            next_step="see the quarantine tables of curate, filter and render_actions",
        )
    return fitting
