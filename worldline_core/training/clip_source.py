"""What training draws clips from: cached latents, or the frames of an EpisodeSet. Samplers and loaders know only this.

Reading is split in two, so that it can go on in other processes: `read` touches files and gives an array, `latents`
makes of it what a model sees, on the model's device.

Where a stage's clips come from and how they are read: configuration.

Which episodes a stage may train on: those in the latent store that the filters let through for this stage.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from worldline_core.actions.track_store import ActionTracks
from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.frame_decoder import DecoderChoice
from worldline_core.errors import DataError

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


class ReadingConfig(StrictModel):
    """How clips are read, whatever they are.

    ``workers``: processes that read ahead, each ``prefetch`` micro-batches at most; 0 reads in the training process when
    a batch is needed. What is trained on does not depend on either.
    ``on_unreadable``: "raise" stops at the first clip that cannot be read; "skip" takes another clip in its place, names
    it in the log and in ``run/skipped_clips-*.jsonl``, counts it, and stops after ``max_skipped``.
    """

    workers: int = Field(default=0, ge=0)
    prefetch: int = Field(default=2, ge=1)
    on_unreadable: Literal["raise", "skip"] = "raise"
    max_skipped: int = Field(default=100, ge=1)


class LatentInput(ReadingConfig):
    """Latents that encode_latents cached."""

    kind: Literal["latents"] = "latents"


class FrameInput(ReadingConfig):
    """Frames straight from the EpisodeSet; the tokenizer encodes them during training.

    ``image_size``: (H, W) that frames are resized to, as in encode_latents. ``start_step``: clips start at multiples of
    it. ``decoder``: "auto" is torchcodec where it loads, else PyAV. ``open_files``: video files that a process keeps open.
    """

    kind: Literal["frames"] = "frames"
    image_size: tuple[int, int] = (64, 96)
    start_step: int = Field(default=1, ge=1)
    decoder: DecoderChoice = "auto"
    open_files: int = Field(default=16, ge=1)


ClipInput = Annotated[LatentInput | FrameInput, Field(discriminator="kind")]


logger = logging.getLogger(__name__)


def training_rows[RowT: ClipRow](
    store: ClipSource[RowT], episodes: EpisodeSet, *, stage: Literal[1, 2], tracks: ActionTracks | None = None
) -> list[RowT]:
    """Rows of the store whose episode is in the set, fit for the stage, and (Stage II) has action tracks.

    Raises:
        DataError: if none is left.
    """
    allowed = {row.episode_id for row in episodes.rows if (row.stage1_ok if stage == 1 else row.stage2_ok)}
    # Episodes encoded by their task-facing view alone are for Stage I, however fit their other views are.
    every_view = set(store.description.get("views", ())) if stage == 2 else set()
    rows = [row for row in store.rows if row.episode_id in allowed and every_view <= set(row.views)]
    fitting = [row for row in rows if tracks is None or row.episode_id in tracks]
    if len(fitting) < len(rows):
        logger.warning("%d of %d episodes have no action tracks and are left out.", len(rows) - len(fitting), len(rows))
    if not fitting:
        raise DataError(
            "No episode is left to train on.",
            where=f"stage {stage}",
            expected="episodes that are in the EpisodeSet, the clips' store and (Stage II) the action tracks",
            got=f"{len(allowed)} fit episodes in the set, {len(store)} in the store",
            next_step="see the quarantine tables of curate, filter and render_actions",
        )
    return fitting
