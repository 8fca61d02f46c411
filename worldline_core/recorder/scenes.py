"""Scenes: plain colours, light and head-camera pose; training and test scenes share no id and no colours."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np

Colour = tuple[float, float, float]

OBJECT_COLOURS: dict[str, Colour] = {
    "red": (0.90, 0.06, 0.06),
    "green": (0.05, 0.72, 0.12),
    "blue": (0.06, 0.20, 0.95),
    "yellow": (0.98, 0.88, 0.05),
    "purple": (0.60, 0.08, 0.80),
    "orange": (1.00, 0.48, 0.02),
}


@dataclass(frozen=True)
class Scene:
    """``camera_shift`` (3,) moves the head camera's eye [m, times the robot's scale], ``target_shift`` its target."""

    scene_id: str
    table: Colour
    floor: Colour
    wall: Colour
    light_direction: tuple[float, float, float]
    light: float
    ambient: float
    camera_shift: tuple[float, float, float]
    target_shift: tuple[float, float, float]


def _hsv(hue: float, saturation: float, value: float) -> Colour:
    red, green, blue = colorsys.hsv_to_rgb(hue % 1.0, saturation, value)
    return (red, green, blue)


def _scene(number: int, table: Colour, floor: Colour, wall: Colour) -> Scene:
    random = np.random.default_rng(7000 + number)
    direction = (float(random.uniform(-0.5, 0.5)), float(random.uniform(-0.5, 0.5)), -1.0)
    shift = random.uniform((-0.05, -0.05, -0.04), (0.05, 0.05, 0.06))
    target = random.uniform((-0.02, -0.03, 0.0), (0.02, 0.03, 0.0))
    return Scene(
        scene_id=f"scene_{number:02d}",
        table=table,
        floor=floor,
        wall=wall,
        light_direction=direction,
        light=float(random.uniform(0.42, 0.62)),
        ambient=float(random.uniform(0.30, 0.42)),
        camera_shift=(float(shift[0]), float(shift[1]), float(shift[2])),
        target_shift=(float(target[0]), float(target[1]), 0.0),
    )


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
SCENES: dict[str, Scene] = {
    scene.scene_id: scene for scene in (_scene(number, *colours) for number, colours in enumerate(_TABLES))
}
TRAIN_SCENES: tuple[str, ...] = tuple(f"scene_{n:02d}" for n in range(12))
TEST_SCENES: tuple[str, ...] = tuple(f"scene_{n:02d}" for n in range(12, 16))
