"""The robots that the recorder drives: where their arms stand, how they rest, where their cameras look.

Variants of four robots in colours, link lengths, bases and wrist cameras. All share one workspace, so that one camera
arrangement serves them all. Base frame (= world): origin on the table's surface 0.38 m before the workspace's middle,
between the arm bases; x forward over the table, y left, z up; metres and radians. A tool pose that points straight down
has tool +z = -z of the base.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from worldline_core.shipped import shipped_folder

Colour = tuple[float, float, float]
ROBOTS_FOLDER = shipped_folder() / "robots"
# Middle of the workspace, where head cameras look, and what tools reach of it: y from the middle plane, on an arm's side.
CENTRE = (0.385, 0.0, 0.115)
REACH_X, REACH_Y = (0.31, 0.46), (0.05, 0.225)
HEAD_FOVY_DEG = 29.5


@dataclass(frozen=True)
class ArmPlacement:
    """One arm of a body; ``yaw`` turns its base about z."""

    name: str
    base_xyz: tuple[float, float, float]
    yaw: float
    home: tuple[float, ...]


@dataclass(frozen=True)
class CameraMount:
    """Position and target of a wrist camera [m], with its vertical field of view.

    Tool frame: x back towards the robot, y the direction in which the fingers open, z out of the gripper.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    fovy_deg: float


WRIST_STEEP = CameraMount(eye=(0.10, 0.0, -0.105), target=(0.005, 0.0, 0.02), fovy_deg=66.0)
WRIST_FLAT = CameraMount(eye=(0.125, 0.0, -0.09), target=(0.0, 0.0, 0.03), fovy_deg=62.0)


@dataclass(frozen=True)
class Robot:
    """A body as the recorder sees it.

    Attributes:
        model: folder name under artifacts/shipped/robots.
        finger_travel: (closed, open) of each finger joint [m].
        colours: pairs (mesh colour of the source model, rounded to quarters; colour drawn instead), so that every
            robot stands out from the tables.
        link_scale: lengthens or shortens the arm from its base to the wrist; hand and fingers keep their size.
        reach_y: where tools may be [m]: from the middle plane on an arm's own side; of a single arm, on both sides.
        stream: number of its random draws; it never changes, because recordings must stay the same.
    """

    name: str
    model: str
    arms: tuple[ArmPlacement, ...]
    finger_travel: tuple[float, float]
    colours: tuple[tuple[Colour, Colour], ...]
    wrist: CameraMount
    link_scale: float
    reach_y: tuple[float, float]
    stream: int

    def side(self, arm: int) -> float:
        """-1 for an arm whose half of the table is y < 0, +1 otherwise; a single arm uses the whole width."""
        return -1.0 if len(self.arms) == 2 and self.arms[arm].name == "right" else 1.0

    def fingers(self, opening: np.ndarray) -> np.ndarray:
        """Finger joint positions [m] for an opening 0 (closed) .. 1 (open)."""
        closed, opened = self.finger_travel
        return closed + np.asarray(opening) * (opened - closed)

    def opening(self, fingers: np.ndarray) -> np.ndarray:
        """Opening 0..1 (clipped) from finger joints (..., F)."""
        closed, opened = self.finger_travel
        return np.clip((np.mean(fingers, axis=-1) - closed) / (opened - closed), 0.0, 1.0)


_VIPERX_HOME = (0.0, -0.75, 0.95, 0.0, 1.2, 0.0)
_UR5E_HOME = (-0.3, -1.9, 2.3, -1.97, -1.57, -1.87)
_XARM7_HOME = (0.0, -0.4, 0.0, 0.9, 0.0, 1.3, 0.0)
_PANDA_HOME = (0.0, 0.0, 0.0, -2.3, 0.0, 2.3, 0.785)


def _body(
    name: str,
    stream: int,
    home: tuple[float, ...],
    base: tuple[float, float],
    yaw: float,
    travel: float,
    colours: tuple[tuple[Colour, Colour], ...],
    *,
    link_scale: float = 1.0,
    wrist: CameraMount = WRIST_STEEP,
) -> Robot:
    """A pair of arms, or one in the middle plane; ``base`` is (x, distance from that plane) [m].

    The model is the name's first word.
    """
    x, distance = base
    right = ArmPlacement("right", (x, 0.0 - distance, 0.0), yaw, home)
    pair = distance > 0
    return Robot(
        name=name,
        model=name.split("_")[0],
        arms=(ArmPlacement("left", (x, distance, 0.0), -yaw, home), right) if pair else (right,),
        finger_travel=(0.0, travel),
        colours=colours,
        wrist=wrist,
        link_scale=link_scale,
        reach_y=REACH_Y if pair else (-0.14, 0.14),
        stream=stream,
    )


# Six pairs and a single arm are for training; panda_ivory is held out. Colours stay weakly saturated: things are
# saturated.
_BODIES = (
    _body("viperx_graphite", 5, _VIPERX_HOME, (0.0, 0.27), 0.15, 0.042, (((0.5, 0.5, 0.5), (0.13, 0.13, 0.15)),)),
    _body(
        "viperx_pearl", 6, _VIPERX_HOME, (-0.03, 0.31), 0.25, 0.042, (((0.5, 0.5, 0.5), (0.86, 0.86, 0.84)),),
        link_scale=1.1, wrist=WRIST_FLAT,
    ),
    _body("ur5e_silver", 7, _UR5E_HOME, (-0.07, 0.38), 0.0, 0.040, (((0.75, 0.0, 0.0), (0.20, 0.20, 0.22)),)),
    _body(
        "ur5e_slate", 8, _UR5E_HOME, (-0.04, 0.33), 0.1, 0.040,
        (
            ((0.75, 0.0, 0.0), (0.30, 0.33, 0.38)), ((0.75, 0.75, 0.75), (0.24, 0.28, 0.34)),
            ((0.5, 0.75, 0.75), (0.70, 0.68, 0.62)), ((0.25, 0.25, 0.25), (0.62, 0.60, 0.55)),
            ((0.0, 0.0, 0.0), (0.34, 0.36, 0.40)),
        ),
        link_scale=0.94, wrist=WRIST_FLAT,
    ),
    _body("xarm7_white", 9, _XARM7_HOME, (-0.06, 0.30), 0.0, 0.042, (((1.0, 1.0, 1.0), (0.86, 0.87, 0.90)),)),
    _body(
        "xarm7_bronze", 10, _XARM7_HOME, (-0.08, 0.35), 0.2, 0.042,
        (((1.0, 1.0, 1.0), (0.46, 0.38, 0.31)), ((0.25, 0.25, 0.25), (0.16, 0.15, 0.14))),
        link_scale=1.07, wrist=WRIST_FLAT,
    ),
    _body("xarm7_single", 12, _XARM7_HOME, (-0.06, 0.0), 0.0, 0.042, (((1.0, 1.0, 1.0), (0.60, 0.64, 0.70)),)),
    _body("panda_ivory", 11, _PANDA_HOME, (-0.08, 0.32), 0.0, 0.040, (((1.0, 1.0, 1.0), (0.84, 0.80, 0.72)),)),
)  # fmt: skip
HELD_OUT_BODY = "panda_ivory"
BODIES: dict[str, Robot] = {body.name: body for body in _BODIES}
