"""Looks of recorded scenes: colours, textures, light, sizes of things, and where the head camera stands.

Sixteen scenes are fixed, ``scene_00`` .. ``scene_15``: twelve for training, four for tests. Others are drawn, each a function of its name:
``wide_0000`` .. from a wider range, 8,000 of them for training and 1,000 for tests, and ``unseen_0000`` .. from ranges outside of it, for
tests alone.
"""

from __future__ import annotations

import colorsys
import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np

from worldline_core.errors import DataError
from worldline_core.recorder.bodies import HEAD_FOVY_DEG, Colour

LookName = Literal["plain", "wide", "unseen"]
Range = tuple[float, float]
SCENE_PATTERN = "^(scene_(0[0-9]|1[0-5])|(wide|unseen)_[0-9]{4})$"
_STREAM = {"wide": 0, "unseen": 1}


@dataclass(frozen=True)
class HeadCamera:
    """Place of a head camera, across the table, so that arms do not hide what they work on: degrees aside from facing the robot,
    degrees of elevation, and distance to the workspace [m]."""

    aside_deg: Range
    elevation_deg: Range
    distance: Range


TRAINING_CAMERA = HeadCamera((-25.0, 25.0), (50.0, 64.0), (0.80, 0.92))
HELD_OUT_CAMERA = HeadCamera((40.0, 55.0), (38.0, 45.0), (0.80, 0.92))


@dataclass(frozen=True)
class Look:
    """One look.

    Attributes:
        table, floor, wall: RGB 0..1.
        texture: material of the table, one of TEXTURES; ``repeats``: how often it repeats a metre, along x and y.
        light_direction, light: of the sun; ``ambient`` and ``headlight`` come from everywhere and from the camera; ``tint`` colours all.
        size: scale of blocks, cans, pads and buttons; ``hue_deg`` (added), ``saturation`` and ``value`` (factors) of their colours.
    """

    table: Colour
    floor: Colour
    wall: Colour
    light_direction: tuple[float, float, float]
    light: float
    ambient: float
    headlight: float = 0.28
    tint: Colour = (1.0, 1.0, 1.0)
    texture: str | None = None
    repeats: tuple[float, float] = (1.0, 1.0)
    size: float = 1.0
    hue_deg: float = 0.0
    saturation: float = 1.0
    value: float = 1.0
    head: HeadCamera = TRAINING_CAMERA
    fovy_deg: float = HEAD_FOVY_DEG

    def paint(self, colour: Colour) -> Colour:
        """A thing's colour in this look."""
        if (self.hue_deg, self.saturation, self.value) == (0.0, 1.0, 1.0):  # back and forth rounds
            return colour
        hue, saturation, value = colorsys.rgb_to_hsv(*colour)
        return _hsv(hue + self.hue_deg / 360, saturation * self.saturation, value * self.value)


def _hsv(hue: float, saturation: float, value: float) -> Colour:
    red, green, blue = colorsys.hsv_to_rgb(hue % 1.0, saturation, value)
    return (red, green, blue)


def _fixed(number: int, table: Colour, floor: Colour, wall: Colour) -> Look:
    random = np.random.default_rng(7000 + number)
    direction = (float(random.uniform(-0.5, 0.5)), float(random.uniform(-0.5, 0.5)), -1.0)
    # Six draws had another use once: without them the light of every scene would change.
    random.uniform(size=6)
    light, ambient = float(random.uniform(0.42, 0.62)), float(random.uniform(0.30, 0.42))
    return Look(table, floor, wall, direction, light, ambient)


