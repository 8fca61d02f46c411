"""Units of joints and readings of grippers, by names, ranges, steps of the encoders, and the robot's limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldline_core.data.sources.lerobot import AngleUnit

MOST_RADIANS = 6.5
"""A joint that turns once, and a little; larger readings are degrees or a share of the range."""
_TICK_DEG = 360 / 4095
"""Step of the motors of LeRobot's own arms: readings in degrees are multiples of it, those of a range are not."""
_ON_GRID, _OFF_GRID = 0.97, 0.6
RANGES: tuple[tuple[float, float], ...] = (
    (0, 1),
    (0, 100),
    (0, 0.04),
    (0, 0.08),
    (0, 0.044),
    (0, 850),
    (0, 1000),
    (0, 255),
    (-1, 1),
)
"""Usual readings of grippers: shares, per cent, metres of a finger or between both, steps of some makers."""


def joint_unit(
    values: np.ndarray, names: Sequence[Sequence[str]], usual: AngleUnit | None
) -> tuple[AngleUnit, str, bool]:
    """The unit of joint readings (N, J), the evidence, and whether another one would fit as well.

    Args:
        names: words of each column.
        usual: what LeRobot records by default of this arm, where it is one of its own: degrees, or -100..100 of each range.
    """
    words = {word for name in names for word in name}
    most = float(np.abs(values).max())
    if "rad" in words:
        return "rad", f"the names say rad; readings to {most:.3g}", False
    if "deg" in words:
        return "deg", f"the names say deg; readings to {most:.4g}", False
    if most <= MOST_RADIANS:
        return "rad", f"no reading is above {most:.3g}, which in degrees would hardly be a motion", False
    if usual is None:
        return "deg", f"readings to {most:.4g}: more than a turn of a joint in radians", False
    if most > 100.5:
        return "deg", f"readings to {most:.4g}: beyond -100..100, LeRobot's other unit", False
    share = _share_on_ticks(values)
    if share >= _ON_GRID:
        return "deg", f"{share:.0%} of the steps are whole ticks of 360/4095 degrees, as the motors count", False
    ends = int((np.abs(values) >= 99.9995).any(axis=0).sum())
    if ends and most <= 100.0005:
        return "range_m100_100", f"{ends} joints stop at exactly 100 or -100, where LeRobot cuts its ranges off", False
    if 0 < share < _OFF_GRID and _is_quantised(values):
        return (
            "range_m100_100",
            f"only {share:.0%} of the steps are ticks of a motor in degrees, and all readings are within -100..100",
            False,
        )
    return (
        usual,
        f"readings to {most:.4g}: deg and range_m100_100 both fit; LeRobot's default for this arm is taken",
        True,
    )


def _steps(values: np.ndarray) -> np.ndarray:
    """Differences between neighbouring readings that changed."""
    steps = np.abs(np.diff(values, axis=0)).ravel()
    return steps[steps > 1e-4]


def _share_on_ticks(values: np.ndarray) -> float:
    steps = _steps(values) / _TICK_DEG
    return float((np.abs(steps - steps.round()) < 0.02).mean()) if len(steps) >= 20 else 0.0


def _is_quantised(values: np.ndarray) -> bool:
    """True where most joints only have readings a whole number of steps apart, as encoders give them."""
    return sum(map(_has_steps, values.T)) > values.shape[1] / 2


def _has_steps(column: np.ndarray) -> bool:
    gaps = np.diff(np.unique(column))
    gaps = gaps[gaps > 1e-4]
    if len(gaps) < 10:
        return False
    multiples = gaps / gaps.min()
    return float((np.abs(multiples - multiples.round()) < 0.05).mean()) >= 0.9


@dataclass(frozen=True)
class GripperReadings:
    """Readings at the two ends; None where they cannot be known."""

    ends: tuple[float, float]
    evidence: str
    open_is_high: bool | None


def gripper_readings(
    state: np.ndarray, command: np.ndarray | None, words: Sequence[str], *, open_is_high: bool | None, why: str
) -> GripperReadings:
    """Ends of a gripper's readings, and which is open.

    Args:
        state: readings of several episodes; `command` of the same frames.
        open_is_high, why: what the robot's makers state, where they do.
    """
    low, high = float(state.min()), float(state.max())
    span = high - low
    known = next(
        ((a, b) for a, b in RANGES if a - 0.1 * (b - a) <= low and high <= b + 0.1 * (b - a) and span >= 0.3 * (b - a)),
        None,
    )
    if ("rad" in words and known is None) or known is None:
        known = (float(np.percentile(state, 1)), float(np.percentile(state, 99)))
        if known[0] == known[1]:
            known = (low, high) if low != high else (low, low + 1)
        ends = f"readings {low:.4g} to {high:.4g}, whose ends are taken"
    else:
        ends = f"readings {low:.4g} to {high:.4g}: {known[0]:g} to {known[1]:g}"
    if open_is_high is not None:
        return GripperReadings(known, f"{ends}; {why}", open_is_high)
    if "open" in words or "opening" in words or "width" in words:
        return GripperReadings(known, f"{ends}; the name says that it opens upwards", True)
    if "close" in words or "closed" in words or "closure" in words:
        return GripperReadings(known, f"{ends}; the name says that it closes upwards", False)
    if command is not None and span > 0 and (found := _squeeze(state, command, span)) is not None:
        closes_down, share = found
        side = "below" if closes_down else "above"
        return GripperReadings(
            known,
            f"{ends}; at rest the command stays {side} the reading in {share:.0%} of the frames: it squeezes",
            closes_down,
        )
    return GripperReadings(known, ends, None)


def _squeeze(state: np.ndarray, command: np.ndarray, span: float) -> tuple[bool, float] | None:
    """True where grippers close towards low readings: a gripper that holds a thing cannot follow its command."""
    resting = np.abs(np.gradient(state)) < 0.01 * span
    gap = (command - state)[resting] / span
    far = gap[np.abs(gap) > 0.08]
    if len(far) < 10 or len(far) < 0.03 * len(gap):
        return None
    below = float((far < 0).mean())
    return (below > 0.5, max(below, 1 - below)) if max(below, 1 - below) > 0.9 else None
