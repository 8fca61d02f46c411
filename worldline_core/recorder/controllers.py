"""Scripted controllers: waypoints of each arm, with errors as wide as a hand, and the joint targets that follow them.

Grippers close and open over more than half a second, and the last second shows how it ended. Whether a plan goes wrong
is drawn; whether it went wrong is measured afterwards (``simulate.outcome``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.errors import DataError
from worldline_core.recorder.bodies import REACH_X, Robot
from worldline_core.recorder.scene import (
    BUTTON_CAP_HALF,
    DRAWER_TRAVEL,
    HANDLE_APART,
    PLATE_TOP,
    Layout,
    SceneModel,
    free_tool,
)

# Rotation of a tool whose fingers point straight down: x back to the robot, y to the left, z down (columns, base frame).
DOWN = np.diag([-1.0, 1.0, -1.0])
# Weight of orientation errors against position errors [m/rad].
ROTATION_WEIGHT = 0.3
# A task takes less than this [s]; what is left of a longer recording, arms move on.
TASK_SECONDS = 5.0
# A hand's width [m]: how far a plan that goes wrong passes beside its thing.
BESIDE = (0.085, 0.12)
GRASP_HEIGHT, HANDLE_HEIGHT, DRAWER_HEIGHT = 0.088, 0.084, 0.052
PRESSED_HEIGHT, CAP_TOP = 0.045, PLATE_TOP + 2 * BUTTON_CAP_HALF
# Openings: wide, and relaxed just so far that a thing slips out.
WIDE, RELAXED = (0.93, 1.0), (0.80, 0.84)

# What is planned, and how often; the rest succeeds, if physics agrees.
_LIFT = {"good": 0.50, "beside": 0.17, "high": 0.07, "open": 0.06, "relax": 0.06, "release": 0.06, "low": 0.08}
_PLACE = {"good": 0.62, "beside": 0.12, "high": 0.04, "relax": 0.05, "release": 0.07, "elsewhere": 0.12, "keep": 0.06}
_CLOSE = {"good": 0.50, "short": 0.26, "beside": 0.14, "high": 0.10}
_CARRY = {"good": 0.52, "beside": 0.12, "high": 0.07, "open": 0.06, "relax": 0.08, "release": 0.09, "low": 0.06}
_PRESS = {"good": 0.54, "short": 0.16, "beside": 0.16, "other": 0.14}


@dataclass(frozen=True)
class Waypoint:
    """Tool pose at a time; ``opening`` is the commanded gripper opening 0..1."""

    time: float
    position: tuple[float, float, float]
    yaw: float
    opening: float


Bias = Annotated[float, Field(ge=-0.5, le=0.5)]
MISSES: dict[str, dict[str, float]] = {
    "lift": {"beside": 0.10, "low": 0.14},
    "place": {"beside": 0.10, "release_off": 0.12},
    "close": {"left_open": 0.8, "beside": 0.16},
    "press": {"short": 0.08, "beside": 0.10},
    "carry": {"beside": 0.10, "low": 0.14},
}
"""Largest sizes of each task's misses, well beyond where the outcome turns [m; share of a drawer's travel]."""


class Miss(StrictModel):
    """One deviation from the right plan, of any size.

    Attributes:
        kind: aims beside the thing (of two hands, one does) or releases it beside its goal (in a drawn direction), ends a press above
            the table, leaves a drawer open, or raises a thing only by ``size``.
    """

    kind: Literal["beside", "release_off", "short", "left_open", "low"]
    size: float = Field(ge=0, le=1)


class ScriptedPolicy(StrictModel):
    """A controller that knows the right plan and carries it out badly.

    Attributes:
        mistakes: share of the episodes whose plan is wrong (missed by a hand's width, dropped, wrong place, ..); ``None``:
            that of the task.
        noise_m: standard deviation of each episode's error of aim, along x and along y.
        bias_m: error of aim of all episodes, along x and along y of the robot's base.
        delay_frames: everything happens this many frames late.
        gripper_delay_frames: the gripper moves this many frames after the arm; below zero before it.
        miss: one more deviation.
    """

    mistakes: float | None = Field(default=0.0, ge=0, le=1)
    noise_m: float = Field(default=0.0, ge=0, le=0.2)
    bias_m: tuple[Bias, Bias] = (0.0, 0.0)
    delay_frames: int = Field(default=0, ge=0, le=32)
    gripper_delay_frames: int = Field(default=0, ge=-32, le=32)
    miss: Miss | None = None


def miss_of(share: float, family: str, entropy: tuple[int, ...]) -> ScriptedPolicy | None:
    """That share of the plans: the right one with a miss, its size even from nothing to the largest. None: no miss of this task's."""
    random = np.random.default_rng((*entropy, 3))
    if family not in MISSES or random.uniform() >= share:
        return None
    kind = str(random.choice(list(MISSES[family])))
    return ScriptedPolicy(miss=Miss.model_validate({"kind": kind, "size": random.uniform(0, MISSES[family][kind])}))


def _draw(plans: dict[str, float], random: np.random.Generator, mistakes: float | None) -> str:
    shares = np.array(list(plans.values()))
    if mistakes is not None:
        good = np.array([plan == "good" for plan in plans])
        shares = np.where(good, 1.0 - mistakes, mistakes * shares / shares[~good].sum())
    return str(random.choice(list(plans), p=shares / shares.sum()))


def waypoint(time: float, xy: np.ndarray, z: float, yaw: float, opening: float) -> Waypoint:
    """A waypoint from numpy numbers."""
    return Waypoint(time, (float(xy[0]), float(xy[1]), float(z)), float(yaw), float(opening))


def _beside(robot: Robot, layout: Layout, random: np.random.Generator) -> np.ndarray:
    """(2,) a hand's width in any direction, but not towards the other arm's half."""
    angle, length = random.uniform(0, 2 * np.pi), random.uniform(*BESIDE)
    offset = length * np.array([np.cos(angle), np.sin(angle)])
    outwards = robot.side(layout.arm)
    if abs(layout.target.y + offset[1]) > robot.reach_y[1] or outwards * (layout.target.y + offset[1]) < 0.02:
        offset[1] = -offset[1]
    if not REACH_X[0] - 0.03 < layout.target.x + offset[0] < REACH_X[1] + 0.03:
        offset[0] = -offset[0]
    return offset


def first_waypoint(layout: Layout, arm: int) -> Waypoint:
    """The place of an arm at the layout's start."""
    x, y, z, yaw, opening = layout.start[arm]
    return waypoint(0.0, np.array([x, y]), z, yaw, opening)


def _grasp(
    robot: Robot, layout: Layout, random: np.random.Generator, plan: str, times: np.ndarray
) -> tuple[list[Waypoint], np.ndarray, float, float, float]:
    """Waypoints up to the closed gripper; where it closed (2,), its height, turn and opening."""
    target = layout.target
    xy = target.xy + random.normal(0, 0.004, 2) + (_beside(robot, layout, random) if plan == "beside" else 0.0)
    height = GRASP_HEIGHT * target.size if plan != "high" else 2 * target.standing + random.uniform(0.045, 0.07)
    yaw, opened = target.yaw + random.normal(0, 0.06), random.uniform(*WIDE)
    closed = random.uniform(0.9, 1.0) if plan == "open" else 0.0
    points = [
        first_waypoint(layout, layout.arm),
        waypoint(times[0], xy, 0.20, yaw, opened),
        waypoint(times[1], xy, height, yaw, opened),
        waypoint(times[2], xy, height, yaw, closed),
    ]
    return points, xy, height, yaw, closed


def _lift(robot: Robot, layout: Layout, random: np.random.Generator, mistakes: float | None) -> list[Waypoint]:
    plan, pace = _draw(_LIFT, random, mistakes), random.uniform(0.96, 1.03)
    times = pace * np.array([0.8, 1.2, 1.85, 2.75, 3.4])
    points, xy, height, yaw, closed = _grasp(robot, layout, random, plan, times)
    rise = random.uniform(0.02, 0.035) if plan == "low" else random.uniform(0.13, 0.18)
    away = xy + random.normal(0, 0.015, 2)
    if plan == "relax":
        closed = random.uniform(*RELAXED)
    points.append(waypoint(times[3], away, height + rise, yaw, closed))
    if plan == "release":
        points.append(waypoint(times[4], away, height + rise, yaw, random.uniform(*WIDE)))
    return points


def _place(robot: Robot, layout: Layout, random: np.random.Generator, mistakes: float | None) -> list[Waypoint]:
    if layout.goal is None:
        raise DataError("The layout does not fit the task", where=layout.family, expected="a pad")
    plan, pace = _draw(_PLACE, random, mistakes), random.uniform(0.97, 1.02)
    times = pace * np.array([0.65, 0.95, 1.5, 1.85, 2.4, 2.65, 3.1, 3.45])
    points, xy, height, yaw, closed = _grasp(robot, layout, random, plan, times)
    goal = layout.goal.xy + random.normal(0, 0.006, 2)
    if plan == "elsewhere":
        goal = _elsewhere(robot, layout, random)
    turn, opened = yaw + random.uniform(-0.3, 0.3), random.uniform(*WIDE)
    carried = height + 0.09
    if plan == "relax":
        closed = random.uniform(*RELAXED)
    points.append(waypoint(times[3], xy + 0.25 * (goal - xy), carried, yaw, closed))
    if plan == "release":
        middle = xy + random.uniform(0.4, 0.6) * (goal - xy)
        points += [waypoint(times[4], middle, carried, yaw, closed), waypoint(times[6], middle, carried, yaw, opened)]
        return points
    points.append(waypoint(times[4], goal, carried, turn, closed))
    if plan == "keep":
        return points
    points += [
        waypoint(times[5], goal, height + 0.003, turn, closed),
        waypoint(times[6], goal, height + 0.004, turn, opened),
        waypoint(times[7], goal, height + 0.11, turn, opened),
    ]
    return points


def _elsewhere(robot: Robot, layout: Layout, random: np.random.Generator) -> np.ndarray:
    """(x, y) on the arm's half, two hands' widths from the pad and from where the thing stood."""
    goal = layout.target if layout.goal is None else layout.goal
    spots = [free_tool(robot, layout.arm, random)[:2] for _ in range(40)]
    distances = [min(np.linalg.norm(s - goal.xy), np.linalg.norm(s - layout.target.xy)) for s in spots]
    far = [spot for spot, distance in zip(spots, distances, strict=True) if distance > 0.12]
    return far[0] if far else spots[int(np.argmax(distances))]


def _close(robot: Robot, layout: Layout, random: np.random.Generator, mistakes: float | None) -> list[Waypoint]:
    plan, pace = _draw(_CLOSE, random, mistakes), random.uniform(0.96, 1.03)
    times = pace * np.array([0.8, 1.2, 2.7, 3.1])
    xy, yaw, opening = layout.target.xy, random.normal(0, 0.08), random.uniform(0.0, 0.1)
    y = xy[1] + random.normal(0, 0.01)
    if plan == "beside":
        # Towards the arm's own side, so that the other arm is not in the way.
        y += robot.side(layout.arm) * random.uniform(0.12, 0.14)
    z = DRAWER_HEIGHT if plan != "high" else random.uniform(0.125, 0.15)
    front = xy[0] - 0.022
    left_open = random.uniform(0.45, 0.85) * DRAWER_TRAVEL if plan == "short" else -0.006
    before, end = np.array([front - DRAWER_TRAVEL - 0.035, y]), np.array([front - left_open, y])
    return [
        first_waypoint(layout, layout.arm),
        waypoint(times[0], before, z + 0.08, yaw, opening),
        waypoint(times[1], before, z, yaw, opening),
        waypoint(times[2], end, z, yaw, opening),
        waypoint(times[3], end - [0.06, 0.0], z + 0.06, yaw, opening),
    ]


def _press(robot: Robot, layout: Layout, random: np.random.Generator, mistakes: float | None) -> list[Waypoint]:
    plan, pace = _draw(_PRESS, random, mistakes), random.uniform(0.96, 1.03)
    times = pace * np.array([1.1, 2.4, 2.7, 3.4])
    goal = layout.target.xy + random.normal(0, 0.006, 2)
    others = [thing for thing in layout.others if thing.kind == "button"]
    if plan == "other" and others and robot.side(layout.arm) * others[0].y > 0:
        goal = others[0].xy + random.normal(0, 0.006, 2)
    elif plan in ("beside", "other"):
        goal = goal + _beside(robot, layout, random)
    z = PRESSED_HEIGHT if plan != "short" else CAP_TOP + random.uniform(0.06, 0.08)
    yaw, opening = random.normal(0, 0.2), random.uniform(0.0, 0.1)
    return [
        first_waypoint(layout, layout.arm),
        waypoint(times[0], goal, 0.19, yaw, opening),
        waypoint(times[1], goal, z, yaw, opening),
        waypoint(times[2], goal, z, yaw, opening),
        waypoint(times[3], goal - [0.04, 0.0], 0.18, yaw, opening),
    ]


def _carry(robot: Robot, layout: Layout, random: np.random.Generator, mistakes: float | None) -> list[list[Waypoint]]:
    """Both arms take the tray by its handles and raise it; what goes wrong goes wrong with one of them, or both."""
    plan, pace = _draw(_CARRY, random, mistakes), random.uniform(0.96, 1.03)
    times = pace * np.array([0.85, 1.25, 1.85, 2.65, 3.25])
    # A hand that misses lets the other try alone; both relax, and both, or one of them, let go.
    wrong = {0, 1} if plan in ("high", "relax", "low") or random.uniform() < 0.4 else {int(random.integers(2))}
    tray, rise = layout.target, random.uniform(0.02, 0.035) if plan == "low" else random.uniform(0.12, 0.16)
    along = np.array([-np.sin(tray.yaw), np.cos(tray.yaw)])
    away, yaw = random.normal(0, 0.012, 2), tray.yaw + random.normal(0, 0.05)
    plans = []
    for arm in layout.acting():
        spoiled = plan if arm in wrong else "good"
        xy = tray.xy + robot.side(arm) * HANDLE_APART * along + random.normal(0, 0.004, 2)
        if spoiled == "beside":
            xy = xy + np.array([random.choice([-1.0, 1.0]) * random.uniform(*BESIDE), 0.0])
        z = HANDLE_HEIGHT if spoiled != "high" else HANDLE_HEIGHT + random.uniform(0.085, 0.10)
        opened = random.uniform(*WIDE)
        closed = random.uniform(0.9, 1.0) if spoiled == "open" else 0.0
        carried = random.uniform(*RELAXED) if spoiled == "relax" else closed
        points = [
            first_waypoint(layout, arm),
            waypoint(times[0], xy, 0.21, yaw, opened),
            waypoint(times[1], xy, z, yaw, opened),
            waypoint(times[2], xy, z, yaw, closed),
            waypoint(times[3], xy + away, z + rise, yaw, carried),
        ]
        if spoiled == "release":
            points.append(waypoint(times[4], xy + away, z + rise, yaw, random.uniform(*WIDE)))
        plans.append(points)
    return plans


_TASKS = {"lift": _lift, "place": _place, "close": _close, "press": _press}


def _idle(robot: Robot, layout: Layout, arm: int, random: np.random.Generator, duration: float) -> list[Waypoint]:
    """The arm without a task rests, or moves slowly above the things."""
    points, time, opening = [first_waypoint(layout, arm)], 0.0, layout.start[arm][4]
    if random.uniform() < 0.4:
        return points
    while time < duration:
        time += float(random.uniform(1.3, 2.2))
        goal = layout.start[arm][:4] + 0.6 * (free_tool(robot, arm, random) - layout.start[arm][:4])
        if random.uniform() < 0.4:
            opening = random.uniform(0.7, 1.0) if opening < 0.5 else random.uniform(0.0, 0.3)
        points.append(waypoint(time, goal[:2], goal[2], goal[3], opening))
    return points


def plan_waypoints(
    robot: Robot,
    layout: Layout,
    random: np.random.Generator,
    duration: float,
    *,
    mistakes: float | None = None,
    acting: Mapping[int, list[Waypoint]] | None = None,
) -> list[list[Waypoint]]:
    """Waypoints per arm for ``duration`` seconds.

    Args:
        mistakes: the share of plans that go wrong; by default each task's own.
        acting: waypoints of the arms that act, where they are already planned.
    """
    planned: Mapping[int, list[Waypoint]] = acting or {}
    if acting is None and layout.family == "carry":
        planned = dict(enumerate(_carry(robot, layout, random, mistakes)))
    plans = []
    for arm in range(len(robot.arms)):
        if arm in planned:
            plans.append(planned[arm])
        elif acting is None and arm == layout.arm:
            plans.append(_TASKS[layout.family](robot, layout, random, mistakes))
        else:
            plans.append(_idle(robot, layout, arm, random, duration))
    if duration > TASK_SECONDS:
        _go_on(robot, layout, plans, random, duration)
    return plans


def _go_on(
    robot: Robot, layout: Layout, plans: list[list[Waypoint]], random: np.random.Generator, duration: float
) -> None:
    """Let the arms that are done move slowly above the things, with whatever they hold; two that carry move alike."""
    time = max(plans[arm][-1].time for arm in layout.acting())
    first = {arm: plans[arm][-1] for arm in layout.acting()}
    while time < duration:
        time += float(random.uniform(1.3, 2.2))
        shift = random.uniform((-0.05, -0.03, -0.02), (0.05, 0.03, 0.03))
        for arm, start in first.items():
            if len(first) > 1:
                xy, z, yaw = np.array(start.position[:2]) + shift[:2], start.position[2] + shift[2], start.yaw
            else:
                x, y, z, yaw = free_tool(robot, arm, random) + np.array([0.0, 0.0, 0.03, 0.0])
                xy = np.array([x, y])
            plans[arm].append(waypoint(time, xy, z, yaw, plans[arm][-1].opening))


def shifted(points: list[Waypoint], offset: np.ndarray) -> list[Waypoint]:
    """The waypoints moved by (x, y), but for the first, where the arm stands."""
    first, *others = points
    return [
        first,
        *(replace(point, position=(*(np.array(point.position[:2]) + offset), point.position[2])) for point in others),
    ]


def missing(robot: Robot, layout: Layout, plans: list[list[Waypoint]], miss: Miss, random: np.random.Generator) -> None:
    """Spoil the right plans of the arms that act by a miss."""
    angle = random.uniform(0, 2 * np.pi)
    offset, arms = miss.size * np.array([np.cos(angle), np.sin(angle), 0.0]), list(layout.acting())
    if miss.kind == "low":
        # The last waypoint of the task, above where the gripper closed; afterwards arms stay there.
        first, offset = 4, np.array([0.0, 0.0, miss.size])
    else:
        first = {"beside": 1, "release_off": 5, "short": 2, "left_open": 3}[miss.kind]
        arms = [int(random.choice(arms))]
    last = 5 if (layout.family, miss.kind) == ("place", "beside") else None
    if miss.kind == "short":
        last, offset = 4, np.array([0.0, 0.0, miss.size])
    if layout.family == "close":
        outwards = [0.0, robot.side(arms[0]) * miss.size, 0.0]
        offset = np.array(outwards if miss.kind == "beside" else [-miss.size * DRAWER_TRAVEL, 0.0, 0.0])
    for arm in arms:
        for number in range(len(plans[arm]))[first:last]:
            point = plans[arm][number]
            at = np.array(point.position)
            if miss.kind == "low":
                at[2] = plans[arm][3].position[2]
            plans[arm][number] = replace(point, position=tuple(at + offset))


def late(action: np.ndarray, frames: int) -> np.ndarray:
    """Rows of (N, J) that many frames later (or earlier); the first and the last one stay."""
    index = np.clip(np.arange(len(action)) - frames, 0, len(action) - 1)
    return action[index]


def sample_waypoints(points: list[Waypoint], times: np.ndarray) -> tuple[np.ndarray, ...]:
    """Minimum-jerk interpolation at ``times`` (N,): positions (N, 3), yaw (N,), opening (N,)."""
    values = np.array([[*p.position, p.yaw, p.opening] for p in points])
    knots = np.array([p.time for p in points])
    last = len(points) - 1
    left = np.clip(np.searchsorted(knots, times, side="right") - 1, 0, max(last - 1, 0))
    right = np.minimum(left + 1, last)
    span = np.maximum(knots[right] - knots[left], 1e-6)
    phase = np.clip((times - knots[left]) / span, 0.0, 1.0)
    blend = phase**3 * (10 - 15 * phase + 6 * phase**2)
    out = values[left] + blend[:, None] * (values[right] - values[left])
    return out[:, :3], out[:, 3], out[:, 4]


def tool_rotation(yaw: float) -> np.ndarray:
    """Rotation (3, 3) of a tool pointing down, turned by ``yaw`` about z."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ DOWN


class ArmSolver:
    """Inverse kinematics: damped least squares on MuJoCo's site Jacobians, in simulation data of its own."""

    def __init__(self, scene: SceneModel) -> None:
        import mujoco

        self.scene = scene
        self._data: Any = mujoco.MjData(scene.model)
        self._jac_pos = np.zeros((3, scene.model.nv))
        self._jac_rot = np.zeros((3, scene.model.nv))

    def solve(
        self, arm: int, start: np.ndarray, position: np.ndarray, rotation: np.ndarray, iterations: int = 60
    ) -> tuple[np.ndarray, float]:
        """Joint angles (J,) of one arm whose tool site is at ``position`` (3,) with ``rotation`` (3, 3).

        Returns the joints and the remaining position error [m]. The null space of redundant arms draws
        them towards their resting pose.
        """
        import mujoco

        data, model, robot = self._data, self.scene.model, self.scene.robot
        indices = self.scene.arms[arm]
        dofs, site = indices.dofs, indices.tool_site
        low, high = indices.limits.T
        home = np.asarray(robot.arms[arm].home)
        joints = np.clip(np.asarray(start, dtype=np.float64), low, high)
        error_pos = np.inf
        for _ in range(iterations):
            data.qpos[indices.qpos] = joints
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            current = data.site_xmat[site].reshape(3, 3)
            delta = position - data.site_xpos[site]
            # Rotation error as the axis-angle of target * current^T, good up to pi.
            quat, turn = np.zeros(4), np.zeros(3)
            mujoco.mju_mat2Quat(quat, np.ascontiguousarray(rotation @ current.T).reshape(9))
            mujoco.mju_quat2Vel(turn, quat, 1.0)
            error_pos = float(np.linalg.norm(delta))
            if error_pos < 5e-4 and np.linalg.norm(turn) < 5e-3:
                break
            mujoco.mj_jacSite(model, data, self._jac_pos, self._jac_rot, site)
            jacobian = np.concatenate([self._jac_pos[:, dofs], ROTATION_WEIGHT * self._jac_rot[:, dofs]])
            target = np.concatenate([np.clip(delta, -0.1, 0.1), ROTATION_WEIGHT * np.clip(turn, -0.5, 0.5)])
            gram = jacobian @ jacobian.T + 2e-4 * np.eye(6)
            step = jacobian.T @ np.linalg.solve(gram, target)
            if len(dofs) > 6:
                pull = 0.05 * (home - joints)
                step += pull - jacobian.T @ np.linalg.solve(gram, jacobian @ pull)
            joints = np.clip(joints + step, low, high)
        return joints, error_pos