# Tables are of middle brightness and weak saturation: robots are dark or white, objects saturated.
_TABLES: tuple[tuple[Colour, Colour, Colour], ...] = (
    (_hsv(0.08, 0.38, 0.62), _hsv(0.60, 0.10, 0.32), _hsv(0.12, 0.08, 0.70)),
    (_hsv(0.58, 0.18, 0.58), _hsv(0.09, 0.20, 0.40), _hsv(0.58, 0.05, 0.75)),
    (_hsv(0.35, 0.16, 0.56), _hsv(0.00, 0.00, 0.30), _hsv(0.33, 0.06, 0.72)),
    (_hsv(0.10, 0.16, 0.70), _hsv(0.62, 0.25, 0.35), _hsv(0.55, 0.12, 0.60)),
    (_hsv(0.02, 0.26, 0.55), _hsv(0.10, 0.10, 0.50), _hsv(0.08, 0.10, 0.68)),
    (_hsv(0.00, 0.00, 0.55), _hsv(0.58, 0.20, 0.25), _hsv(0.00, 0.00, 0.70)),
    (_hsv(0.52, 0.24, 0.52), _hsv(0.52, 0.10, 0.30), _hsv(0.15, 0.10, 0.66)),
    (_hsv(0.13, 0.30, 0.60), _hsv(0.30, 0.12, 0.33), _hsv(0.60, 0.08, 0.62)),
    (_hsv(0.75, 0.12, 0.58), _hsv(0.75, 0.08, 0.34), _hsv(0.12, 0.05, 0.72)),
    (_hsv(0.62, 0.26, 0.48), _hsv(0.08, 0.18, 0.45), _hsv(0.60, 0.10, 0.70)),
    (_hsv(0.06, 0.30, 0.48), _hsv(0.55, 0.14, 0.40), _hsv(0.06, 0.08, 0.60)),
    (_hsv(0.25, 0.14, 0.64), _hsv(0.65, 0.10, 0.38), _hsv(0.25, 0.05, 0.74)),
    (_hsv(0.45, 0.20, 0.54), _hsv(0.05, 0.20, 0.35), _hsv(0.45, 0.05, 0.70)),
    (_hsv(0.09, 0.34, 0.54), _hsv(0.58, 0.16, 0.42), _hsv(0.70, 0.06, 0.66)),
    (_hsv(0.66, 0.16, 0.62), _hsv(0.66, 0.08, 0.28), _hsv(0.10, 0.10, 0.70)),
    (_hsv(0.95, 0.14, 0.60), _hsv(0.40, 0.10, 0.36), _hsv(0.95, 0.05, 0.70)),
)
SCENES: dict[str, Look] = {f"scene_{number:02d}": _fixed(number, *colours) for number, colours in enumerate(_TABLES)}
TRAIN_SCENES, TEST_SCENES = tuple(SCENES)[:12], tuple(SCENES)[12:]


@dataclass(frozen=True)
class LookRange:
    """Ranges that looks are drawn from.

    Attributes:
        table: choices of (saturation, value), each a pair of ranges.
        tilt: of the sun: 0 is straight down, 1 is 45 degrees.
        tint: how far from white, towards warm or cold light.
        hue_deg: of things, to either side.
    """

    table: tuple[tuple[Range, Range], ...]
    textures: tuple[str | None, ...]
    tilt: Range
    light: Range
    ambient: Range
    tint: Range
    size: Range
    hue_deg: Range
    saturation: Range
    value: Range
    head: HeadCamera
    fovy_deg: Range

    def draw(self, random: np.random.Generator) -> Look:
        saturation, value = self.table[int(random.integers(len(self.table)))]
        table = _hsv(random.uniform(), random.uniform(*saturation), random.uniform(*value))
        floor, wall = (
            _hsv(random.uniform(), random.uniform(0, 0.2), random.uniform(*bright))
            for bright in ((0.25, 0.5), (0.55, 0.78))
        )
        angle, tilt, warm = (
            random.uniform(0, 2 * np.pi),
            random.uniform(*self.tilt),
            random.choice([-1, 1]) * random.uniform(*self.tint),
        )
        side = float(random.choice([-1.0, 1.0]))
        return Look(
            table, floor, wall, (float(tilt * np.cos(angle)), float(tilt * np.sin(angle)), -1.0),
            light=float(random.uniform(*self.light)), ambient=float(random.uniform(*self.ambient)),
            headlight=float(random.uniform(0.2, 0.34)), tint=(float(min(1, 1 + warm)), float(1 - abs(warm) / 2), float(min(1, 1 - warm))),
            texture=self.textures[int(random.integers(len(self.textures)))],
            repeats=(float(random.uniform(0.6, 1.6)), float(random.uniform(0.6, 1.6))),
            size=float(random.uniform(*self.size)), hue_deg=side * float(random.uniform(*self.hue_deg)),
            saturation=float(random.uniform(*self.saturation)), value=float(random.uniform(*self.value)),
            head=self.head, fovy_deg=float(random.uniform(*self.fovy_deg)),
        )  # fmt: skip


