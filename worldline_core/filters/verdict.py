"""What a detector says about an episode."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Verdict:
    """Outcome of one detector.

    Attributes:
        reason: quarantine code.
        passed: whether the episode as a whole may stay.
        numbers: measured values, next to the thresholds they were held against.
        bad_frames: bool (n,) frames that must not be trained on, where the detector can tell.
    """

    reason: str
    passed: bool
    numbers: Mapping[str, float | int | str | None] = field(default_factory=dict)
    bad_frames: np.ndarray | None = None


def runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """(start, stop) of each run of True in bool (n,)."""
    padded = np.concatenate([[False], flags.astype(bool), [False]]).astype(np.int8)
    edges = np.diff(padded)
    return list(zip(np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True))
