"""What a detector says about an episode."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

Numbers = dict[str, float | int | str | None]


@dataclass(frozen=True)
class Curve:
    """What a detector measured frame by frame, (n,), and the value that it was held against."""

    values: np.ndarray
    threshold: float


@dataclass(frozen=True)
class Verdict:
    """Outcome of one detector.

    Attributes:
        reason: quarantine code.
        passed: whether the episode as a whole may stay.
        numbers: measured values, next to the thresholds they were held against.
        bad_frames: bool (n,) frames that must not be trained on, where the detector can tell.
        curves: by name, for `worldline inspect`.
    """

    reason: str
    passed: bool
    numbers: Mapping[str, float | int | str | None] = field(default_factory=dict)
    bad_frames: np.ndarray | None = None
    curves: Mapping[str, Curve] = field(default_factory=dict)

    @property
    def clean(self) -> bool:
        """Whether nothing at all was found."""
        return self.passed and (self.bad_frames is None or not self.bad_frames.any())


def runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """(start, stop) of each run of True in bool (n,)."""
    padded = np.concatenate([[False], flags.astype(bool), [False]]).astype(np.int8)
    edges = np.diff(padded)
    return list(zip(np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True))


def long_runs(flags: np.ndarray, shortest: float, gap: float = 0.0) -> np.ndarray:
    """bool (n,): runs of at least `shortest` frames, after gaps of at most `gap` frames between two runs were closed."""
    closed = flags.astype(bool).copy()
    for start, stop in runs(~closed):
        if start > 0 and stop < len(closed) and stop - start <= gap:
            closed[start:stop] = True
    kept = np.zeros(len(closed), dtype=bool)
    for start, stop in runs(closed):
        kept[start:stop] = stop - start >= shortest
    return kept
