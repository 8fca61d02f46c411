"""The embedded default judge: the evidence schemas filled by measuring, instead of by a language model.

It follows the things that the instruction names by colour: how far one rose, whether it is held, where it ends, how much of it is left.
Lengths are in units of the thing's own size (the root of its largest visible area), so that they hold for any camera distance and
resolution; None means not visible enough. Thresholds were chosen on training recordings only.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from worldline_core.data.episodes.episode import VIEWS
from worldline_core.errors import DataError
from worldline_core.evaluation.policy.judge import (
    SCHEMAS,
    Evidence,
    EvidenceFamily,
    GraspEvidence,
    LiftEvidence,
    MotionEvidence,
    Reconciliation,
    StateChangeEvidence,
    establishes_success,
    first_pass_indices,
    route,
)
from worldline_core.evaluation.recordings import HEAD, Trajectory
from worldline_core.evaluation.segmenters.coloured_things import (
    ColouredThing,
    OwnColour,
    named_things,
    own_colour,
    thing_share,
)
from worldline_core.evaluation.segmenters.segmenter import Segmenter

LATE_COUNT = 3
_MIN_AREA_FRACTION = 0.0009  # of the frame: about 5.5 px at 64 x 96
_VISIBLE = 0.12  # of the thing's largest area
_CLEAR = 0.35  # of the thing's largest area: enough to measure its position
# Share of the thing's area within a third of its size of the robot, by the number of hands that hold it.
HELD_TOUCH, FIRM_TOUCH = {1: 0.4, 2: 0.54}, {1: 0.5, 2: 0.54}
HELD_WRIST_SHARE = 0.065  # of a wrist frame
MIN_RISE, RISE_WIDTH = {1: 0.4, 2: 0.3}, 0.25  # by the number of hands
MIN_VACATED = 0.6
DROP_PEAK = 1.0
MIN_HELD = 0.6
MAX_DISTANCE, DISTANCE_WIDTH = 0.5, 0.12
MAX_REMAINING, REMAINING_WIDTH = 0.28, 0.08
MIN_EMPTIED = 0.2  # share of where a thing stood that shows neither it nor the robot
MIN_GROWTH, GROWTH_WIDTH = 1.7, 0.2
UNSEEN_SCORE = 0.25

# Instructions to press something, to use both hands, and to push something in or close it.
_PRESSING = re.compile(r"\bpress(es|ed|ing)?\b")
_TWO_HANDS = re.compile(r"\b(both|two) (arms|hands|grippers)\b")
_CLOSING = re.compile(r"\b(clos(e|ed|ing)|shut|push(ed|ing)?|slid(e|ing))\b")


@dataclass(frozen=True)
class Sighting:
    """A thing in the head view of n frames: area [px], centre u, v [px], its shares (n, h, w), its own colour if seen."""

    shares: np.ndarray
    area: np.ndarray
    u: np.ndarray
    v: np.ndarray
    own: OwnColour | None

    @property
    def full_area(self) -> float:
        """Its unoccluded area, as far as it was ever seen."""
        return float(np.quantile(self.area, 0.9))

    @property
    def size(self) -> float:
        return max(1.0, float(np.sqrt(self.full_area)))

    @property
    def height(self) -> float:
        """Its size [px], or for a wide thing how high it is in the picture."""
        far, near = _edges(self.shares[int(np.argmax(self.area))])
        return max(1.0, min(self.size, (near - far) / 0.8))

    def seen(self, fraction: float) -> np.ndarray:
        """Frames (n,) in which at least this fraction of it is visible."""
        least = _MIN_AREA_FRACTION * self.shares[0].size
        return self.area > max(fraction * self.full_area, least)


def _above(value: float, threshold: float, width: float) -> float:
    """Soft threshold, 0..1."""
    return 1.0 / (1.0 + math.exp(-max(-60.0, min(60.0, (value - threshold) / width))))


def _text(value: float | None) -> str:
    return "(not visible)" if value is None else f"{value:.2f}"


def _final_state(done: bool | None, words: str) -> StateChangeEvidence:
    dropped = None if done is None else False
    return StateChangeEvidence(required_final_state_visible=done, wrong_object_or_drop=dropped, observations=words)


@dataclass(frozen=True)
class LiftMeasurement:
    """A grasp or a lift.

    Attributes:
        rise: the least of the late heights against the resting height, in sizes or, of a wide thing, in its heights (up is positive).
        peak: the most it ever rose.
        held: share of the late frames in which it is held; 0 when not in the last one: a drop at the very end is a drop.
        held_firmly: the same by a stricter line for touching, for the score: a search for high scores finds grasps beside the thing, which
            models show as holding it.
        vacated: share of where it rested that late frames show empty: neither the thing nor the robot is there.
        least_rise: smallest rise that counts as lifted.
    """

    rise: float | None
    peak: float | None
    held: float | None
    held_firmly: float | None
    vacated: float | None = None
    least_rise: float = MIN_RISE[1]

    def score(self, unseen: float = UNSEEN_SCORE) -> float:
        hidden = max(unseen, 0.8 * (self.vacated or 0.0))
        rise = hidden if self.rise is None else _above(self.rise, self.least_rise, RISE_WIDTH)
        return rise * (unseen if self.held_firmly is None else 0.1 + 0.9 * self.held_firmly)

    def evidence(self, names: Sequence[str], family: EvidenceFamily) -> Evidence:
        held = None if self.held is None else self.held >= MIN_HELD
        raised = None if self.rise is None else self.rise > self.least_rise
        dropped = None
        if self.rise is not None and self.peak is not None:
            dropped = self.peak > DROP_PEAK and self.rise < self.least_rise / 2
        elif self.rise is None and held and self.vacated is not None and self.vacated > MIN_VACATED:
            # Hidden behind the gripper in the head view, but in the hand of a wrist view, and gone from where it rested.
            raised, dropped = True, False
        words = (
            f"{names[0]}: rose {_text(self.rise)} of its size, {_text(self.peak)} at most; held in {_text(self.held)} of the"
            " late steps"
        )
        if family == "grasp":
            return GraspEvidence(target_held_for_two_late_steps=held, wrong_object_or_drop=dropped, observations=words)
        return LiftEvidence(
            head_view_confirms_target_displacement=raised,
            target_held_for_two_late_steps=held,
            target_on_original_support_at_end=None if raised is None else not raised,
            wrong_object_or_drop=dropped,
            observations=words,
        )


@dataclass(frozen=True)
class PlaceMeasurement:
    """Distance between object and destination in the end, in destination sizes; placed is what is at its destination."""

    distance: float | None

    def score(self, unseen: float = UNSEEN_SCORE) -> float:
        return unseen if self.distance is None else _above(-self.distance, -MAX_DISTANCE, DISTANCE_WIDTH)

    def evidence(self, names: Sequence[str], family: EvidenceFamily) -> Evidence:
        words = f"{names[0]}: {_text(self.distance)} destination sizes from the {names[1]} in the end"
        return _final_state(None if self.distance is None else self.distance < MAX_DISTANCE, words)


@dataclass(frozen=True)
class PushMeasurement:
    """Late visible area of a thing that is pushed in, as a share of its largest; it is closed when little is left.

    None where it was not seen, or where the robot may hide what is left.
    """

    remaining: float | None

    def score(self, unseen: float = UNSEEN_SCORE) -> float:
        return unseen if self.remaining is None else _above(-self.remaining, -MAX_REMAINING, REMAINING_WIDTH)

    def evidence(self, names: Sequence[str], family: EvidenceFamily) -> Evidence:
        words = f"{names[0]}: {_text(self.remaining)} of it still visible"
        return _final_state(None if self.remaining is None else self.remaining < MAX_REMAINING, words)


@dataclass(frozen=True)
class PressMeasurement:
    """Late area of the colour against its first; pressed is a button that has lit up."""

    growth: float | None

    def score(self, unseen: float = UNSEEN_SCORE) -> float:
        return unseen if self.growth is None else _above(self.growth, MIN_GROWTH, GROWTH_WIDTH)

    def evidence(self, names: Sequence[str], family: EvidenceFamily) -> Evidence:
        words = f"{names[0]}: its colour fills {_text(self.growth)} times its first area in the end"
        return _final_state(None if self.growth is None else self.growth > MIN_GROWTH, words)


MeasuredEffect = LiftMeasurement | PlaceMeasurement | PushMeasurement | PressMeasurement
"""Each has ``score``, the likelihood 0..1 that the task is done (facts with soft thresholds, multiplied; a fact that is not visible
counts ``unseen``), and ``evidence``, the facts about the things of these names."""


def sight(frames: np.ndarray, thing: ColouredThing) -> Sighting:
    """Find a thing in head frames (n, h, w, 3)."""
    own = own_colour(frames, thing.colour)
    shares = thing_share(frames, thing.colour, own)
    rows, columns = np.mgrid[: frames.shape[1], : frames.shape[2]]
    area = shares.sum(axis=(1, 2))
    safe = np.maximum(area, 1e-6)
    u, v = ((shares * grid).sum(axis=(1, 2)) / safe for grid in (columns, rows))
    return Sighting(shares, area, u, v, own)


def measure_lift(
    frames: Mapping[str, np.ndarray], thing: ColouredThing, robot_late: np.ndarray, hands: int
) -> LiftMeasurement:
    """Rise and hold.

    Args:
        frames: by view, chosen frames (n, h, w, 3) in order.
        robot_late: robot masks (LATE_COUNT, h, w) of the last frames of the head view.
        hands: number of hands that are to hold the thing; two hold a wide one.
    """
    head = sight(frames[HEAD], thing)
    clear, visible = head.seen(_CLEAR), head.seen(_VISIBLE)
    late = np.arange(len(head.area)) >= len(head.area) - LATE_COUNT
    rise = peak = vacated = None
    if clear.any():
        resting = float(np.quantile(head.v[clear], 0.85))
        peak = (resting - float(head.v[clear].min())) / head.height
        if (late & visible).any():
            rise = (resting - float(head.v[late & visible].max())) / head.height
        early = np.where(clear, head.area, 0.0)[: max(1, len(head.area) // 2)]
        if early.max() > 0:
            spot = head.shares[int(np.argmax(early))]
            taken = np.maximum(head.shares[-LATE_COUNT:], robot_late)
            vacated = 1.0 - float((spot * taken).sum(axis=(1, 2)).max()) / float(spot.sum())
    touching, in_hand = _signs(frames, thing, head, late & visible, robot_late)
    held, firmly = (_held(touching / least, in_hand) for least in (HELD_TOUCH[hands], FIRM_TOUCH[hands]))
    return LiftMeasurement(rise, peak, held, firmly, vacated, MIN_RISE[hands])


def measure_place(
    frames: Mapping[str, np.ndarray], thing: ColouredThing, destination: ColouredThing
) -> PlaceMeasurement:
    """Final place of the object against the best view of the destination."""
    item, place = sight(frames[HEAD], thing), sight(frames[HEAD], destination)
    late = item.seen(_VISIBLE)
    late[:-LATE_COUNT] = False
    if not late.any() or not place.seen(_CLEAR).any():
        return PlaceMeasurement(None)
    best = int(np.argmax(place.area))
    size = max(1.0, float(np.sqrt(place.area[best])))
    du = float(item.u[late].mean()) - float(place.u[best])
    # A thing's foot, not its centre, stands on the spot: lower by half of its height, less its depth.
    far, near = _edges(item.shares[int(np.argmax(item.area))])
    dv = float(item.v[late].mean()) + 0.6 * (near - far) - 0.4 * item.size - float(place.v[best])
    return PlaceMeasurement(float(np.hypot(du, dv)) / size)


def measure_push(frames: Mapping[str, np.ndarray], thing: ColouredThing, robot_late: np.ndarray) -> PushMeasurement:
    """Part of a drawer that still sticks out."""
    head = sight(frames[HEAD], thing)
    best = int(np.argmax(head.area))
    if not head.seen(_CLEAR)[best]:
        return PushMeasurement(None)
    late = float(head.area[-LATE_COUNT:].mean()) / float(head.area[best])
    covered = float((head.shares[best] * robot_late).sum(axis=(1, 2)).mean()) / float(head.area[best])
    hidden = late < MAX_REMAINING and late + covered > 1.0 - MIN_EMPTIED
    return PushMeasurement(None if hidden else late)


def measure_press(frames: Mapping[str, np.ndarray], thing: ColouredThing) -> PressMeasurement:
    """Growth of a button's colour."""
    head = sight(frames[HEAD], thing)
    first = float(head.area[:LATE_COUNT].max())
    if first < _MIN_AREA_FRACTION * head.shares[0].size:
        return PressMeasurement(None)
    # What covers it for a moment hides a part of it, so the largest late area counts.
    return PressMeasurement(float(head.area[-LATE_COUNT:].max()) / first)


