"""From measurements to the facts of the evidence schemas, and to a soft score for ranking.

Thresholds and widths were chosen on training recordings only.
"""

from __future__ import annotations

import math
import re

from worldline_core.evaluation.policy.evidence import (
    SCHEMAS,
    Evidence,
    EvidenceFamily,
    GraspEvidence,
    LiftEvidence,
    StateChangeEvidence,
)
from worldline_core.evaluation.policy.measured.measurements import LiftMeasurement, PlaceMeasurement, PushMeasurement

Measurement = LiftMeasurement | PlaceMeasurement | PushMeasurement

MIN_RISE, RISE_WIDTH = 0.5, 0.25
MIN_VACATED = 0.6
DROP_PEAK = 1.0
MIN_HELD = 0.6
MAX_DISTANCE, DISTANCE_WIDTH = 0.5, 0.12
MAX_REMAINING, REMAINING_WIDTH = 0.56, 0.12
MIN_RETREAT, RETREAT_WIDTH = 0.53, 0.12
UNSEEN_SCORE = 0.25

_CLOSING = re.compile(r"\b(clos(e|ed|ing)|shut|push(ed|ing)?|slid(e|ing))\b")


def closes(instruction: str) -> bool:
    """Whether the instruction asks that something be pushed in or closed."""
    return _CLOSING.search(instruction.lower()) is not None


def unmeasurable(family: EvidenceFamily, reason: str) -> Evidence:
    """Evidence in which every fact is null."""
    return SCHEMAS[family](observations=reason)


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


def place_facts(measured: PlaceMeasurement, name: str, destination: str) -> Evidence:
    """Facts of a placement: the object lies at its destination and rests."""
    there = None if measured.distance is None else measured.distance < MAX_DISTANCE
    words = f"{name}: {_text(measured.distance)} destination sizes from the {destination} in the end"
    return StateChangeEvidence(
        required_final_state_visible=there,
        wrong_object_or_drop=None if there is None else False,
        observations=words,
    )


def push_facts(measured: PushMeasurement, name: str) -> Evidence:
    """Facts of closing: little of the thing is left, and its near edge has retreated."""
    closed = None
    if measured.remaining is not None:
        retreated = measured.retreat is None or measured.retreat > MIN_RETREAT
        closed = measured.remaining < MAX_REMAINING and retreated
    words = f"{name}: {_text(measured.remaining)} of it still visible, edge moved in by {_text(measured.retreat)} of its size"
    return StateChangeEvidence(
        required_final_state_visible=closed,
        wrong_object_or_drop=None if closed is None else False,
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
    if measured.remaining is None:
        return UNSEEN_SCORE
    retreat = 1.0 if measured.retreat is None else _above(measured.retreat, MIN_RETREAT, RETREAT_WIDTH)
    return retreat * _above(-measured.remaining, -MAX_REMAINING, REMAINING_WIDTH)


def _above(value: float, threshold: float, width: float) -> float:
    return 1.0 / (1.0 + math.exp(-max(-60.0, min(60.0, (value - threshold) / width))))


def _text(value: float | None) -> str:
    return "(not visible)" if value is None else f"{value:.2f}"
