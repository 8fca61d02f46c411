"""Resets: the robot goes back to where it began at once, as when two attempts were recorded into one file."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from worldline_core.config.base import StrictModel
from worldline_core.filters.verdict import Curve, Verdict


class ResetConfig(StrictModel):
    """A reset covers most of the way back to the first pose within a moment, faster than the episode moves otherwise."""

    min_jump_rad: float = Field(default=0.15, gt=0, description="a shorter way home is jitter")
    home_share: float = Field(
        default=0.2, gt=0, lt=1, description="distance to the first pose after, relative to before the way home"
    )
    max_return_s: float = Field(default=0.7, gt=0, description="a slower way home is motion like any other")
    min_relative_step: float = Field(
        default=1.15, ge=1, description="a single step home, relative to the episode's other steps (90th percentile)"
    )
    min_relative_speed: float = Field(
        default=1.7, ge=1, description="mean speed of a way home of several steps, relative to the same"
    )


def way_home(joints: np.ndarray, fps: float, config: ResetConfig) -> tuple[int, int] | None:
    """Frames (last before, first after) of the first way home, or None.

    Args:
        joints: (n, j) [rad].
    """
    steps = np.abs(np.diff(joints, axis=0)).max(axis=1) if len(joints) > 1 else np.zeros(0)
    from_home = np.abs(joints - joints[0]).max(axis=1)
    longest = min(max(1, round(config.max_return_s * fps)), len(steps))
    for i, j in _candidates(from_home, steps, longest, config):
        usual = _usual(np.concatenate([steps[:i], steps[j:]]))
        if (from_home[i] - from_home[j]) / (j - i) > _least(j - i, config) * usual:
            # The way home may have begun before the part of it that leads straight there.
            begin = i
            while begin > max(j - longest, 0) and steps[begin - 1] > usual:
                begin -= 1
            return begin, j
    return None


def _candidates(from_home: np.ndarray, steps: np.ndarray, longest: int, config: ResetConfig) -> list[tuple[int, int]]:
    """Pairs of frames between which the robot comes home at a speed that may be unusual: earliest, then shortest, first."""
    ordered = np.sort(steps)
    pairs: list[tuple[int, int]] = []
    for span in range(1, longest + 1):
        # The slowest steps alone bound the usual speed of any others from below.
        least = _least(span, config) * _usual(ordered[: len(ordered) - span])
        before, after = from_home[:-span], from_home[span:]
        home = (before > config.min_jump_rad) & (after < config.home_share * before)
        quick = (before - after >= config.min_jump_rad) & ((before - after) / span > least)
        pairs += [(int(i), int(i) + span) for i in np.flatnonzero(home & quick)]
    return sorted(pairs, key=lambda pair: (pair[1], -pair[0]))


def _usual(steps: np.ndarray) -> float:
    return float(np.percentile(steps, 90)) if len(steps) else 0.0


def _least(span: int, config: ResetConfig) -> float:
    return config.min_relative_step if span == 1 else config.min_relative_speed


def detect_reset(joints: np.ndarray, fps: float, config: ResetConfig) -> Verdict:
    """Frames from the first way home on.

    Args:
        joints: (n, j) joint positions [rad], without grippers.
    """
    from_home = np.abs(joints - joints[0]).max(axis=1)
    found = way_home(joints, fps, config)
    bad = np.zeros(len(joints), dtype=bool)
    if found is not None:
        bad[found[0] + 1 :] = True
    return Verdict(
        "reset",
        True,  # the attempt before the way home stays, if it is long enough
        {
            "furthest_from_home_rad": float(from_home.max()),
            "reset_frame": None if found is None else found[0] + 1,
            "way_home_rad": None if found is None else float(from_home[found[0]] - from_home[found[1]]),
            "way_home_s": None if found is None else (found[1] - found[0]) / fps,
            "threshold_return_s": config.max_return_s,
        },
        bad,
        {"distance_from_home_rad": Curve(from_home, config.min_jump_rad)},
    )
