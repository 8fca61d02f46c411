"""Coloured things by the words of an instruction: how much of each pixel shows them.

What an instruction names by colour is first found by the colour's word, then followed by its own colour. Thresholds were
chosen on training recordings.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import cv2
import numpy as np

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


@dataclass(frozen=True)
class ColouredThing:
    """A thing named in an instruction: ``red cube``."""

    colour: str
    noun: str


def named_things(instruction: str) -> tuple[ColouredThing, ...]:
    """The coloured things of an instruction, in order: the object first, then its destination."""
    return tuple(ColouredThing(colour, noun) for colour, noun in _THING.findall(instruction.lower()))


def colour_share(frames: np.ndarray, colour: str) -> np.ndarray:
    """Share of each pixel that has the colour, 0..1: float32 (n, h, w) for uint8 frames (n, h, w, 3)."""
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
    """Share of each pixel that is of the thing, 0..1: float32 (n, h, w) for uint8 frames (n, h, w, 3)."""
    return np.clip((_projection(frames, own.rgb) - own.none) / _LIKENESS_RANGE, 0, 1).astype(np.float32)


def thing_share(frames: np.ndarray, colour: str, own: OwnColour | None) -> np.ndarray:
    """Share of each pixel that is of the thing, by its own colour where that was seen, else by the colour's word."""
    return colour_share(frames, colour) if own is None else likeness(frames, own)


def _projection(frames: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """Chroma (..., h, w) along that of ``rgb``, in its units, less the chroma of another hue."""
    axis = rgb - rgb.mean()
    strength = max(float(np.linalg.norm(axis)), 1e-6)
    axis = axis / strength
    chroma = frames.astype(np.float32)
    # numpy's reductions take four times as long over an axis of three.
    chroma -= (chroma[..., :1] + chroma[..., 1:2] + chroma[..., 2:]) / np.float32(3)
    along = chroma @ axis
    chroma -= along[..., None] * axis
    chroma *= chroma
    beside = np.sqrt(chroma[..., 0] + chroma[..., 1] + chroma[..., 2])
    return (along - _OTHER_HUE * beside) / strength
