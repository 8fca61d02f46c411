"""One video and its instruction to one measurement: shared by the measured judge and the measured selector."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from worldline_core.evaluation.policy.evidence import Evidence, EvidenceFamily
from worldline_core.evaluation.policy.measured.coloured_things import named_things
from worldline_core.evaluation.policy.measured.facts import (
    Measurement,
    closes,
    lift_facts,
    place_facts,
    push_facts,
    unmeasurable,
)
from worldline_core.evaluation.policy.measured.measurements import (
    LATE_COUNT,
    LiftMeasurement,
    PlaceMeasurement,
    measure_lift,
    measure_place,
    measure_push,
)
from worldline_core.evaluation.segmenters.base import Segmenter

_HEAD = "head"


def measure(
    segmenter: Segmenter,
    instruction: str,
    family: EvidenceFamily,
    frames: Mapping[str, np.ndarray],
    points: np.ndarray | None,
) -> Measurement | None:
    """Measure what the family's facts need, on chosen frames (n, h, w, 3) of each view.

    None when the instruction does not name what to follow by a colour, or asks for an effect that this cannot measure
    (it measures holding, lifting, placing one thing on another, and closing).
    """
    things = named_things(instruction)
    if len(things) == 0 or len(frames[_HEAD]) < LATE_COUNT:
        return None
    if family in ("grasp", "lift"):
        return measure_lift(frames, things[0], _robot_late(segmenter, frames[_HEAD], points))
    if len(things) > 1:
        return measure_place(frames, things[0], things[1])
    if closes(instruction):
        return measure_push(frames, things[0], _robot_late(segmenter, frames[_HEAD], points))
    return None


def facts(measured: Measurement | None, instruction: str, family: EvidenceFamily) -> Evidence:
    """The family's evidence from a measurement."""
    if measured is None:
        return unmeasurable(family, "nothing in the instruction can be followed by its colour")
    names = [f"{thing.colour} {thing.noun}" for thing in named_things(instruction)]
    if isinstance(measured, LiftMeasurement):
        return lift_facts(measured, names[0], family)
    if isinstance(measured, PlaceMeasurement):
        return place_facts(measured, names[0], names[1])
    return push_facts(measured, names[0])


def _robot_late(segmenter: Segmenter, head: np.ndarray, points: np.ndarray | None) -> np.ndarray:
    """Robot masks of the last frames; a segmenter that follows the robot from the first frame sees all of them."""
    if segmenter.follows:
        return segmenter.segment(head, points)[-LATE_COUNT:]
    return segmenter.segment(head[-LATE_COUNT:], None if points is None else points[-LATE_COUNT:])