def _signs(
    frames: Mapping[str, np.ndarray],
    thing: ColouredThing,
    head: Sighting,
    late_visible: np.ndarray,
    robot_late: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Share of the thing's area near the robot, and its share of a wrist frame as a multiple of `HELD_WRIST_SHARE`, in the late frames.

    NaN where it is not seen.
    """
    touching = np.full(LATE_COUNT, np.nan)
    reach = max(1, round(head.size / 3))
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    for slot, index in enumerate(range(len(head.area) - LATE_COUNT, len(head.area))):
        if late_visible[index]:
            near = cv2.dilate(robot_late[slot].astype(np.uint8), kernel)
            touching[slot] = float((near * head.shares[index]).sum()) / float(head.area[index])
    wrists = [
        thing_share(frames[view][-LATE_COUNT:], thing.colour, head.own).mean(axis=(1, 2))
        for view in frames
        if view != HEAD
    ]
    return touching, np.max(wrists, axis=0) / HELD_WRIST_SHARE if wrists else np.full(LATE_COUNT, np.nan)


def _held(*signs: np.ndarray) -> float | None:
    """Share of late frames in which each sign is at least 1, 0 when not in the last one; None without any."""
    known = [np.minimum(values, 1.0) for values in signs if not np.isnan(values).all()]
    if not known:
        return None
    # Both views have to agree where both can see: a gripper in front of a thing also touches it in the image.
    holds = np.nanmin(known, axis=0) >= 1.0
    return float(holds.mean()) if holds[-1] else 0.0


def _edges(share: np.ndarray) -> tuple[float, float]:
    """Far and near edge: the rows beyond which a tenth of the area is."""
    rows = np.cumsum(share.sum(axis=1))
    return float(np.searchsorted(rows, 0.1 * rows[-1])), float(np.searchsorted(rows, 0.9 * rows[-1]))


def measured_views(family: EvidenceFamily) -> tuple[str, ...]:
    """Views that `measure` looks at."""
    return VIEWS if family in ("grasp", "lift") else (HEAD,)


def measure(
    segmenter: Segmenter,
    instruction: str,
    family: EvidenceFamily,
    frames: Mapping[str, NDArray[Any]],
    points: NDArray[Any] | None,
) -> MeasuredEffect | None:
    """Measure the family's facts on chosen frames (n, h, w, 3) of each view.

    None without a head view, for an instruction that names nothing by its colour, or for an effect that cannot be measured (holding,
    lifting, placing one thing on another, closing, and pressing something that then lights up can).
    """
    things = named_things(instruction)
    if len(things) == 0 or HEAD not in frames or len(frames[HEAD]) < LATE_COUNT:
        return None
    if family in ("grasp", "lift"):
        hands = 2 if _TWO_HANDS.search(instruction.lower()) else 1
        return measure_lift(frames, things[0], _robot_late(segmenter, frames[HEAD], points), hands)
    if len(things) > 1:
        return measure_place(frames, things[0], things[1])
    if _PRESSING.search(instruction.lower()):
        return measure_press(frames, things[0])
    if _CLOSING.search(instruction.lower()):
        return measure_push(frames, things[0], _robot_late(segmenter, frames[HEAD], points))
    return None


def soft_score(segmenter: Segmenter, trajectory: Trajectory) -> tuple[float, dict[str, float]]:
    """Likelihood that the task is done, 0..1, if the video ended here; and the measured facts by name, NaN where not visible.

    Frames as of a judge's first pass; before there are three, the first one counts several times. What cannot be seen scores 0:
    a controller that hides a thing must gain nothing by it.

    Raises: DataError where nothing can be measured.
    """
    chosen = list(first_pass_indices(trajectory.num_frames))
    family = route(trajectory.instruction)
    frames, points = trajectory.at([0] * (LATE_COUNT - len(chosen)) + chosen, measured_views(family))
    measured = measure(segmenter, trajectory.instruction, family, frames, points)
    if measured is None:
        raise DataError(
            "The task has no soft score", got=f"{trajectory.instruction!r}, views {', '.join(trajectory.frames)}",
            expected="the head view, and a thing named by its colour to lift, place, push closed or press",
            next_step="take reward='success' with a success function of your own, or other recordings",
        )  # fmt: skip
    return measured.score(unseen=0.0), {n: math.nan if v is None else float(v) for n, v in vars(measured).items()}


def facts(measured: MeasuredEffect | None, instruction: str, family: EvidenceFamily) -> Evidence:
    """The family's evidence from a measurement; null without one."""
    if measured is None:
        return SCHEMAS[family](observations="nothing in the instruction can be followed by its colour")
    return measured.evidence([f"{thing.colour} {thing.noun}" for thing in named_things(instruction)], family)


def _robot_late(segmenter: Segmenter, head: np.ndarray, points: np.ndarray | None) -> np.ndarray:
    """Robot masks of the last frames; a segmenter that follows the robot from the first frame sees all of them."""
    if segmenter.follows:
        return segmenter.segment(head, points)[-LATE_COUNT:]
    return segmenter.segment(head[-LATE_COUNT:], None if points is None else points[-LATE_COUNT:])


class MeasuredEvidenceJudge:
    """Colour tracking in the head view, agreement of the wrist views, robot mask by a segmenter.

    The stated confidence is the distance of the measurement from the thresholds, by its soft score.
    """

    name = "measured"

    def __init__(self, segmenter: Segmenter) -> None:
        self.segmenter = segmenter

    def extract(
        self, trajectory: Trajectory, family: EvidenceFamily, indices: tuple[int, ...], height_px: int
    ) -> tuple[Evidence, bool]:
        """Facts at the given frames, measured at the recording's own resolution (``height_px`` adds nothing here)."""
        return self._facts(trajectory, family, indices), True

    def reconcile(
        self, trajectory: Trajectory, selected: str, first: str, verification: str
    ) -> tuple[Reconciliation, bool]:
        """Words prove nothing to a measuring judge: null."""
        return Reconciliation(reason="measurements are not reconciled by words"), True

    def inspect_motion(
        self, trajectory: Trajectory, indices: tuple[int, ...], earlier: str
    ) -> tuple[MotionEvidence, bool]:
        """The same facts from frames spread evenly over the video; true only where they establish success."""
        evidence = self._facts(trajectory, route(trajectory.instruction), indices)
        done = True if establishes_success(evidence) else None
        return MotionEvidence(task_effect_completed=done, observations=evidence.observations), True

    def _facts(self, trajectory: Trajectory, family: EvidenceFamily, indices: tuple[int, ...]) -> Evidence:
        frames, points = trajectory.at(indices, measured_views(family))
        measured = measure(self.segmenter, trajectory.instruction, family, frames, points)
        evidence = facts(measured, trajectory.instruction, family)
        if measured is None:
            return evidence
        done = measured.score()
        return evidence.model_copy(update={"confidence": done if establishes_success(evidence) else 1.0 - done})
