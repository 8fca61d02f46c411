"""Which joints of a recording leave their limits, and by how much."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class LimitViolation:
    """A joint that leaves its limits: frames outside, and the furthest value with its frame, in `unit` (or metres)."""

    joint: str
    frames: int
    worst: float
    worst_frame: int
    lower: float
    upper: float
    unit: str

    @property
    def excess(self) -> float:
        """How far the worst value is beyond its limit."""
        return max(self.lower - self.worst, self.worst - self.upper)


def limit_violations(
    state: np.ndarray,
    outside: np.ndarray,
    limits: Mapping[int, tuple[float, float]],
    names: Sequence[str],
    unit: str,
) -> list[LimitViolation]:
    """The joints with a frame outside, the furthest first.

    Args:
        state: (N, J).
        outside: (N, J) bool, as `Embodiment.outside_limits` gives.
        limits: lower and upper by column.
    """
    found: list[LimitViolation] = []
    for column in map(int, np.flatnonzero(outside.any(axis=0))):
        lower, upper = limits[column]
        values = state[:, column].astype(np.float64)
        frame = int(np.argmax(np.maximum(lower - values, values - upper)))
        count = int(outside[:, column].sum())
        found.append(LimitViolation(names[column], count, float(values[frame]), frame, lower, upper, unit))
    return sorted(found, key=lambda violation: -violation.excess)
