"""Deterministic clip sampling: which clips a step trains on is a pure function of (seed, step)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from worldline_core.config.base import StrictModel
from worldline_core.errors import ConfigError, DataError
from worldline_core.training.latent_store import LatentRow, LatentStore

PRIMARY = "primary"
JOINT = "joint"


class ClipSampling(StrictModel):
    """How clips are drawn.

    ``lengths``: clip lengths in video frames (4 k + 1), drawn with ``length_weights`` (default: equal).
    ``strides``: temporal strides. ``source_weights``: weight of an episode by its source (default 1).
    ``view_weights``: None trains all views jointly (Stage II); otherwise what a step trains on is drawn by these
    weights: the name of a view, "primary" (each episode's own task-facing view; Stage I), or "joint" (all views).
    Steps on one view cost a fraction of joint ones and teach most of what controls look like: where compute is short,
    a mixture learns faster. ``single_view_factor`` multiplies the batch of such steps.
    """

    lengths: tuple[int, ...] = Field(default=(33,), min_length=1)
    length_weights: tuple[float, ...] | None = None
    strides: tuple[int, ...] = Field(default=(1,), min_length=1)
    source_weights: dict[str, float] = Field(default_factory=dict)
    view_weights: dict[str, float] | None = None
    single_view_factor: int = Field(default=1, ge=1)


@dataclass(frozen=True)
class Clip:
    """``num_frames`` frames at ``start``, ``start + stride``, ... of an episode."""

    episode_id: str
    start: int
    num_frames: int
    stride: int


@dataclass(frozen=True)
class ClipBatch:
    """Clips of equal length that share their views. ``views`` is None for all views, else one view or "primary"."""

    clips: tuple[Clip, ...]
    view: str | None


class ClipSampler:
    """Draws batches of clips. Every rank draws the same global batch and takes its own part."""

    def __init__(
        self,
        store: LatentStore,
        config: ClipSampling,
        *,
        splits: Sequence[str],
        batch_size: int,
        seed: int,
        rank: int = 0,
        world_size: int = 1,
        rows: Sequence[LatentRow] | None = None,
    ) -> None:
        if config.length_weights is not None and len(config.length_weights) != len(config.lengths):
            raise ConfigError(
                "Every clip length needs one weight.",
                where="clips.length_weights",
                expected=len(config.lengths),
                got=len(config.length_weights),
            )
        self.store = store
        self.batch_size = batch_size
        self.single_view_factor = config.single_view_factor
        self.seed = seed
        self.rank = rank
        self.world_size = world_size
        self._view_names = sorted(config.view_weights or {})
        self._view_weights = _normalised([(config.view_weights or {})[name] for name in self._view_names])
        candidates = [row for row in (store.rows if rows is None else rows) if row.split in splits]
        self._kinds: list[tuple[int, int]] = []
        kind_weights: list[float] = []
        self._rows: list[list[LatentRow]] = []
        self._cumulative: list[np.ndarray] = []
        weights = config.length_weights or [1.0] * len(config.lengths)
        for length, weight in zip(config.lengths, weights, strict=True):
            for stride in config.strides:
                fitting = [row for row in candidates if store.max_frames(row, 0, stride) >= length]
                row_weights = [config.source_weights.get(row.source, 1.0) for row in fitting]
                if weight > 0 and sum(row_weights) > 0:
                    self._kinds.append((length, stride))
                    kind_weights.append(weight)
                    self._rows.append(fitting)
                    self._cumulative.append(np.cumsum(_normalised(row_weights)))
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
        """The clips of micro-step ``index`` (of this rank)."""
        random = np.random.Generator(np.random.Philox(key=[self.seed, index]))
        kind = int(random.choice(len(self._kinds), p=self._kind_weights))
        view = None
        if self._view_names:
            name = self._view_names[int(random.choice(len(self._view_names), p=self._view_weights))]
            view = None if name == JOINT else name
        length, stride = self._kinds[kind]
        size = self.batch_size * (1 if view is None else self.single_view_factor)
        draws = random.random((size * self.world_size, 2))
        mine = draws[self.rank * size : (self.rank + 1) * size]
        return ClipBatch(tuple(self._clip(kind, length, stride, draw) for draw in mine), view)

    def _clip(self, kind: int, length: int, stride: int, draw: np.ndarray) -> Clip:
        rows, cumulative = self._rows[kind], self._cumulative[kind]
        row = rows[min(int(np.searchsorted(cumulative, draw[0], side="right")), len(rows) - 1)]
        last_start = row.num_frames - 1 - (length - 1) * stride
        choices = last_start // self.store.start_step + 1
        return Clip(row.episode_id, int(draw[1] * choices) * self.store.start_step, length, stride)


def _normalised(weights: Sequence[float]) -> np.ndarray:
    values = np.asarray(weights, dtype=np.float64)
    total = values.sum()
    return values / total if total > 0 else values


def source_counts(rows: Sequence[LatentRow]) -> Mapping[str, int]:
    """Episodes a source, for the checkpoint's metadata."""
    counts: dict[str, int] = {}
    for row in rows:
        counts[row.source] = counts.get(row.source, 0) + 1
    return dict(sorted(counts.items()))
