"""What an instruction names by colour, and where those colours are in a frame."""

from __future__ import annotations

import re
from dataclasses import dataclass

import cv2
import numpy as np

# Hue of each colour word [degrees]. Neighbours are 25 degrees apart at least.
HUES_DEG = {"red": 0.0, "orange": 28.0, "yellow": 53.0, "green": 126.0, "cyan": 180.0, "blue": 229.0, "purple": 283.0}
_HUE_FULL_DEG, _HUE_NONE_DEG = 9.0, 14.0
# Things are saturated, tables and robots are not; between the two a pixel counts in part, so that a blurred edge
# keeps its share of the area.
_SATURATION_NONE, _SATURATION_FULL = 0.50, 0.75
_VALUE_NONE, _VALUE_FULL = 0.12, 0.25

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
