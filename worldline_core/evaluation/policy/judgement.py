"""One trajectory's verdict: first pass, then conditional verification (appendix "Verification of unsuccessful predictions").

A success of the first pass stands. Otherwise: six late groups at higher resolution where the views are several;
logical reconciliation for state changes; a twelve-frame motion check for lifts and state changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from worldline_core.evaluation.policy.evidence import Evidence, EvidenceFamily
from worldline_core.evaluation.policy.frame_sampling import (
    FIRST_PASS_HEIGHT_PX,
    VERIFICATION_HEIGHT_PX,
    first_pass_indices,
    motion_indices,
    verification_indices,
)
from worldline_core.evaluation.policy.judge import Judge, Trajectory
from worldline_core.evaluation.policy.routing import route
from worldline_core.evaluation.policy.rules import (
    establishes_success,
    motion_establishes_success,
    reconciliation_establishes_success,
)

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
