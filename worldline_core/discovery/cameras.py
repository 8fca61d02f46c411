"""Head and wrist views, from a camera's name and from its picture while the arms move."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from worldline_core.discovery.arms import Side, side_of, words_of
from worldline_core.discovery.findings import named

_WRIST = {"wrist", "hand", "gripper", "inhand", "handeye", "eih", "eye", "palm", "endeffector", "ee"}
_HEAD = (
    {"head", "ego", "egocentric"}, {"high", "top", "overhead", "ceiling", "birdseye"}, {"front", "static", "workspace", "context"},
    {"exterior", "external", "third", "agentview", "scene", "base", "main"}, {"image", "cam", "camera", "rgb", "color", "webcam"},
)  # fmt: skip
"""Words of a camera that sees the whole scene, those that say it best first."""
MOVING_SHARE, RATHER_MOVING, TIMES_ANOTHER, UNUSUAL_WRIST, UNUSUAL_HEAD = 0.4, 0.2, 2.0, 0.08, 0.7
"""Share of the picture's details that change while an arm moves: a camera is on a wrist above the first, or above the second where
another camera has less than half of it. Below and above the last two its name is doubted. A camera on a table sees the arm alone (on
15 DROID episodes 0.02 to 0.34, median 0.09), one on a wrist everything but its gripper (0.21 to 0.69, median 0.46)."""
_SIZE, _LEVELS = (64, 48), 8


@dataclass(frozen=True)
class Seen:
    """Motion of a camera's picture while the arms move.

    Attributes:
        moving, resting: median share of its details that change, in the quarter of the frames with most and with least motion
            of the arm that it follows best.
        follows: correlation of that share with the motion of each arm.
    """

    moving: float
    resting: float
    follows: Mapping[str, float]

    def sentence(self) -> str:
        return (
            f"{self.moving:.0%} of the picture's details change while an arm moves, {self.resting:.0%} while it rests"
        )


def watch[S: str](frames: np.ndarray, motion: Mapping[S, np.ndarray]) -> Seen | None:
    """Compare pictures (N, H, W, 3) or grey (N, H, W) with the motion (N - 1,) of each arm between them; None where nothing moves."""
    if len(frames) < 12 or not motion or max(float(values.max()) for values in motion.values()) <= 1e-3:
        return None
    small = [cv2.resize(f, _SIZE, interpolation=cv2.INTER_AREA) for f in frames]
    grey = [f if f.ndim == 2 else cv2.cvtColor(f, cv2.COLOR_RGB2GRAY) for f in small]
    kernel = np.ones((3, 3), np.uint8)
    details = np.stack([cv2.dilate(g, kernel) - cv2.erode(g, kernel) for g in grey])[:-1] > _LEVELS
    changed = np.abs(np.diff(np.stack(grey).astype(np.int16), axis=0)) > _LEVELS
    share = (changed & details).sum(axis=(1, 2)) / np.maximum(details.sum(axis=(1, 2)), 1)
    follows: dict[str, float] = {
        side: float(np.corrcoef(share, values)[0, 1]) if values.std() > 0 and share.std() > 0 else 0.0
        for side, values in motion.items()
    }
    order = np.argsort(motion[max(motion, key=lambda side: follows[side])], kind="stable")
    quarter = max(3, len(order) // 4)
    return Seen(float(np.median(share[order[-quarter:]])), float(np.median(share[order[:quarter]])), follows)


@dataclass(frozen=True)
class NamedViews:
    """View of each camera that a model is to see, the evidence for it, and the cameras that are left over."""

    views: dict[str, str]
    evidence: dict[str, str]
    unused: list[str]


def name_views(cameras: Sequence[str], sides: Sequence[Side], seen: Mapping[str, Seen | None]) -> NamedViews:
    """Give the cameras their views: head, and one wrist for each arm; head first.

    Args:
        sides: of the arms; empty for recordings without arms.
        seen: by camera, where its pictures were compared with the joints.
    """
    words = {camera: _camera_words(camera) for camera in cameras}
    on_wrists = {camera: "by its name" for camera in cameras if set(words[camera]) & _WRIST - _HEAD[0]}
    said = set().union(*_HEAD[:3])
    least = min((found.moving for found in seen.values() if found is not None), default=0.0)
    for camera in cameras if len(cameras) > 1 else ():
        if camera in on_wrists or set(words[camera]) & said or (found := seen.get(camera)) is None:
            continue
        if found.moving >= MOVING_SHARE or (found.moving >= max(RATHER_MOVING, TIMES_ANOTHER * least)):
            on_wrists[camera] = "by its picture"
    views: dict[str, str] = {}
    evidence: dict[str, str] = {}
    free = list(sides)
    for camera in sorted(on_wrists, key=lambda camera: side_of(words[camera]) is None):
        side, why = (
            _wrist_side(words[camera], free, seen.get(camera)) if len(sides) > 1 else (next(iter(free), None), "")
        )
        if side in free:
            free.remove(side)
            views[camera], evidence[camera] = f"{side}_wrist", on_wrists[camera] + why
    rest = [camera for camera in cameras if camera not in views]
    rest.sort(key=lambda camera: (rank := _rank(words[camera]), _motion(seen, camera) if rank == len(_HEAD) else 0.0))
    if rest:
        views = {rest[0]: "head", **views}
        how = "by its name" if _rank(words[rest[0]]) < len(_HEAD) else "the camera that is on no wrist"
        evidence[rest[0]] = how + (f", before {named(rest[1:])}" if rest[1:] else "")
    elif len(cameras) == 1:
        views, evidence = {cameras[0]: "head"}, {cameras[0]: "the only camera, though on a wrist"}
    for camera, view in views.items():
        if (found := seen.get(camera)) is not None:
            # Of two arms one may rest while the other works.
            still = view.endswith("_wrist") and len(sides) == 1 and found.moving < UNUSUAL_WRIST
            doubt = len(cameras) > 1 and (still or (view == "head" and found.moving > UNUSUAL_HEAD))
            evidence[camera] += f"; {found.sentence()}" + (", which is unusual there: look at it" if doubt else "")
    return NamedViews(views, evidence, rest[1:])


def _motion(seen: Mapping[str, Seen | None], camera: str) -> float:
    return 1.0 if (found := seen.get(camera)) is None else found.moving


def _wrist_side(words: Sequence[str], free: Sequence[Side], found: Seen | None) -> tuple[Side | None, str]:
    """The arm that a wrist camera is on: the one that it names, or whose motion its picture follows best."""
    if (side := side_of(words)) is not None:
        return side, ""
    if not free or found is None:
        return next(iter(free), None), ""
    side = max(free, key=lambda each: found.follows.get(each, 0.0))
    return side, f"; it follows the {side} arm (correlation {found.follows.get(side, 0.0):.2f})"


def _camera_words(camera: str) -> tuple[str, ...]:
    """Words of a camera's own name: DROID's `exterior_1_left` is the left picture of a stereo camera."""
    words = words_of(camera.removeprefix("observation.images.").removeprefix("observation.image."))
    return tuple(word for word in words if word not in ("observation", "images"))


def _rank(words: Sequence[str]) -> int:
    return next((rank for rank, group in enumerate(_HEAD) if set(words) & group), len(_HEAD))
