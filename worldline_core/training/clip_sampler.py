"""Which clips a step trains on: a pure function of (seed, step, rank), so that a run needs no other state to continue.

Two orders. "weighted" draws clips without end by weights; "epochs" takes every clip once per epoch (`EpochOrder`).
Batches hold clips of one kind: one length, one stride, one set of views.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from worldline_core.errors import ConfigError, DataError
from worldline_core.model.contracts import TrainedClips
from worldline_core.training.clip_config import JOINT, ClipSampling
from worldline_core.training.clip_source import Clip, ClipBatch, ClipRow, ClipSource, longest_clip
from worldline_core.training.processes import ALONE, BatchPlan


@dataclass
class _Kind:
    """Clips of one length and stride, of episodes that lack the same optional views (``absent``).

    ``cumulative``: the rows' weights (in epochs: numbers of clips), added up.
    """

    length: int
    stride: int
    absent: tuple[str, ...]
    rows: list[ClipRow]
    cumulative: np.ndarray

    def starts(self, row: ClipRow, step: int) -> int:
        """How many frames of an episode, ``step`` apart, a clip may start at."""
        return (row.num_frames - 1 - (self.length - 1) * self.stride) // step + 1

    def clip(self, row: ClipRow, start: int) -> Clip:
        """The clip of an episode at a start frame."""
        return Clip(row.episode_id, start, self.length, self.stride)


class ClipSampler:
    """Draws batches of clips. Every process draws the same large batch and takes its own part.

    Args:
        source: where the clips are read from.
        batch_size: clips of a micro-batch.
        plan: which micro-batches are this process's, and how many are drawn as one.
        rows: the episodes to draw from (default: all of the source).

    Raises:
        ConfigError: clips of the source do not start at every hop.
        DataError: no episode is long enough for any clip.
    """

    def __init__(
        self,
        source: ClipSource,
        config: ClipSampling,
        *,
        splits: Sequence[str],
        batch_size: int,
        seed: int,
        plan: BatchPlan = ALONE,
        rows: Sequence[ClipRow] | None = None,
    ) -> None:
        if config.hop is not None and config.hop % source.start_step:
            raise ConfigError(
                "Clips cannot start at every hop.",
                where="clips.hop",
                expected=f"a multiple of {source.start_step}, the frames between possible starts",
                got=config.hop,
            )
        self.batch_size = batch_size
        self.single_view_factor = config.single_view_factor
        self.seed = seed
        self.plan = plan
        self.step = source.start_step
        self._view_names = sorted(config.view_weights or {})
        self._view_weights = _normalised([(config.view_weights or {})[name] for name in self._view_names])
        candidates = [row for row in (source.rows if rows is None else rows) if row.split in splits]
        self._kinds: list[_Kind] = []
        kind_weights: list[float] = []
        weights = config.length_weights or [1.0] * len(config.lengths)
        for length, weight in zip(config.lengths, weights, strict=True):
            for stride in config.strides:
                fitting = [row for row in candidates if longest_clip(row.num_frames, 0, stride) >= length]
                total = sum(config.source_weights.get(row.source, 1.0) for row in fitting)
                lacking = [config.absent_views(row.views) for row in fitting]
                for absent in sorted(set(lacking)):
                    rows_of = [row for row, missing in zip(fitting, lacking, strict=True) if missing == absent]
                    row_weights = [config.source_weights.get(row.source, 1.0) for row in rows_of]
                    if weight > 0 and sum(row_weights) > 0:
                        cumulative = np.cumsum(_normalised(row_weights))
                        self._kinds.append(_Kind(length, stride, absent, rows_of, cumulative))
                        kind_weights.append(weight * (sum(row_weights) / total))
        if not self._kinds:
            longest = max((row.num_frames for row in candidates), default=0)
            raise DataError(
                "No episode is long enough for any clip length.",
                where=f"clips of the splits {list(splits)}",
                expected=f"clips of {config.lengths} frames at strides {config.strides}",
                got=f"{len(candidates)} episodes, the longest with {longest} frames",
            )
        self._kind_weights = _normalised(kind_weights)
        self._epochs: EpochOrder | None = None
        if config.order == "epochs":
            self.step = config.hop or source.start_step
            for kind in self._kinds:
                kind.cumulative = np.cumsum([kind.starts(row, self.step) for row in kind.rows])
            counts = [int(kind.cumulative[-1]) for kind in self._kinds]
            self._epochs = EpochOrder(counts, batch_size * plan.together, seed)

    def clips(self, index: int) -> ClipBatch:
        """The clips of this process's micro-step ``index``."""
        index, part = self.plan.drawn(index)
        random = np.random.Generator(np.random.Philox(key=[self.seed, index]))
        number = int(random.choice(len(self._kinds), p=self._kind_weights))
        places: list[int] = []
        if self._epochs is not None:
            number, places = self._epochs.locate(index)
        kind, view = self._kinds[number], None
        if self._view_names:
            weights = self._weights_of_views(kind)
            name = self._view_names[int(random.choice(len(self._view_names), p=weights))]
            view = None if name == JOINT else name
        if self._epochs is not None:
            mine = places[part * self.batch_size : (part + 1) * self.batch_size]
            return ClipBatch(tuple(self._numbered(kind, place) for place in mine), view, kind.absent)
        size = self.batch_size * (1 if view is None else self.single_view_factor)
        return ClipBatch(self._drawn(random, kind, size, part), view, kind.absent)

    def _weights_of_views(self, kind: _Kind) -> np.ndarray:
        """Weights of what a step of this kind trains on: of views that its episodes lack, none."""
        if not kind.absent:
            return self._view_weights
        present = [name not in kind.absent for name in self._view_names]
        return _normalised([w * there for w, there in zip(self._view_weights, present, strict=True)])

    def replacement(self, index: int, place: int, attempt: int) -> Clip:
        """Another clip of the length, stride and views of micro-step ``index``, for its unreadable clip at ``place``.

        Drawn at random (by the weights; in epochs by the number of clips), from a stream of its own.
        """
        batch = self.clips(index)
        first = batch.clips[place]
        kinds = [(kind.length, kind.stride, kind.absent) for kind in self._kinds]
        number = kinds.index((first.num_frames, first.stride, batch.absent))
        index, part = self.plan.drawn(index)
        counter = [0, 0, 1 + attempt, 1 + place]
        random = np.random.Generator(np.random.Philox(key=[self.seed, index], counter=counter))
        if self._epochs is not None:
            places = random.integers(self._epochs.counts[number], size=self.plan.together)
            return self._numbered(self._kinds[number], int(places[part]))
        return self._drawn(random, self._kinds[number], 1, part)[0]

    @property
    def clips_per_epoch(self) -> int | None:
        """Clips of one epoch, or None where clips are drawn by weights."""
        return None if self._epochs is None else sum(self._epochs.counts)

    def epochs(self, index: int) -> float | None:
        """Epochs that the micro-steps before ``index`` make up on all processes, or None where clips are drawn by weights."""
        total = self.clips_per_epoch
        return None if total is None else index * self.batch_size * self.plan.world_size / total

    @property
    def longest(self) -> int:
        """Frames of the longest clip that is drawn."""
        return max(kind.length for kind in self._kinds)

    def trained(self, views: tuple[str, ...]) -> TrainedClips | None:
        """What the clips show of a model's view slots, and at which strides; None: all of them, at stride 1."""
        batches = [ClipBatch((), view, kind.absent) for kind in self._kinds for view, _ in self.batch_kinds]
        shown = {slot for batch in batches for slot in batch.slots(views)}
        found = TrainedClips(
            views=tuple(view for view in views if view in shown),
            strides=tuple(sorted({kind.stride for kind in self._kinds})),
        )
        return None if found == TrainedClips(views=views, strides=(1,)) else found

    @property
    def batch_kinds(self) -> list[tuple[str | None, int]]:
        """(view as in a ClipBatch, clips) of the kinds of batches that are drawn."""
        if not self._view_names:
            return [(None, self.batch_size)]
        drawn = [name for name, weight in zip(self._view_names, self._view_weights, strict=True) if weight > 0]
        factor = self.single_view_factor
        return [(None, self.batch_size) if name == JOINT else (name, self.batch_size * factor) for name in drawn]

    def _drawn(self, random: np.random.Generator, kind: _Kind, size: int, part: int) -> tuple[Clip, ...]:
        draws = random.random((size * self.plan.together, 2))  # per clip: which episode, which start
        return tuple(self._clip(kind, *draw) for draw in draws[part * size : (part + 1) * size])

    def _clip(self, kind: _Kind, which: float, where: float) -> Clip:
        row = kind.rows[min(int(np.searchsorted(kind.cumulative, which, side="right")), len(kind.rows) - 1)]
        return kind.clip(row, int(where * kind.starts(row, self.step)) * self.step)

    def _numbered(self, kind: _Kind, number: int) -> Clip:
        """The clip of this number among all clips of the kind, episode by episode."""
        place = int(np.searchsorted(kind.cumulative, number, side="right"))
        before = int(kind.cumulative[place - 1]) if place else 0
        return kind.clip(kind.rows[place], (number - before) * self.step)


