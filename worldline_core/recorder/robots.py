"""The robots that the recorder drives: where their arms stand, how they rest, what they reach.

Base frame (= world): origin on the table's surface at the middle between the arm bases, x forward over the table,
y left, z up; metres and radians. A tool pose that points straight down has tool +z = -z of the base.
"""

from __future__ import annotations

from dataclasses import dataclass

from worldline_core.shipped import shipped_folder

Colour = tuple[float, float, float]
ROBOTS_FOLDER = shipped_folder() / "robots"


@dataclass(frozen=True)
class ArmPlacement:
    """One arm of an embodiment; ``yaw`` turns its base about z."""

    name: str
    base_xyz: tuple[float, float, float]
    yaw: float
    home: tuple[float, ...]


@dataclass(frozen=True)
class CameraMount:
    """Where a camera stands and what it looks at [m], with its vertical field of view.

    Head cameras are given in the base frame, wrist cameras in the tool frame (x back towards the robot, y the direction
    in which the fingers open, z out of the gripper).
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    fovy_deg: float


HEAD = CameraMount(eye=(-0.02, 0.0, 0.86), target=(0.40, 0.0, 0.08), fovy_deg=39.0)
# The larger arms carry their hands higher, so their camera looks higher too.
HEAD_LARGE = CameraMount(eye=(-0.02, 0.0, 0.98), target=(0.47, 0.0, 0.12), fovy_deg=39.0)
WRIST = CameraMount(eye=(0.10, 0.0, -0.105), target=(0.005, 0.0, 0.02), fovy_deg=62.0)


@dataclass(frozen=True)
class Robot:
    """An embodiment as the recorder sees it.

    Attributes:
        model: folder name under artifacts/shipped/robots.
        finger_travel: (closed, open) of each finger joint [m], or of the jaw [rad].
        jaw: the gripper is one rotating jaw instead of two sliding fingers.
        reach_x, reach_y: ranges of tool positions over the table [m]; y is the distance from the middle plane on the
            arm's own side (the whole width for a single arm).
        scale: size of objects and heights, 1.0 for ViperX.
        colours: pairs (mesh colour of the source model, rounded to quarters; colour drawn instead), so that every
            robot stands out from the tables.
        link_scale: lengthens or shortens the arm from its base to the wrist; hand and fingers keep their size.
    """

    name: str
    model: str
    arms: tuple[ArmPlacement, ...]
    finger_travel: tuple[float, float]
    reach_x: tuple[float, float]
    reach_y: tuple[float, float]
    scale: float
    head: CameraMount
    colours: tuple[tuple[Colour, Colour], ...]
    wrist: CameraMount = WRIST
    jaw: bool = False
    link_scale: float = 1.0


def _pair(distance: float, yaw: float, home: tuple[float, ...]) -> tuple[ArmPlacement, ...]:
    left = ArmPlacement("left", (0.0, distance, 0.0), -yaw, home)
    right = ArmPlacement("right", (0.0, -distance, 0.0), yaw, home)
    return (left, right)


_ROBOTS = (
    Robot(
        name="aloha_viperx",
        model="viperx",
        arms=_pair(0.27, 0.15, (0.0, -0.75, 0.95, 0.0, 1.2, 0.0)),
        finger_travel=(0.0, 0.042),
        reach_x=(0.26, 0.46),
        reach_y=(0.05, 0.30),
        scale=1.0,
        head=HEAD,
        colours=(((0.5, 0.5, 0.5), (0.13, 0.13, 0.15)),),
    ),
    Robot(
        name="ur5e_pair",
        model="ur5e",
        arms=_pair(0.38, 0.0, (-0.3, -1.9, 2.3, -1.97, -1.57, -1.87)),
        finger_travel=(0.0, 0.040),
        reach_x=(0.34, 0.56),
        reach_y=(0.06, 0.34),
        scale=1.1,
        head=HEAD_LARGE,
        colours=(((0.75, 0.0, 0.0), (0.20, 0.20, 0.22)),),
    ),
    Robot(
        name="xarm7_pair",
        model="xarm7",
        arms=_pair(0.30, 0.0, (0.0, -0.4, 0.0, 0.9, 0.0, 1.3, 0.0)),
        finger_travel=(0.0, 0.042),
        reach_x=(0.32, 0.54),
        reach_y=(0.06, 0.32),
        scale=1.1,
        head=HEAD_LARGE,
        colours=(((1.0, 1.0, 1.0), (0.86, 0.87, 0.90)),),
    ),
    Robot(
        name="panda_pair",
        model="panda",
        arms=_pair(0.32, 0.0, (0.0, 0.0, 0.0, -2.3, 0.0, 2.3, 0.785)),
        finger_travel=(0.0, 0.040),
        reach_x=(0.36, 0.58),
        reach_y=(0.06, 0.34),
        scale=1.1,
        head=HEAD_LARGE,
        colours=(((1.0, 1.0, 1.0), (0.84, 0.80, 0.72)),),
    ),
    Robot(
        name="so101",
        model="so101",
        arms=(ArmPlacement("right", (0.0, 0.0, 0.0), 0.0, (0.0, -0.6, 0.6, 1.2, 0.0)),),
        finger_travel=(-0.1, 1.0),
        jaw=True,
        reach_x=(0.18, 0.29),
        reach_y=(-0.12, 0.12),
        scale=0.6,
        head=CameraMount(eye=(0.02, 0.0, 0.50), target=(0.20, 0.0, 0.02), fovy_deg=40.0),
        wrist=CameraMount(eye=(0.05, 0.0, -0.07), target=(0.0, 0.0, 0.02), fovy_deg=70.0),
        colours=(((1.0, 0.75, 0.0), (0.93, 0.90, 0.80)),),
    ),
)
ROBOTS: dict[str, Robot] = {robot.name: robot for robot in _ROBOTS}