# Things stay more saturated than any table, so that they can be told apart.
WIDE = LookRange(
    table=(((0.0, 0.38), (0.34, 0.74)),), textures=(None, "grain", "checks", "stripes", "speckle"), tilt=(0.0, 0.8), light=(0.32, 0.68),
    ambient=(0.24, 0.46), tint=(0.0, 0.10), size=(0.88, 1.0), hue_deg=(0.0, 4.0), saturation=(0.88, 1.0), value=(0.82, 1.0),
    head=HeadCamera((-32.0, 32.0), (47.0, 67.0), (0.78, 0.95)), fovy_deg=(28.0, 31.0),
)  # fmt: skip
UNSEEN = LookRange(
    table=(((0.0, 0.38), (0.82, 0.94)), ((0.0, 0.38), (0.16, 0.26)), ((0.42, 0.46), (0.40, 0.60))), textures=("dots", "tiles"),
    tilt=(1.0, 1.4), light=(0.74, 0.90), ambient=(0.14, 0.20), tint=(0.12, 0.16), size=(0.78, 0.85), hue_deg=(5.0, 8.0),
    saturation=(0.76, 0.84), value=(0.68, 0.78), head=HeadCamera((-32.0, 32.0), (41.0, 45.5), (0.98, 1.05)), fovy_deg=(28.0, 31.0),
)  # fmt: skip
RANGES = {"wide": WIDE, "unseen": UNSEEN}
WIDE_TRAINING = 8000


@lru_cache(maxsize=256)
def look_of(scene: str) -> Look:
    """The look of a scene. Raises: DataError for an unknown name."""
    if not re.fullmatch(SCENE_PATTERN, scene):
        raise DataError("Unknown scene", expected="scene_00 .. scene_15, wide_0000 .., unseen_0000 ..", got=scene)
    if scene in SCENES:
        return SCENES[scene]
    name, number = scene.split("_")
    return RANGES[name].draw(np.random.default_rng((7100, _STREAM[name], int(number))))


def scenes(look: LookName, training: bool) -> tuple[str, ...]:
    """Names of the scenes to choose from. Raises: DataError for unseen looks in training."""
    if look == "plain":
        return TRAIN_SCENES if training else TEST_SCENES
    if look == "unseen" and training:
        raise DataError("Unseen looks are not for training", expected="split test or ood_test", got="a training split")
    numbers = range(WIDE_TRAINING) if training else range(WIDE_TRAINING, 9000) if look == "wide" else range(1000)
    return tuple(f"{look}_{number:04d}" for number in numbers)


def trains(scene: str) -> bool:
    """True for scenes of training recordings."""
    return scene in TRAIN_SCENES or (scene.startswith("wide_") and int(scene[-4:]) < WIDE_TRAINING)


def _pattern(name: str) -> np.ndarray:
    """(128, 128) 0..1: how much darker than its colour the table is."""
    random = np.random.default_rng(7200)
    across, along = np.meshgrid(*[np.arange(128) / 128] * 2)
    if name == "grain":
        streaks = cv2.resize(
            random.uniform(size=(64, 4)).astype(np.float32), (128, 128), interpolation=cv2.INTER_LINEAR
        )
        return 0.35 * streaks
    if name == "speckle":
        return 0.3 * cv2.GaussianBlur((random.uniform(size=(128, 128)) > 0.7).astype(np.float32), (0, 0), 1.2)
    waves = np.sin(8 * np.pi * across), np.sin(8 * np.pi * along)
    shapes = {
        "checks": 0.22 * (waves[0] * waves[1] > 0), "stripes": 0.25 * (waves[0] > 0),
        "dots": 0.35 * (waves[0] * waves[1] > 0.55), "tiles": 0.4 * ((across * 6 % 1 < 0.1) | (along * 6 % 1 < 0.1)),
    }  # fmt: skip
    return shapes[name]


TEXTURES = tuple(name for spread in (WIDE, UNSEEN) for name in spread.textures if name is not None)


def texture(name: str) -> np.ndarray:
    """uint8 (128, 128, 3), by which the table's colour is multiplied."""
    return np.repeat(np.rint(255 * (1 - _pattern(name))).astype(np.uint8)[..., None], 3, axis=2)
