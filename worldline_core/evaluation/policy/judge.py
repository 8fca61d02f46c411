"""Judging one video: a judge states evidence, rules decide, and unsuccessful verdicts are verified.

Which frames a judge sees: appendix "Observation sampling". A success of the first pass stands. Otherwise (appendix
"Verification of unsuccessful predictions"): six late groups at higher resolution where there are several views; logical
reconciliation for state changes; a twelve-frame motion check for lifts and state changes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from worldline_core.evaluation.policy.evidence import (
    Evidence,
    EvidenceFamily,
    MotionEvidence,
    Reconciliation,
    establishes_success,
    motion_establishes_success,
    reconciliation_establishes_success,
    route,
)


@dataclass(frozen=True)
class Trajectory:
    """One video to be judged; nothing in it tells the recorded outcome.

    Attributes:
        frames: by view, uint8 (n, h, w, 3); the views are synchronised.
        points: (n, arms, 2) projected tool centres in the head view [px], to start a segmenter; or None.
    """

    instruction: str
    frames: Mapping[str, np.ndarray]
    fps: float
    points: np.ndarray | None = None

    @property
    def num_frames(self) -> int:
        return min(len(frames) for frames in self.frames.values())


@dataclass(frozen=True)
class Extracted[T]:
    """What a judge stated; ``well_formed`` is False when its answer could not be read (then every fact is null)."""

    evidence: T
    well_formed: bool = True


class Judge(Protocol):
    """Extracts evidence; three questions in the paper's order."""

    @property
    def name(self) -> str: ...

    def extract(
        self, trajectory: Trajectory, family: EvidenceFamily, indices: tuple[int, ...], height_px: int
    ) -> Extracted[Evidence]:
        """P3: facts visible at the given frames, resized to ``height_px``."""
        ...

    def reconcile(
        self, trajectory: Trajectory, selected: str, first: str, verification: str
    ) -> Extracted[Reconciliation]:
        """P4: whether the observations already made prove completion."""
        ...

    def inspect_motion(
        self, trajectory: Trajectory, indices: tuple[int, ...], earlier: str
    ) -> Extracted[MotionEvidence]:
        """P5: facts visible in the motion through the given frames of every view."""
        ...


FIRST_PASS_COUNT = 12
FIRST_PASS_HEIGHT_PX = 360
VERIFICATION_POSITIONS = (0.0, 0.65, 0.78, 0.88, 0.95, 1.0)
VERIFICATION_HEIGHT_PX = 480
MOTION_COUNT = 12


def first_pass_indices(num_frames: int, count: int = FIRST_PASS_COUNT) -> tuple[int, ...]:
    """Frames at sqrt(i / (count - 1)): more of them late, where success and failure differ."""
    return frames_at(np.sqrt(np.arange(count) / (count - 1)), num_frames)


def verification_indices(num_frames: int) -> tuple[int, ...]:
    """Six late groups, inspected at higher resolution."""
    return frames_at(VERIFICATION_POSITIONS, num_frames)


def motion_indices(num_frames: int, count: int = MOTION_COUNT) -> tuple[int, ...]:
    """Frames spread evenly over the whole video."""
    return frames_at(np.linspace(0.0, 1.0, count), num_frames)


def frames_at(positions: np.ndarray | tuple[float, ...], num_frames: int) -> tuple[int, ...]:
    """Nearest frames of normalised positions, in order; a frame that two positions share is shown once."""
    return tuple(sorted({round(float(position) * (num_frames - 1)) for position in positions}))


Pass = Literal["first_pass", "verification", "reconciliation", "motion"]


@dataclass(frozen=True)
class Judgement:
    """The decision, the pass that made it (the last one for a failure), and every statement on the way."""

    success: bool
    family: EvidenceFamily
    decided_by: Pass
    malformed_answers: int
    answers: int
    statements: tuple[tuple[Pass, dict[str, Any]], ...]


def judge_trajectory(judge: Judge, trajectory: Trajectory, family: EvidenceFamily | None = None) -> Judgement:
    """Judge one video; ``family`` None routes by the instruction."""
    family = family or route(trajectory.instruction)
    statements: list[tuple[Pass, dict[str, Any]]] = []
    malformed = 0

    def done(success: bool) -> Judgement:
        return Judgement(success, family, statements[-1][0], malformed, len(statements), tuple(statements))

    num_frames = trajectory.num_frames
    first = judge.extract(trajectory, family, first_pass_indices(num_frames), FIRST_PASS_HEIGHT_PX)
    statements.append(("first_pass", first.evidence.model_dump()))
    malformed += not first.well_formed
    if establishes_success(first.evidence):
        return done(True)

    # What later passes argue about: the newest evidence that could be read.
    selected: Evidence = first.evidence
    verification_text = ""
    if len(trajectory.frames) > 1:
        second = judge.extract(trajectory, family, verification_indices(num_frames), VERIFICATION_HEIGHT_PX)
        statements.append(("verification", second.evidence.model_dump()))
        malformed += not second.well_formed
        verification_text = second.evidence.observations
        if establishes_success(second.evidence):
            return done(True)
        if second.well_formed:
            selected = second.evidence

    if family == "state_change":
        answer = judge.reconcile(trajectory, selected.observations, first.evidence.observations, verification_text)
        statements.append(("reconciliation", answer.evidence.model_dump()))
        malformed += not answer.well_formed
        if reconciliation_establishes_success(answer.evidence, selected):
            return done(True)

    if family in ("lift", "state_change"):
        motion = judge.inspect_motion(trajectory, motion_indices(num_frames), selected.observations)
        statements.append(("motion", motion.evidence.model_dump()))
        malformed += not motion.well_formed
        if motion_establishes_success(motion.evidence, selected):
            return done(True)
    return done(False)
