"""Which clips a step trains on: a pure function of (seed, step, rank), so that a run needs no other state to continue.

Two orders. "weighted" draws clips without end by weights. "epochs" takes every clip once per epoch: clips are numbered
within their kind (length and stride), and the numbers of an epoch pass through a keyed permutation, so that a corpus of
10^8 clips needs no table. Batches hold clips of one kind and are always full: what does not fill a batch at the end of
an epoch (for each kind, fewer clips than a batch has) goes into the next epoch's. Nothing is lost, and no clip comes more
often than there are epochs.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from worldline_core.actions.action_maps import TEMPORAL_FACTOR
from worldline_core.config import StrictModel
from worldline_core.errors import ConfigError, DataError
from worldline_core.training.clip_source import Clip, ClipBatch, ClipRow, ClipSource, longest_clip

JOINT = "joint"
"""In place of a view's name: all views of the model together."""

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
    """Batches of clip numbers in which every clip comes once per epoch.

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


def _lengths(value: Any) -> Any:
    """``{from: 33, to: 129}`` (``step``: 4 unless given) as the lengths that it means."""
    if not isinstance(value, Mapping):
        return value
    if not {"from", "to"} <= set(value) <= {"from", "to", "step"} or not all(
        isinstance(v, int) for v in value.values()
    ):
        raise ValueError("a range of clip lengths has the whole numbers `from`, `to` and perhaps `step`")
    step = value.get("step", TEMPORAL_FACTOR)
    if step < 1 or step % TEMPORAL_FACTOR or value["to"] < value["from"]:
        raise ValueError(f"a range of clip lengths rises in steps of a multiple of {TEMPORAL_FACTOR} frames")
    return tuple(range(value["from"], value["to"] + 1, step))


class ClipSampling(StrictModel):
    """How clips are drawn.

    ``lengths``: clip lengths in video frames (4 k + 1), drawn with ``length_weights`` (default: equal); a list, or
    ``{from: 33, to: 129}`` for all of them. ``strides``: temporal strides.
    ``source_weights``: weight of an episode by its source (default 1).
    ``view_weights``: None trains all views jointly (Stage II); otherwise what a step trains on is drawn by these
    weights: the name of a view, "primary" (each episode's own task-facing view; Stage I), or "joint" (all views).
    Steps on one view cost a fraction of joint ones and teach most of what controls look like: where compute is short,
    a mixture learns faster. ``single_view_factor`` multiplies the batch of such steps.
    ``order``: "weighted" draws without end by the weights; "epochs" takes every clip (each length and stride at every
    ``hop``-th frame of every episode) once per epoch, and allows no weights of lengths and sources.
    ``hop``: frames between the starts of neighbouring clips of an epoch (default: the smallest that the source has).
    """

    lengths: Annotated[tuple[int, ...], BeforeValidator(_lengths)] = Field(default=(33,), min_length=1)
    length_weights: tuple[float, ...] | None = None
    strides: tuple[int, ...] = Field(default=(1,), min_length=1)
    source_weights: dict[str, float] = Field(default_factory=dict)
    view_weights: dict[str, float] | None = None
    single_view_factor: int = Field(default=1, ge=1)
    # Left out of dumps at their defaults: what was made before they existed keeps its key in the store.
    order: Literal["weighted", "epochs"] = Field(default="weighted", exclude_if=lambda value: value == "weighted")
    hop: int | None = Field(default=None, ge=1, exclude_if=lambda value: value is None)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        odd = [length for length in self.lengths if length < 1 or (length - 1) % TEMPORAL_FACTOR]
        if odd:
            raise ValueError(f"lengths {odd}: a causal tokenizer codes clips of 4 k + 1 frames")
        if self.length_weights is not None and len(self.length_weights) != len(self.lengths):
            raise ValueError(f"length_weights: every one of the {len(self.lengths)} clip lengths needs one weight")
        if self.order == "weighted" and self.hop is not None:
            raise ValueError("hop: only epochs have one; set order to epochs, or leave it out")
        weighted = self.length_weights is not None or self.source_weights or self.single_view_factor != 1
        if self.order == "epochs" and weighted:
            raise ValueError(
                "order: epochs take every clip once, so they allow neither length_weights nor source_weights nor a "
                "single_view_factor; take order weighted, or leave them out"
            )
        return self


@dataclass
class _Kind:
    """Clips of one length and stride. ``cumulative``: the rows' weights (in epochs: numbers of clips), added up."""

    length: int
    stride: int
    rows: list[ClipRow]
    cumulative: np.ndarray

    def starts(self, row: ClipRow, step: int) -> int:
        """How many frames of an episode, ``step`` apart, a clip may start at."""
        return (row.num_frames - 1 - (self.length - 1) * self.stride) // step + 1

    def clip(self, row: ClipRow, start: int) -> Clip:
        """The clip of an episode at a start frame."""
        return Clip(row.episode_id, start, self.length, self.stride)


class ClipSampler:
    """Draws batches of clips. Every rank draws the same global batch and takes its own part.

    Args:
        source: where the clips are read from.
        batch_size: clips per micro-step on this rank.
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
        rank: int = 0,
        world_size: int = 1,
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
        self.rank = rank
        self.world_size = world_size
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
                row_weights = [config.source_weights.get(row.source, 1.0) for row in fitting]
                if weight > 0 and sum(row_weights) > 0:
                    self._kinds.append(_Kind(length, stride, fitting, np.cumsum(_normalised(row_weights))))
                    kind_weights.append(weight)
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
            self._epochs = EpochOrder(counts, batch_size * world_size, seed)

    def clips(self, index: int) -> ClipBatch:
        """The clips of micro-step ``index`` (of this rank)."""
        random = np.random.Generator(np.random.Philox(key=[self.seed, index]))
        number = int(random.choice(len(self._kinds), p=self._kind_weights))
        view = None
        if self._view_names:
            name = self._view_names[int(random.choice(len(self._view_names), p=self._view_weights))]
            view = None if name == JOINT else name
        if self._epochs is not None:
            number, places = self._epochs.locate(index)
            mine = places[self.rank * self.batch_size : (self.rank + 1) * self.batch_size]
            return ClipBatch(tuple(self._numbered(self._kinds[number], place) for place in mine), view)
        size = self.batch_size * (1 if view is None else self.single_view_factor)
        return ClipBatch(self._drawn(random, self._kinds[number], size), view)

    def replacement(self, index: int, place: int, attempt: int) -> Clip:
        """Another clip of the length and stride of micro-step ``index``, for its unreadable clip at ``place``.

        Drawn at random (by the weights; in epochs by the number of clips), from a stream of its own.
        """
        first = self.clips(index).clips[place]
        number = [(kind.length, kind.stride) for kind in self._kinds].index((first.num_frames, first.stride))
        counter = [0, 0, 1 + attempt, 1 + place]
        random = np.random.Generator(np.random.Philox(key=[self.seed, index], counter=counter))
        if self._epochs is not None:
            places = random.integers(self._epochs.counts[number], size=self.world_size)
            return self._numbered(self._kinds[number], int(places[self.rank]))
        return self._drawn(random, self._kinds[number], 1)[0]

    @property
    def clips_per_epoch(self) -> int | None:
        """Clips of one epoch, or None where clips are drawn by weights."""
        return None if self._epochs is None else sum(self._epochs.counts)

    def epochs(self, index: int) -> float | None:
        """Epochs that the micro-steps before ``index`` make up, or None where clips are drawn by weights."""
        total = self.clips_per_epoch
        return None if total is None else index * self.batch_size * self.world_size / total

    @property
    def longest(self) -> int:
        """Frames of the longest clip that is drawn."""
        return max(kind.length for kind in self._kinds)

    @property
    def batch_kinds(self) -> list[tuple[str | None, int]]:
        """(view as in a ClipBatch, clips) of the kinds of batches that are drawn."""
        if not self._view_names:
            return [(None, self.batch_size)]
        drawn = [name for name, weight in zip(self._view_names, self._view_weights, strict=True) if weight > 0]
        factor = self.single_view_factor
        return [(None, self.batch_size) if name == JOINT else (name, self.batch_size * factor) for name in drawn]

    def _drawn(self, random: np.random.Generator, kind: _Kind, size: int) -> tuple[Clip, ...]:
        draws = random.random((size * self.world_size, 2))  # per clip: which episode, which start
        return tuple(self._clip(kind, *draw) for draw in draws[self.rank * size : (self.rank + 1) * size])

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
