"""Which clips a step trains on: a pure function of (seed, micro-step, rank), so that a run needs no other state to continue.

Batches hold clips of one kind: one length, one stride, one set of views.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.errors import DataError
from worldline_core.model.world_model_config import TrainedClips
from worldline_core.training.clip_config import JOINT, PRIMARY, ClipSampling
from worldline_core.training.processes import ALONE, BatchPlan


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
        by = f" by {self.stride}" if self.stride > 1 else ""
        return f"{self.episode_id}, frames {self.frames[0]}..{self.frames[-1]}{by}"


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
    def from_episode(cls, row: EpisodeRow, views: Sequence[str], **more: Any) -> Self:
        """A row for those views of an episode that clips have."""
        copied = ("episode_id", "source", "embodiment", "split", "instruction", "primary_view")
        named = {name: getattr(row, name) for name in copied}
        return cls(num_frames=row.video_frames, views=tuple(views), **named, **more)

    def identity(self) -> list[Any]:
        """JSON values that clips are drawn by: two runs whose rows differ here train on other clips."""
        return [self.episode_id, self.num_frames, list(self.views), self.source, self.split, self.instruction]


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
class _Kind:
    """Clips of one length and stride, of episodes that lack the same optional views (``absent``).

    ``cumulative``: cumulated weights of the rows.
    """

    length: int
    stride: int
    absent: tuple[str, ...]
    rows: list[ClipRow]
    cumulative: np.ndarray


class ClipSampler:
    """Draws batches of clips. Every process draws the same large batch and takes its own part.

    Args:
        rows: the episodes to draw from, of those in ``splits``.
        start_step: clips start at multiples of it.
        batch_size: clips of a micro-batch.
        plan: which micro-batches are this process's, and how many are drawn as one.

    Raises:
        DataError: no episode is long enough for any clip.
    """

    def __init__(
        self,
        rows: Sequence[ClipRow],
        config: ClipSampling,
        *,
        splits: Sequence[str],
        start_step: int,
        batch_size: int,
        seed: int,
        plan: BatchPlan = ALONE,
    ) -> None:
        self.batch_size = batch_size
        self.single_view_factor = config.single_view_factor
        self.seed = seed
        self.plan = plan
        self.start_step = start_step
        self._view_weights: Mapping[str, float] = dict(sorted((config.view_weights or {}).items()))
        candidates = [row for row in rows if row.split in splits]
        self._kinds: list[_Kind] = []
        kind_weights: list[float] = []
        for length in config.lengths:
            for stride in config.strides:
                fitting = [row for row in candidates if longest_clip(row.num_frames, 0, stride) >= length]
                total = sum(config.source_weights.get(row.source, 1.0) for row in fitting)
                for absent in sorted({config.absent_views(row.views) for row in fitting}):
                    alike = [row for row in fitting if config.absent_views(row.views) == absent]
                    weights = [config.source_weights.get(row.source, 1.0) for row in alike]
                    if sum(weights) > 0:
                        self._kinds.append(_Kind(length, stride, absent, alike, np.cumsum(_normalised(weights))))
                        kind_weights.append(sum(weights) / total)
        if not self._kinds:
            longest = max((row.num_frames for row in candidates), default=0)
            raise DataError(
                "No episode is long enough for any clip length.",
                where=f"clips of the splits {list(splits)}",
                expected=f"clips of {config.lengths} frames at strides {config.strides}",
                got=f"{len(candidates)} episodes, the longest with {longest} frames",
            )
        self._kind_weights = _normalised(kind_weights)

    def clips(self, index: int) -> ClipBatch:
        """The clips of this process's micro-step ``index``."""
        index, part = self.plan.drawn(index)
        random = np.random.Generator(np.random.Philox(key=[self.seed, index]))
        kind = self._kinds[int(random.choice(len(self._kinds), p=self._kind_weights))]
        view = None
        if self._view_weights:
            present = [weight * (name not in kind.absent) for name, weight in self._view_weights.items()]
            name = list(self._view_weights)[int(random.choice(len(present), p=_normalised(present)))]
            view = None if name == JOINT else name
        size = self.batch_size * (1 if view is None else self.single_view_factor)
        return ClipBatch(self._draw(random, kind, size, part), view, kind.absent)

    def replacement(self, index: int, place: int, attempt: int) -> Clip:
        """Another clip of the length, stride and views of micro-step ``index``, for its unreadable clip at ``place``."""
        batch = self.clips(index)
        wanted = (batch.clips[place].num_frames, batch.clips[place].stride, batch.absent)
        kind = next(kind for kind in self._kinds if (kind.length, kind.stride, kind.absent) == wanted)
        index, part = self.plan.drawn(index)
        counter = [0, 0, 1 + attempt, 1 + place]  # a stream of its own
        random = np.random.Generator(np.random.Philox(key=[self.seed, index], counter=counter))
        return self._draw(random, kind, 1, part)[0]

    def trained(self, views: tuple[str, ...]) -> TrainedClips | None:
        """Strides of the clips and those of the model's view slots that they fill; None: all slots, at stride 1."""
        drawn = [name for name, weight in self._view_weights.items() if weight > 0] or [JOINT]
        batches = [
            ClipBatch((), None if name == JOINT else name, kind.absent) for kind in self._kinds for name in drawn
        ]
        shown = {slot for batch in batches for slot in batch.slots(views)}
        found = TrainedClips(
            views=tuple(view for view in views if view in shown),
            strides=tuple(sorted({kind.stride for kind in self._kinds})),
        )
        return None if found == TrainedClips(views=views, strides=(1,)) else found

    def _draw(self, random: np.random.Generator, kind: _Kind, size: int, part: int) -> tuple[Clip, ...]:
        draws = random.random((size * self.plan.together, 2))[part * size : (part + 1) * size]
        numbers = np.minimum(np.searchsorted(kind.cumulative, draws[:, 0], side="right"), len(kind.rows) - 1)
        clips: list[Clip] = []
        for number, where in zip(numbers.tolist(), draws[:, 1].tolist(), strict=True):
            row = kind.rows[number]
            starts = (row.num_frames - 1 - (kind.length - 1) * kind.stride) // self.start_step + 1
            clips.append(Clip(row.episode_id, int(where * starts) * self.start_step, kind.length, kind.stride))
        return tuple(clips)


def _normalised(weights: Sequence[float]) -> np.ndarray:
    values = np.asarray(weights, dtype=np.float64)
    return values / values.sum() if values.sum() > 0 else values
