"""Sampling of clips as a pure function of (seed, micro-step, rank), so that a run needs no other state to continue."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress, product
from typing import Self

import numpy as np

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.errors import DataError
from worldline_core.model.world_model_config import TrainedClips
from worldline_core.training.clip_config import JOINT, PRIMARY, SUBSET, ClipSampling, view_subsets
from worldline_core.training.processes import ALONE, BatchPlan

LEAST_SHARE = 0.01
"""Least share of the steps that show a set of views which the model is said to know."""


@dataclass(frozen=True)
class Clip:
    """``num_frames`` frames at ``start``, ``start + stride``, ... of an episode. ``vectors``: views that take control vectors
    though their cameras may be known."""

    episode_id: str
    start: int
    num_frames: int
    stride: int
    vectors: tuple[str, ...] = ()

    @property
    def frames(self) -> range:
        """Frame numbers, counted from the first frame of the row's segment."""
        return range(self.start, self.start + self.stride * self.num_frames, self.stride)

    def __str__(self) -> str:
        by = f" by {self.stride}" if self.stride > 1 else ""
        return f"{self.episode_id}, frames {self.frames[0]}..{self.frames[-1]}{by}"


@dataclass(frozen=True)
class ClipBatch:
    """Clips of equal length, and the model's view slots that all of them fill.

    ``primary``: each episode's task-facing view, whatever its name, fills the first slot.
    """

    clips: tuple[Clip, ...]
    views: tuple[str, ...]
    primary: bool = False


@dataclass(frozen=True)
class ClipRow:
    """One episode (or kept segment) that clips are drawn from.

    ``num_frames`` counts the frames with images; ``shard`` is the file of its cached latents.
    """

    episode_id: str
    num_frames: int
    views: tuple[str, ...]
    source: str
    embodiment: str
    split: str
    instruction: str
    primary_view: str
    shard: str = ""

    @classmethod
    def from_episode(cls, row: EpisodeRow, views: Sequence[str], shard: str = "") -> Self:
        """A row for those views of an episode that clips have."""
        copied = ("episode_id", "source", "embodiment", "split", "instruction", "primary_view")
        named = {name: getattr(row, name) for name in copied}
        return cls(num_frames=row.video_frames, views=tuple(views), shard=shard, **named)


