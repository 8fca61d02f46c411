"""Verdicts of detectors, and the reason codes, each in one sentence; docs/filters.md explains them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

Numbers = dict[str, float | int | str | None]


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

    @property
    def clean(self) -> bool:
        """True when the episode passed and no frame is bad."""
        return self.passed and (self.bad_frames is None or not self.bad_frames.any())


def frame_verdict(
    reason: str, passed: bool, bad: np.ndarray, thresholds: Mapping[str, float], **numbers: float | str | None
) -> Verdict:
    """Verdict of a detector of bad frames (n,); the numbers are their share, the given ones and the thresholds."""
    named = {f"threshold_{name}": float(threshold) for name, threshold in thresholds.items()}
    return Verdict(reason, bool(passed), {"bad_share": float(bad.mean()), **numbers, **named}, bad)


@dataclass(frozen=True)
class Finding:
    """A verdict of a detector, with the view that it was given for (None: for the whole episode).

    `stage`: 1 when a failure drops the episode, 2 when it only excludes it from Stage II.
    """

    detector: str
    view: str | None
    stage: int
    verdict: Verdict


def bad_frames(found: Iterable[Finding], count: int, *detectors: str, view: str | None = None) -> np.ndarray:
    """bool (count,): frames that one of the named detectors (all, if none is named) called bad, in a view or in any."""
    bad = np.zeros(count, dtype=bool)
    for finding in found:
        named = not detectors or finding.detector in detectors
        if named and view in (None, finding.view) and finding.verdict.bad_frames is not None:
            bad |= finding.verdict.bad_frames
    return bad


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


REASONS: dict[str, str] = {
    "static": "Neither the robot nor the picture moves for longer than a pause of manipulation.",
    "reset": "The robot goes back to its first pose at once; what follows is another attempt.",
    "corrupted": "Pictures are blank, noise, garbled, or the same while the robot moves.",
    "too_dark": "Pictures are black or too dark to see anything in.",
    "overexposed": "Much of the sensor is saturated.",
    "blur": "Pictures have lost the finest detail.",
    "base_motion": "Nearly the whole picture changes: the chassis drives.",
    "joint_jump": "A joint reading jumps from one frame to the next.",
    "joint_speed": "A joint is faster than its motor can be.",
    "joint_stuck": "A joint reading stays the same while the joint is commanded to move.",
    "too_short": "Fewer usable frames than the shortest clip.",
    "unreadable": "The stored images or values cannot be read.",
    "missing_view": "A required view is not there.",
    "missing_calibration": "A required view, or every view, has no camera: for models of control vectors alone.",
    "missing_kinematics": "Neither tool poses nor the robot's description are known.",
    "missing_actions": "The source has pictures only.",
    "calibration": "K or camera poses cannot be right, or a usual mistake explains the recording better.",
    "calibration_unexplained": "Tools and pictures disagree, and no usual mistake explains it.",
    "not_judged": "Judging the calibration failed; the evidence says why, and the episode stays.",
    "projection": "Tools do not lie where the picture moves.",
    "time_alignment": "Pictures, camera poses and states show different instants.",
}
"""By code; a code that is not here is curation's or a later version's."""
