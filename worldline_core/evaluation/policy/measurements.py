"""Coloured things in sampled frames: how far one rose, whether it is held, where it lies, how much of it is left.

What an instruction names by colour is first found by the colour's word, then followed by its own colour. Lengths are in
units of the thing's own size (the root of its largest visible area), so that they hold for any camera distance and
resolution. ``None`` means: not visible enough to say. Thresholds were chosen on training recordings.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from worldline_core.evaluation.recordings import HEAD

# Hue of each colour word [degrees]; at least 25 degrees apart. A pixel's share falls from 1 to 0 between FULL and NONE,
# the distance of its hue [degrees], its saturation and its value: a blurred edge keeps its share of the area.
HUES_DEG = {"red": 0.0, "orange": 28.0, "yellow": 53.0, "green": 126.0, "cyan": 180.0, "blue": 229.0, "purple": 283.0}
_HUE_FULL_DEG, _HUE_NONE_DEG = 9.0, 14.0
_SATURATION_NONE, _SATURATION_FULL = 0.50, 0.75
_VALUE_NONE, _VALUE_FULL = 0.12, 0.25
# A thing's own colour is taken from one of the first frames (observed, or predicted from little motion) that shows at
# least this many pixels of it.
_FIRST_FRAMES, _MIN_PIXELS = 8, 3.0
# Likeness to the own colour, relative to its chroma: 0 below _LIKENESS_NONE, 1 at _LIKENESS_RANGE above that; chroma of
# another hue counts against it with the weight _OTHER_HUE. In predicted videos moving things fade, and a fixed
# saturation would lose them. Surroundings may have a tint of the same hue: what is less like the thing than this
# quantile of them plus a margin has likeness 0.
_LIKENESS_NONE, _LIKENESS_RANGE, _OTHER_HUE = 0.20, 0.30, 2.0
_SURROUNDINGS_QUANTILE, _SURROUNDINGS_MARGIN = 0.98, 0.05

_THING = re.compile(rf"\b({'|'.join(HUES_DEG)})\s+(\w+)")

LATE_COUNT = 3
_MIN_AREA_FRACTION = 0.0009  # of the frame: about 5.5 px at 64 x 96
_VISIBLE = 0.12  # of the thing's largest area
_CLEAR = 0.35  # of the thing's largest area: enough to measure its position
HELD_TOUCH = 0.5  # of the thing's area lies within a third of its size of the robot
HELD_WRIST_SHARE = 0.065  # of a wrist frame


@dataclass(frozen=True)
class ColouredThing:
    """A thing named in an instruction: ``red cube``."""

    colour: str
    noun: str


def named_things(instruction: str) -> tuple[ColouredThing, ...]:
    """The coloured things of an instruction, in order: the object first, then its destination."""
    return tuple(ColouredThing(colour, noun) for colour, noun in _THING.findall(instruction.lower()))


def colour_share(frames: np.ndarray, colour: str) -> np.ndarray:
    """How much of each pixel has the colour, 0..1: float32 (n, h, w) for uint8 frames (n, h, w, 3)."""
    pixels = frames.reshape(1, -1, 3).astype(np.float32) / 255.0
    hue, saturation, value = np.moveaxis(cv2.cvtColor(pixels, cv2.COLOR_RGB2HSV)[0], -1, 0)
    distance = np.abs((hue - HUES_DEG[colour] + 180.0) % 360.0 - 180.0)
    share = (
        np.clip((_HUE_NONE_DEG - distance) / (_HUE_NONE_DEG - _HUE_FULL_DEG), 0, 1)
        * np.clip((saturation - _SATURATION_NONE) / (_SATURATION_FULL - _SATURATION_NONE), 0, 1)
        * np.clip((value - _VALUE_NONE) / (_VALUE_FULL - _VALUE_NONE), 0, 1)
    )
    return share.reshape(frames.shape[:3]).astype(np.float32)


@dataclass(frozen=True)
class OwnColour:
    """A thing's mean RGB (3,) float32; ``none``: pixels less like it than this (as its surroundings are) are not of it."""

    rgb: np.ndarray
    none: float


def own_colour(frames: np.ndarray, colour: str) -> OwnColour | None:
    """Mean colour of what the colour's word finds, in whichever of the first frames (n, h, w, 3) shows most of it.

    None where fewer than three pixels show it.
    """
    early = frames[:_FIRST_FRAMES]
    shares = colour_share(early, colour)
    areas = shares.sum(axis=(1, 2))
    best = int(np.argmax(areas))
    if areas[best] < _MIN_PIXELS:
        return None
    rgb = np.einsum("hw,hwc->c", shares[best], early[best].astype(np.float32)) / areas[best]
    others = _projection(early[best], rgb)[shares[best] == 0]
    none = float(np.quantile(others, _SURROUNDINGS_QUANTILE)) + _SURROUNDINGS_MARGIN if others.size else 0.0
    return OwnColour(rgb, max(none, _LIKENESS_NONE))


def likeness(frames: np.ndarray, own: OwnColour) -> np.ndarray:
    """How much of each pixel is of the thing, 0..1: float32 (n, h, w) for uint8 frames (n, h, w, 3)."""
    return np.clip((_projection(frames, own.rgb) - own.none) / _LIKENESS_RANGE, 0, 1).astype(np.float32)


def thing_share(frames: np.ndarray, colour: str, own: OwnColour | None) -> np.ndarray:
    """How much of each pixel is of the thing: by its own colour where that was seen, else by the colour's word."""
    return colour_share(frames, colour) if own is None else likeness(frames, own)