def _normalised(weights: Sequence[float]) -> np.ndarray:
    values = np.asarray(weights, dtype=np.float64)
    total = values.sum()
    return values / total if total > 0 else values


_ROUNDS = 6
_MASK = (1 << 64) - 1


def permuted(position: int, count: int, key: int) -> int:
    """Image of ``position`` under a pseudo-random permutation of 0..count-1 chosen by ``key``.

    A Feistel network over the next even number of bits, walked until it falls below ``count`` (cycle walking; Black and
    Rogaway 2002, "Ciphers with arbitrary finite domains").
    """
    if count <= 1:
        return position
    half = max(1, ((count - 1).bit_length() + 1) // 2)
    low = (1 << half) - 1
    while True:
        left, right = position >> half, position & low
        for turn in range(_ROUNDS):
            left, right = right, left ^ (_mixed(right + (turn << 32) + key) & low)
        position = (left << half) | right
        if position < count:
            return position


def _mixed(value: int) -> int:
    """The finaliser of splitmix64 (Steele, Lea and Flood 2014)."""
    value = (value + 0x9E3779B97F4A7C15) & _MASK
    value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
    value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) & _MASK
    return value ^ (value >> 31)


def mixed_key(*parts: int) -> int:
    """One 64-bit key of several numbers."""
    key = 0
    for part in parts:
        key = _mixed(key ^ _mixed(part))
    return key


