"""The embedded default judge: the same evidence schemas, filled by measuring instead of by a language model.

It follows things that the instruction names by colour. What it cannot see is null, as for any other judge. `measure` and
`score` also serve the measured selector of planning. Thresholds and widths were chosen on training recordings only.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

import numpy as np

from worldline_core.evaluation.policy.evidence import (
    SCHEMAS,
    Evidence,
    EvidenceFamily,
    GraspEvidence,
    LiftEvidence,
    MotionEvidence,
    Reconciliation,
    StateChangeEvidence,
    establishes_success,
    route,
)
from worldline_core.evaluation.policy.judge import Extracted
from worldline_core.evaluation.policy.measurements import (
    LATE_COUNT,
    LiftMeasurement,
    PlaceMeasurement,
    PressMeasurement,
    PushMeasurement,
    measure_lift,
    measure_place,
    measure_press,
    measure_push,
)
from worldline_core.evaluation.recordings import HEAD, Trajectory
from worldline_core.evaluation.segmenters.coloured_things import named_things
from worldline_core.evaluation.segmenters.segmenter import Segmenter

Measurement = LiftMeasurement | PlaceMeasurement | PushMeasurement | PressMeasurement

MIN_RISE, RISE_WIDTH = 0.3, 0.25
MIN_VACATED = 0.6
DROP_PEAK = 1.0
MIN_HELD = 0.6
MAX_DISTANCE, DISTANCE_WIDTH = 0.5, 0.12
MAX_REMAINING, REMAINING_WIDTH = 0.56, 0.12
MIN_RETREAT, RETREAT_WIDTH = 0.53, 0.12
MIN_GROWTH, GROWTH_WIDTH = 1.7, 0.2
UNSEEN_SCORE = 0.25

# What is to be pressed; what is to be pushed in or closed.
_PRESSING = re.compile(r"\bpress(es|ed|ing)?\b")
_CLOSING = re.compile(r"\b(clos(e|ed|ing)|shut|push(ed|ing)?|slid(e|ing))\b")


def lift_facts(measured: LiftMeasurement, name: str, family: EvidenceFamily) -> Evidence:
    """Facts of a grasp or a lift."""
    held = None if measured.held is None else measured.held >= MIN_HELD
    raised = None if measured.rise is None else measured.rise > MIN_RISE
    dropped = None
    if measured.rise is not None and measured.peak is not None:
        dropped = measured.peak > DROP_PEAK and measured.rise < MIN_RISE / 2
    elif measured.rise is None and held and measured.vacated is not None and measured.vacated > MIN_VACATED:
        # Hidden behind the gripper in the head view, but in the hand of a wrist view, and gone from where it rested.
        raised, dropped = True, False
    words = f"{name}: rose {_text(measured.rise)} of its size, {_text(measured.peak)} at most; held in {_text(measured.held)} of the late steps"
    if family == "grasp":
        return GraspEvidence(target_held_for_two_late_steps=held, wrong_object_or_drop=dropped, observations=words)
    return LiftEvidence(
        head_view_confirms_target_displacement=raised,
        target_held_for_two_late_steps=held,
        target_on_original_support_at_end=None if raised is None else not raised,
        wrong_object_or_drop=dropped,
        observations=words,
    )


def score(measured: Measurement) -> float:
    """How likely the task is done, 0..1: the facts above with soft thresholds, multiplied."""
    if isinstance(measured, LiftMeasurement):
        hidden = max(UNSEEN_SCORE, 0.8 * (measured.vacated or 0.0))
        rise = hidden if measured.rise is None else _above(measured.rise, MIN_RISE, RISE_WIDTH)
        return rise * (UNSEEN_SCORE if measured.held is None else 0.1 + 0.9 * measured.held)
    if isinstance(measured, PlaceMeasurement):
        if measured.distance is None:
            return UNSEEN_SCORE
        return _above(-measured.distance, -MAX_DISTANCE, DISTANCE_WIDTH)
    if isinstance(measured, PressMeasurement):
        return UNSEEN_SCORE if measured.growth is None else _above(measured.growth, MIN_GROWTH, GROWTH_WIDTH)
    if measured.remaining is None:
        return UNSEEN_SCORE
    retreat = 1.0 if measured.retreat is None else _above(measured.retreat, MIN_RETREAT, RETREAT_WIDTH)
    return retreat * _above(-measured.remaining, -MAX_REMAINING, REMAINING_WIDTH)


def _above(value: float, threshold: float, width: float) -> float:
    return 1.0 / (1.0 + math.exp(-max(-60.0, min(60.0, (value - threshold) / width))))


def _text(value: float | None) -> str:
    return "(not visible)" if value is None else f"{value:.2f}"


def measure(
    segmenter: Segmenter,
    instruction: str,
    family: EvidenceFamily,
    frames: Mapping[str, np.ndarray],
    points: np.ndarray | None,
) -> Measurement | None:
    """Measure what the family's facts need, on chosen frames (n, h, w, 3) of each view.

    None without a head view, when the instruction does not name what to follow by a colour, or asks for an effect that this cannot measure
    (it measures holding, lifting, placing one thing on another, closing, and pressing what then lights up).
    """
    things = named_things(instruction)
    if len(things) == 0 or HEAD not in frames or len(frames[HEAD]) < LATE_COUNT:
        return None
    if family in ("grasp", "lift"):
        return measure_lift(frames, things[0], _robot_late(segmenter, frames[HEAD], points))
    if len(things) > 1:
        return measure_place(frames, things[0], things[1])
    if _PRESSING.search(instruction.lower()):
        return measure_press(frames, things[0])
    if _CLOSING.search(instruction.lower()):
        return measure_push(frames, things[0], _robot_late(segmenter, frames[HEAD], points))
    return None


def facts(measured: Measurement | None, instruction: str, family: EvidenceFamily) -> Evidence:
    """The family's evidence from a measurement.

    Placed is what lies at its destination; closed is what little is left of, and whose edge has retreated; pressed is
    what has lit up.
    """
    if measured is None:
        return SCHEMAS[family](observations="nothing in the instruction can be followed by its colour")
    names = [f"{thing.colour} {thing.noun}" for thing in named_things(instruction)]
    if isinstance(measured, LiftMeasurement):
        return lift_facts(measured, names[0], family)
    done = None
    if isinstance(measured, PlaceMeasurement):
        if measured.distance is not None:
            done = measured.distance < MAX_DISTANCE
        words = f"{names[0]}: {_text(measured.distance)} destination sizes from the {names[1]} in the end"
    elif isinstance(measured, PressMeasurement):
        if measured.growth is not None:
            done = measured.growth > MIN_GROWTH
        words = f"{names[0]}: its colour fills {_text(measured.growth)} times its first area in the end"
    else:
        if measured.remaining is not None:
            retreated = measured.retreat is None or measured.retreat > MIN_RETREAT
            done = measured.remaining < MAX_REMAINING and retreated
        left, moved = _text(measured.remaining), _text(measured.retreat)
        words = f"{names[0]}: {left} of it still visible, edge moved in by {moved} of its size"
    dropped = None if done is None else False
    return StateChangeEvidence(required_final_state_visible=done, wrong_object_or_drop=dropped, observations=words)


def _robot_late(segmenter: Segmenter, head: np.ndarray, points: np.ndarray | None) -> np.ndarray:
    """Robot masks of the last frames; a segmenter that follows the robot from the first frame sees all of them."""
    if segmenter.follows:
        return segmenter.segment(head, points)[-LATE_COUNT:]
    return segmenter.segment(head[-LATE_COUNT:], None if points is None else points[-LATE_COUNT:])


class MeasuredEvidenceJudge:
    """Colour tracking in the head view, agreement of the wrist views, robot mask by a segmenter.

    Args:
        states_confidence: how far what was measured is from the thresholds, as `score` says it.
    """

    name = "measured"

    def __init__(self, segmenter: Segmenter, *, states_confidence: bool = False) -> None:
        self.segmenter = segmenter
        self.states_confidence = states_confidence

    def extract(
        self, trajectory: Trajectory, family: EvidenceFamily, indices: tuple[int, ...], height_px: int
    ) -> Extracted[Evidence]:
        """Facts at the given frames, measured at the recording's own resolution (``height_px`` adds nothing here)."""
        return Extracted(self._facts(trajectory, family, indices))

    def reconcile(
        self, trajectory: Trajectory, selected: str, first: str, verification: str
    ) -> Extracted[Reconciliation]:
        """Words prove nothing to a measuring judge: null."""
        return Extracted(Reconciliation(reason="measurements are not reconciled by words"))

    def inspect_motion(
        self, trajectory: Trajectory, indices: tuple[int, ...], earlier: str
    ) -> Extracted[MotionEvidence]:
        """The same facts from frames spread evenly over the video; true only where they establish success."""
        evidence = self._facts(trajectory, route(trajectory.instruction), indices)
        done = True if establishes_success(evidence) else None
        return Extracted(MotionEvidence(task_effect_completed=done, observations=evidence.observations))

    def _facts(self, trajectory: Trajectory, family: EvidenceFamily, indices: tuple[int, ...]) -> Evidence:
        chosen = list(indices)
        frames = {view: video[chosen] for view, video in trajectory.frames.items()}
        points = None if trajectory.points is None else trajectory.points[chosen]
        measured = measure(self.segmenter, trajectory.instruction, family, frames, points)
        evidence = facts(measured, trajectory.instruction, family)
        if not self.states_confidence or measured is None:
            return evidence
        done = score(measured)
        return evidence.model_copy(update={"confidence": done if establishes_success(evidence) else 1.0 - done})