def longest_clip(num_frames: int, start: int, stride: int) -> int:
    """Most frames, 4 k + 1, of a clip at ``start`` with ``stride`` in an episode of ``num_frames``."""
    return 1 + TEMPORAL_FACTOR * ((num_frames - 1 - start) // (TEMPORAL_FACTOR * stride))


@dataclass(frozen=True)
class _Kind:
    """Clips of one length and stride, of episodes with the same views; ``cumulative`` weights of the rows."""

    length: int
    stride: int
    views: tuple[str, ...]
    rows: list[ClipRow]
    cumulative: np.ndarray


class ClipSampler:
    """Draws batches of clips of one length, stride and set of views. Every process draws the same and takes its own part.

    Args:
        views: the model's slots.
        start_step: clips start at multiples of it.
        vector_share: how often a view of a clip takes the control vector, whether its camera is known or not.
        where: names these clips in the error.

    Raises: DataError: no episode is long enough for any clip.
    """

    def __init__(
        self,
        rows: Sequence[ClipRow],
        config: ClipSampling,
        *,
        views: Sequence[str],
        start_step: int,
        batch_size: int,
        seed: int,
        plan: BatchPlan = ALONE,
        vector_share: float = 0.0,
        where: str = "clips",
    ) -> None:
        self.vector_share, self.single_view_factor = vector_share, config.single_view_factor
        self.views, self.start_step, self.batch_size, self.seed, self.plan = views, start_step, batch_size, seed, plan
        self._view_weights = dict(sorted((config.view_weights or {JOINT: 1.0}).items()))
        slots = {row.episode_id: tuple(view for view in views if view in row.views) for row in rows}
        row_weights = {row.episode_id: config.source_weights.get(row.source, 1.0) for row in rows}
        self._kinds: list[_Kind] = []
        kind_weights: list[float] = []
        for length, stride in product(config.lengths, config.strides):
            fitting = [row for row in rows if longest_clip(row.num_frames, 0, stride) >= length]
            total = sum(row_weights[row.episode_id] for row in fitting)
            for shared in sorted({slots[row.episode_id] for row in fitting}, reverse=True):
                alike = [row for row in fitting if slots[row.episode_id] == shared]
                weights = [row_weights[row.episode_id] for row in alike]
                if sum(weights) > 0:
                    self._kinds.append(
                        _Kind(length, stride, shared, alike, np.cumsum(np.divide(weights, np.sum(weights))))
                    )
                    kind_weights.append(sum(weights) / total)
        if not self._kinds:
            longest = max((row.num_frames for row in rows), default=0)
            raise DataError(
                "No episode is long enough for any clip length.", where=where,
                expected=f"clips of {config.lengths} frames at strides {config.strides}",
                got=f"{len(rows)} episodes, the longest with {longest} frames",
            )  # fmt: skip
        self._kind_weights = np.divide(kind_weights, np.sum(kind_weights))
        self.longest = max(kind.length for kind in self._kinds)
        """Frames of the longest clips that are drawn."""

    def clips(self, index: int) -> ClipBatch:
        """The clips of this process's micro-step ``index``."""
        index, part = self.plan.drawn(index)
        random = np.random.Generator(np.random.Philox(key=[self.seed, index]))
        kind = self._kinds[int(random.choice(len(self._kinds), p=self._kind_weights))]
        choices, chosen = self._choices(kind.views), 0
        if set(self._view_weights) != {JOINT}:
            chosen = int(random.choice(len(choices), p=[share for _, share, _ in choices]))
        name, _, sets = choices[chosen]
        size = self.batch_size * (1 if name in (JOINT, SUBSET) else self.single_view_factor)
        views = sets[0] if len(sets) == 1 else sets[int(random.integers(len(sets)))]
        count, own = size * self.plan.together, slice(part * size, (part + 1) * size)
        draws = random.random((count, 2))[own]
        vectors = random.random((count, len(self.views)))[own] < self.vector_share
        numbers = np.minimum(np.searchsorted(kind.cumulative, draws[:, 0], side="right"), len(kind.rows) - 1)
        clips: list[Clip] = []
        for number, where, by_vector in zip(numbers.tolist(), draws[:, 1].tolist(), vectors, strict=True):
            row = kind.rows[number]
            starts = (row.num_frames - 1 - (kind.length - 1) * kind.stride) // self.start_step + 1
            start, shown = int(where * starts) * self.start_step, tuple(compress(self.views, by_vector))
            clips.append(Clip(row.episode_id, start, kind.length, kind.stride, shown))
        return ClipBatch(tuple(clips), views, primary=name == PRIMARY)

    def _choices(self, views: tuple[str, ...]) -> list[tuple[str, float, list[tuple[str, ...]]]]:
        """Name and share of the steps of each view weight, for clips with these of the slots, and the equally likely sets it shows."""
        sets = {PRIMARY: [(self.views[0],)], **{view: [(view,)] for view in views}}
        if views:
            sets |= {JOINT: [views], SUBSET: view_subsets(views)}
        weights = [weight * (name in sets) for name, weight in self._view_weights.items()]
        shares = np.divide(weights, np.sum(weights))
        return [(name, share, sets.get(name, [])) for name, share in zip(self._view_weights, shares, strict=True)]

    def view_sets(self, slots: tuple[str, ...]) -> tuple[tuple[str, ...], ...]:
        """Sets of the model's ``slots`` that `LEAST_SHARE` of the steps or more fill together."""
        shares: Counter[tuple[str, ...]] = Counter()
        for kind, share in zip(self._kinds, self._kind_weights, strict=True):
            for _, weight, sets in self._choices(kind.views):
                for views in sets:
                    shares[tuple(view for view in slots if view in views)] += share * weight / len(sets)
        return tuple(sorted(views for views, share in shares.items() if share >= LEAST_SHARE))

    def trained(self, slots: tuple[str, ...]) -> TrainedClips | None:
        """View sets and strides of the clips; None: all ``slots`` together, at stride 1."""
        strides = tuple(sorted({kind.stride for kind in self._kinds}))
        found = TrainedClips(view_sets=self.view_sets(slots), strides=strides)
        return None if found == TrainedClips(view_sets=(slots,), strides=(1,)) else found
