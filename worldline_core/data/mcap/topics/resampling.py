"""Measurements at their own times brought to instants of a fixed rate, with the error that this makes.

The error of an instant is its distance in time to the nearest measurement. For what is interpolated, the error in value is
measured too: every inner measurement is predicted from its two neighbours, which lie about twice as far apart as those
between which the grid is filled, so the figure bounds that of the grid from above for smooth motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

NANOSECONDS = 1e9


@dataclass(frozen=True)
class TimeError:
    """Distance [ms] between instants and the measurements they were made of."""

    max_ms: float
    mean_ms: float

    @classmethod
    def of(cls, times_ns: np.ndarray, grid_ns: np.ndarray) -> TimeError:
        """Of instants (t,) against the nearest of the measurements (n,), both ascending."""
        distance = np.abs(times_ns[nearest(times_ns, grid_ns)] - grid_ns) / 1e6
        return cls(float(distance.max()), float(distance.mean()))


def nearest(times_ns: np.ndarray, grid_ns: np.ndarray) -> np.ndarray:
    """(t,) index of the measurement nearest to each instant; of two equally near ones the earlier."""
    right = np.clip(np.searchsorted(times_ns, grid_ns), 1, max(len(times_ns) - 1, 1))
    if len(times_ns) == 1:
        return np.zeros(len(grid_ns), dtype=np.int64)
    left = right - 1
    return np.where(grid_ns - times_ns[left] <= times_ns[right] - grid_ns, left, right)


def hold(times_ns: np.ndarray, values: np.ndarray, grid_ns: np.ndarray) -> np.ndarray:
    """(t, ...) the last measurement at or before each instant (the first, where there is none before)."""
    return values[np.maximum(np.searchsorted(times_ns, grid_ns, side="right") - 1, 0)]


def _bracket(times_ns: np.ndarray, grid_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(t,) index of the measurement before each instant, and how far between it and the next the instant lies, 0..1."""
    before = np.clip(np.searchsorted(times_ns, grid_ns, side="right") - 1, 0, len(times_ns) - 2)
    step = (times_ns[before + 1] - times_ns[before]).astype(np.float64)
    return before, np.clip((grid_ns - times_ns[before]) / step, 0.0, 1.0)


def linear(times_ns: np.ndarray, values: np.ndarray, grid_ns: np.ndarray) -> np.ndarray:
    """(t, d) from values (n, d) at strictly ascending times; constant beyond the ends."""
    if len(times_ns) == 1:
        return np.repeat(values, len(grid_ns), axis=0)
    before, share = _bracket(times_ns, grid_ns)
    return values[before] + share[:, None] * (values[before + 1] - values[before])


def slerp(a: np.ndarray, b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Unit quaternions (t, 4) on the shorter arc from a to b at 0..1; any order of the components.

    Shoemake, Animating rotation with quaternion curves, 1985.
    """
    cosine = np.sum(a * b, axis=1)
    b = np.where(cosine[:, None] < 0, -b, b)
    angle = np.arccos(np.clip(np.abs(cosine), -1.0, 1.0))
    sine = np.sin(angle)
    near = sine < 1e-9  # sin(k x) / sin(x) -> k
    safe = np.where(near, 1.0, sine)
    weight_a = np.where(near, 1 - share, np.sin((1 - share) * angle) / safe)
    weight_b = np.where(near, share, np.sin(share * angle) / safe)
    mixed = weight_a[:, None] * a + weight_b[:, None] * b
    return mixed / np.linalg.norm(mixed, axis=1, keepdims=True)


def poses(times_ns: np.ndarray, values: np.ndarray, grid_ns: np.ndarray) -> np.ndarray:
    """(t, 7) from poses (n, 7) x y z qx qy qz qw: linear in place, slerp in rotation; constant beyond the ends.

    Quaternions must be of unit length.
    """
    if len(times_ns) == 1:
        return np.repeat(values, len(grid_ns), axis=0)
    before, share = _bracket(times_ns, grid_ns)
    place = values[before, :3] + share[:, None] * (values[before + 1, :3] - values[before, :3])
    return np.concatenate([place, slerp(values[before, 3:], values[before + 1, 3:], share)], axis=1)


def largest_prediction_error(times_ns: np.ndarray, values: np.ndarray) -> float:
    """Largest distance, in the unit of values (n, d), between an inner measurement and the line through its neighbours."""
    if len(times_ns) < 3:
        return 0.0
    share = (times_ns[1:-1] - times_ns[:-2]) / (times_ns[2:] - times_ns[:-2])
    predicted = values[:-2] + share[:, None] * (values[2:] - values[:-2])
    return float(np.abs(predicted - values[1:-1]).max())


def instants(start_ns: int, stop_ns: int, fps: float) -> np.ndarray:
    """(t,) start, start + 1 / fps, ... up to stop; a nanosecond of rounding is forgiven. Empty when stop < start."""
    count = int(np.floor((stop_ns - start_ns) * fps / NANOSECONDS + 1e-6)) + 1
    return start_ns + np.round(np.arange(max(count, 0)) * (NANOSECONDS / fps)).astype(np.int64)
