"""Where things stand at the start of an episode, what is asked, and whether it was done.

Labels are read from the simulator's final state, never from what the controller meant to do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from worldline_core.recorder.robots import Robot
from worldline_core.recorder.scene_model import CUBE_HALF, DRAWER_TRAVEL, PAD_RADIUS, PARKED, SceneModel

OBJECT_COLOURS: dict[str, tuple[float, float, float]] = {
    "red": (0.90, 0.06, 0.06),
    "green": (0.05, 0.72, 0.12),
    "blue": (0.06, 0.20, 0.95),
    "yellow": (0.98, 0.88, 0.05),
    "purple": (0.60, 0.08, 0.80),
    "orange": (1.00, 0.48, 0.02),
}


@dataclass(frozen=True)
class Layout:
    """Initial state and instruction of an episode; an object that is not used is None.

    Attributes:
        arm: number of the arm that acts.
        start: per arm (x, y, z, yaw, opening) of the tool and gripper at the first frame.
        cube, other: (x, y, yaw) of the cube of the task and of a second one, base frame [m, rad].
        pad, cabinet: (x, y) of the pad's centre and of the closed drawer's front [m].
    """

    family: str
    instruction: str
    arm: int
    start: np.ndarray
    cube: tuple[float, float, float] | None
    cube_colour: str
    other: tuple[float, float, float] | None
    other_colour: str
    pad: tuple[float, float] | None
    pad_colour: str
    cabinet: tuple[float, float] | None
    drawer_colour: str


def side(robot: Robot, arm: int) -> float:
    """+1 for an arm whose half of the table is y > 0, -1 otherwise; a single arm uses the whole width."""
    return -1.0 if len(robot.arms) == 2 and robot.arms[arm].name == "right" else 1.0


def sample_point(robot: Robot, arm: int, random: np.random.Generator, margin: float = 0.0) -> np.ndarray:
    """(x, y) uniformly over what the arm reaches, ``margin`` metres inside of it."""
    x = random.uniform(robot.reach_x[0] + margin, robot.reach_x[1] - margin)
    y = random.uniform(robot.reach_y[0] + margin, robot.reach_y[1] - margin)
    return np.array([x, side(robot, arm) * y])


def sample_tool(robot: Robot, arm: int, random: np.random.Generator) -> np.ndarray:
    """(x, y, z, yaw) of a free tool pose above the objects."""
    x, y = sample_point(robot, arm, random)
    return np.array([x, y, random.uniform(0.10, 0.23) * robot.scale, random.uniform(-0.5, 0.5)])


def sample_layout(robot: Robot, family: str, random: np.random.Generator) -> Layout:
    """Draw an initial state for a task of ``family``."""
    scale = robot.scale
    arm = int(random.integers(len(robot.arms)))
    colours = [str(c) for c in random.permutation(sorted(OBJECT_COLOURS))]
    start = np.stack([[*sample_tool(robot, a, random), random.uniform(0.0, 1.0)] for a in range(len(robot.arms))])
    cube = pad = cabinet = other = None
    margin = 0.02 * scale
    if family == "state_change":
        y = side(robot, arm) * random.uniform(robot.reach_y[0] + 0.03 * scale, robot.reach_y[1] - 0.07 * scale)
        cabinet = (robot.reach_x[1] - 0.01 * scale + float(random.uniform(-0.015, 0.015)) * scale, float(y))
        instruction = f"push the {colours[0]} drawer closed"
    else:
        xy = sample_point(robot, arm, random, margin)
        cube = (float(xy[0]), float(xy[1]), float(random.uniform(-0.5, 0.5)))
        instruction = "move the arms freely" if family == "play" else f"lift the {colours[0]} cube"
        if family == "place":
            xy_pad = sample_point(robot, arm, random, margin)
            tries = 0
            while np.linalg.norm(xy_pad - xy) <= 0.135 * scale:
                # Around a cube in the middle of a small reach there is no room for a pad: then move the cube.
                tries += 1
                if tries % 100 == 0:
                    xy = sample_point(robot, arm, random, margin)
                    cube = (float(xy[0]), float(xy[1]), cube[2])
                xy_pad = sample_point(robot, arm, random, margin)
            pad = (float(xy_pad[0]), float(xy_pad[1]))
            instruction = f"place the {colours[0]} cube on the {colours[1]} pad"
    if random.uniform() < 0.5:
        for _ in range(20):
            spot = sample_point(robot, int(random.integers(len(robot.arms))), random, margin)
            taken = [np.array(p[:2]) for p in (cube, pad) if p is not None]
            if cabinet is not None:
                taken += [np.array([cabinet[0] - reach * scale, cabinet[1]]) for reach in (0.0, 0.1, 0.2)]
            if all(np.linalg.norm(spot - p) > 0.14 * scale for p in taken):
                other = (float(spot[0]), float(spot[1]), float(random.uniform(-0.7, 0.7)))
                break
    return Layout(
        family=family,
        instruction=instruction,
        arm=arm,
        start=start,
        cube=cube,
        cube_colour=colours[0],
        other=other,
        other_colour=colours[2],
        pad=pad,
        pad_colour=colours[1],
        cabinet=cabinet,
        drawer_colour=colours[0],
    )


def apply_layout(scene: SceneModel, data: Any, layout: Layout) -> None:
    """Reset ``data`` and put every object at its place; unused objects float far away."""
    import mujoco

    model, scale = scene.model, scene.robot.scale
    mujoco.mj_resetData(model, data)
    for number, (name, pose, colour) in enumerate(
        (("cube", layout.cube, layout.cube_colour), ("other", layout.other, layout.other_colour))
    ):
        address = int(model.joint(name).qposadr[0])
        body = model.body(name).id
        model.geom_rgba[model.geom(name).id] = [*OBJECT_COLOURS[colour], 1.0]
        model.body_gravcomp[body] = 0.0 if pose is not None else 1.0
        if pose is None:
            data.qpos[address : address + 7] = [*(PARKED + np.array([0.0, number, 0.0])), 1, 0, 0, 0]
        else:
            half_angle = pose[2] / 2
            place = [pose[0], pose[1], CUBE_HALF * scale + 0.0005]
            data.qpos[address : address + 7] = [*place, np.cos(half_angle), 0, 0, np.sin(half_angle)]
    pad = model.body("pad").id
    model.body_pos[pad] = PARKED if layout.pad is None else [*layout.pad, 0.0015]
    model.geom_rgba[model.geom("pad").id] = [*OBJECT_COLOURS[layout.pad_colour], 1.0]
    cabinet = model.body("cabinet").id
    model.body_pos[cabinet] = PARKED if layout.cabinet is None else [*layout.cabinet, 0.0]
    for name in ("drawer", "drawer_front"):
        model.geom_rgba[model.geom(name).id] = [*OBJECT_COLOURS[layout.drawer_colour], 1.0]
    for name in ("cabinet_top", "cabinet_left", "cabinet_right", "cabinet_back"):
        model.geom_rgba[model.geom(name).id] = [0.42, 0.36, 0.32, 1.0]
    data.qpos[int(model.joint("drawer").qposadr[0])] = 0.0 if layout.cabinet is None else DRAWER_TRAVEL * scale


def outcome(scene: SceneModel, data: Any, layout: Layout) -> str:
    """``success``, ``failure`` or (play) ``unknown``, read from the physical state in ``data``.

    lift: the cube's centre is 5 cm (times scale) above where it rests. place: the cube rests flat on the pad, its
    centre inside 0.8 pad radii, and no finger touches it. state_change: the drawer is at most 15 % open.
    """
    model, scale = scene.model, scene.robot.scale
    if layout.family == "play":
        return "unknown"
    if layout.family == "state_change":
        opened = float(data.qpos[int(model.joint("drawer").qposadr[0])])
        return "success" if opened < 0.15 * DRAWER_TRAVEL * scale else "failure"
    address = int(model.joint("cube").qposadr[0])
    position = data.qpos[address : address + 3]
    if layout.family == "lift":
        return "success" if position[2] > (CUBE_HALF + 0.05) * scale else "failure"
    geom = model.geom("cube").id
    touched = any(
        geom in (int(a), int(b)) and (scene.robot_geoms[int(a)] or scene.robot_geoms[int(b)])
        for a, b in data.contact.geom[: data.ncon]
    )
    distance = float(np.linalg.norm(position[:2] - np.asarray(layout.pad)))
    resting = position[2] < 1.3 * CUBE_HALF * scale
    return "success" if resting and not touched and distance < 0.8 * PAD_RADIUS * scale else "failure"