class EpochOrder:
    """Batches of clip numbers in which every clip comes once per epoch: a function of the batch's number and the seed.

    Clips are numbered within their kind, and the numbers of an epoch pass through a keyed permutation, so that a corpus of
    10^8 clips needs no table. Batches hold clips of one kind and are always full: what does not fill a batch at the end of
    an epoch (for each kind, fewer clips than a batch has) goes into the next epoch's. Nothing is lost, and no clip comes
    more often than there are epochs.

    Args:
        counts: number of clips of each kind.
        batch: clips per batch, all processes together.
    """

    def __init__(self, counts: Sequence[int], batch: int, seed: int) -> None:
        self.counts = list(counts)
        self.batch = batch
        self.seed = seed

    def batches_before(self, epoch: int) -> int:
        """Batches of all epochs before ``epoch``."""
        return sum(epoch * count // self.batch for count in self.counts)

    def epoch(self, index: int) -> int:
        """The epoch that batch ``index`` belongs to."""
        # An epoch lacks, for each kind, at most what does not fill a batch.
        most = (index + 1 + len(self.counts)) * self.batch // sum(self.counts) + 1
        return bisect_right(range(most + 1), index, key=self.batches_before) - 1

    def locate(self, index: int) -> tuple[int, list[int]]:
        """(kind, numbers of the batch's clips within the kind) of batch ``index``."""
        epoch = self.epoch(index)
        firsts = [epoch * count // self.batch for count in self.counts]
        sizes = [(epoch + 1) * count // self.batch - first for count, first in zip(self.counts, firsts, strict=True)]
        before = self.batches_before(epoch)
        place = permuted(index - before, sum(sizes), mixed_key(self.seed, epoch))
        ends = list(accumulate(sizes))
        kind = bisect_right(ends, place)
        number = firsts[kind] + place - (ends[kind] - sizes[kind])
        return kind, [self._clip(kind, item) for item in range(number * self.batch, (number + 1) * self.batch)]

    def _clip(self, kind: int, item: int) -> int:
        epoch, position = divmod(item, self.counts[kind])
        return permuted(position, self.counts[kind], mixed_key(self.seed, epoch, kind + 1))