def _projection(frames: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """Chroma (..., h, w) along that of ``rgb``, in its units, less what lies beside that line: another hue."""
    axis = rgb - rgb.mean()
    strength = max(float(np.linalg.norm(axis)), 1e-6)
    axis = axis / strength
    chroma = frames.astype(np.float32)
    chroma -= chroma.mean(axis=-1, keepdims=True)
    along = chroma @ axis
    beside = np.linalg.norm(chroma - along[..., None] * axis, axis=-1)
    return (along - _OTHER_HUE * beside) / strength


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


@dataclass(frozen=True)
class LiftMeasurement:
    """Attributes:
    rise: the least of the late heights against the resting height, in sizes or, of a wide thing, in its heights (up is
        positive).
    peak: the most it ever rose.
    held: share of the late frames in which it is held.
    vacated: share of where it rested that late frames show empty: neither the thing nor the robot is there.
    """

    rise: float | None
    peak: float | None
    held: float | None
    vacated: float | None = None


@dataclass(frozen=True)
class PlaceMeasurement:
    """distance: between object and destination in the end, in destination sizes."""

    distance: float | None


@dataclass(frozen=True)
class PushMeasurement:
    """remaining: late share of the visible area that no robot covers; retreat: how far its near edge moved up or its far
    edge down (whichever is more, for a drawer closes away from the camera or towards it), in sizes; None when nothing
    of it is visible any more."""

    remaining: float | None
    retreat: float | None


@dataclass(frozen=True)
class PressMeasurement:
    """growth: late area of the colour against its first, for a button that lights up while it is down."""

    growth: float | None


def sight(frames: np.ndarray, thing: ColouredThing) -> Sighting:
    """Find a thing in head frames (n, h, w, 3)."""
    own = own_colour(frames, thing.colour)
    shares = thing_share(frames, thing.colour, own)
    rows, columns = np.mgrid[: frames.shape[1], : frames.shape[2]]
    area = shares.sum(axis=(1, 2))
    safe = np.maximum(area, 1e-6)
    u, v = ((shares * grid).sum(axis=(1, 2)) / safe for grid in (columns, rows))
    return Sighting(shares, area, u, v, own)


def measure_lift(frames: Mapping[str, np.ndarray], thing: ColouredThing, robot_late: np.ndarray) -> LiftMeasurement:
    """Rise and hold.

    Args:
        frames: by view, chosen frames (n, h, w, 3) in order.
        robot_late: robot masks (LATE_COUNT, h, w) of the last frames of the head view.
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
    return LiftMeasurement(rise, peak, _held(frames, thing, head, late & visible, robot_late), vacated)


def measure_place(
    frames: Mapping[str, np.ndarray], thing: ColouredThing, destination: ColouredThing
) -> PlaceMeasurement:
    """Where the object is in the end, against where the destination was seen best."""
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
    """How much of a drawer still sticks out."""
    head = sight(frames[HEAD], thing)
    best = int(np.argmax(head.area))
    if not head.seen(_CLEAR)[best]:
        return PushMeasurement(None, None)
    late = head.area[-LATE_COUNT:]
    covered = float((head.shares[best] * robot_late).sum(axis=(1, 2)).mean()) / float(head.area[best])
    remaining = float(late.mean()) / float(head.area[best]) / max(1.0 - covered, 0.05)
    shown = head.shares[-LATE_COUNT:][late > _MIN_AREA_FRACTION * head.shares[0].size]
    retreat = None
    if len(shown):
        far, near = _edges(head.shares[best])
        late_far, late_near = np.mean([_edges(share) for share in shown], axis=0)
        retreat = float(max(near - late_near, late_far - far) / np.sqrt(head.area[best]))
    return PushMeasurement(remaining, retreat)


def measure_press(frames: Mapping[str, np.ndarray], thing: ColouredThing) -> PressMeasurement:
    """How much larger a button's colour has become."""
    head = sight(frames[HEAD], thing)
    first = float(head.area[:LATE_COUNT].max())
    if first < _MIN_AREA_FRACTION * head.shares[0].size:
        return PressMeasurement(None)
    # What covers it for a moment hides a part of it, so the largest late area counts.
    return PressMeasurement(float(head.area[-LATE_COUNT:].max()) / first)


def _held(
    frames: Mapping[str, np.ndarray],
    thing: ColouredThing,
    head: Sighting,
    late_visible: np.ndarray,
    robot_late: np.ndarray,
) -> float | None:
    """Share of late frames in which the thing touches the robot and fills a wrist camera as only a held thing does.

    0 when it is not held in the last one: a drop at the very end is a drop.
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
    in_hand = np.max(wrists, axis=0) / HELD_WRIST_SHARE if wrists else np.full(LATE_COUNT, np.nan)
    signs = [np.minimum(values, 1.0) for values in (touching / HELD_TOUCH, in_hand) if not np.isnan(values).all()]
    if not signs:
        return None
    # Both views have to agree where both can see: a gripper in front of a thing also touches it in the image.
    holds = np.nanmin(signs, axis=0) >= 1.0
    return float(holds.mean()) if holds[-1] else 0.0


def _edges(share: np.ndarray) -> tuple[float, float]:
    """Rows above and below which a tenth of the area lies: the far and the near edge."""
    rows = np.cumsum(share.sum(axis=1))
    return float(np.searchsorted(rows, 0.1 * rows[-1])), float(np.searchsorted(rows, 0.9 * rows[-1]))
