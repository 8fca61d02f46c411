"""Scripted controllers with errors: tool waypoints of each arm for a layout, and the joint targets that follow them.

The drawn errors decide how well a task goes; whether it went well is measured afterwards (``task_layout.outcome``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from worldline_core.errors import DataError
from worldline_core.recorder.robots import Robot
from worldline_core.recorder.scene_model import DRAWER_TRAVEL, FRAME_RATE, SceneModel
from worldline_core.recorder.task_layout import Layout, sample_tool, side

# Rotation of a tool whose fingers point straight down: x back to the robot, y to the left, z down (columns, base frame).
DOWN = np.diag([-1.0, 1.0, -1.0])


@dataclass(frozen=True)
class Waypoint:
    """Tool pose at a time; ``opening`` is the commanded gripper opening 0..1."""

    time: float
    position: tuple[float, float, float]
    yaw: float
    opening: float
    pitch: float = 0.0


def _point(time: float, xy: np.ndarray, z: float, yaw: float, opening: float, pitch: float = 0.0) -> Waypoint:
    return Waypoint(time, (float(xy[0]), float(xy[1]), float(z)), float(yaw), float(opening), float(pitch))


def _direction(random: np.random.Generator, low: float, high: float) -> np.ndarray:
    angle, length = random.uniform(0, 2 * np.pi), random.uniform(low, high)
    return length * np.array([np.cos(angle), np.sin(angle)])


def _pick(layout: Layout, robot: Robot, random: np.random.Generator) -> list[Waypoint]:
    """Waypoints of a lift or place, with one drawn error: offset, too high, too weak, late, short, dropped, misplaced."""
    scale = robot.scale
    if layout.cube is None:
        raise DataError("The layout does not fit the task", where=layout.family, expected="a cube")
    placing = layout.family == "place"
    cube, yaw = np.array(layout.cube[:2]), layout.cube[2] + random.normal(0, 0.08)
    grasp_xy = cube + random.normal(0, 0.004 * scale, 2)
    kinds = ["none", "offset", "high", "weak", "late"] + (["drop", "misplace"] if placing else ["short", "drop"])
    weights = np.array([0.44, 0.22, 0.06, 0.06, 0.04] + ([0.05, 0.13] if placing else [0.08, 0.10]))
    kind = str(random.choice(kinds, p=weights / weights.sum()))
    if kind == "offset":
        grasp_xy = grasp_xy + _direction(random, 0.02 * scale, 0.06 * scale)
    grasp_z = (0.018 if kind != "high" else random.uniform(0.055, 0.085)) * scale
    opened = random.uniform(0.85, 1.0)
    closed = 0.0 if kind != "weak" else random.uniform(0.75, 0.9)
    pace = random.uniform(0.9, 1.08)
    above = random.uniform(0.09, 0.13) * scale
    start = layout.start[layout.arm]
    if placing:
        times = np.array([0.0, 0.85, 1.3, 1.62, 2.1, 2.75, 3.1, 3.35, 3.8]) * pace
    else:
        times = np.array([0.0, 1.05, 1.65, 2.0, 2.9, 3.8]) * pace
    points = [
        _point(0.0, start[:2], start[2], start[3], start[4]),
        _point(times[1], grasp_xy, grasp_z + above, yaw, opened),
        _point(times[2], grasp_xy, grasp_z, yaw, opened),
        _point(times[3], grasp_xy, grasp_z, yaw, opened if kind == "late" else closed),
    ]
    drop_opening = random.uniform(0.9, 1.0)
    if not placing:
        height = random.uniform(0.15, 0.24) * scale if kind != "short" else random.uniform(0.02, 0.055) * scale
        away = grasp_xy + random.normal(0, 0.03 * scale, 2)
        end = closed if kind != "drop" else drop_opening
        points.append(_point(times[4], away, grasp_z + height, yaw, closed))
        points.append(_point(times[5], away, grasp_z + height + 0.01 * scale, yaw, end))
        return points
    if layout.pad is None:
        raise DataError("The layout does not fit the task", where=layout.family, expected="a pad")
    pad = np.array(layout.pad) + random.normal(0, 0.007 * scale, 2)
    if kind == "misplace":
        pad = pad + _direction(random, 0.06 * scale, 0.12 * scale)
    turn = random.uniform(-0.4, 0.4)
    middle = (grasp_xy + pad) / 2
    carry = closed if kind != "drop" else drop_opening
    points += [
        _point(times[4], middle, grasp_z + above, yaw, closed),
        _point(times[5], pad, grasp_z + above * 0.8, turn, carry),
        _point(times[6], pad, grasp_z + 0.004, turn, carry),
        _point(times[7], pad, grasp_z + 0.006, turn, opened),
        _point(times[8], pad, grasp_z + above, turn, opened),
    ]
    return points


def _push(layout: Layout, robot: Robot, random: np.random.Generator) -> list[Waypoint]:
    """Waypoints that push the drawer towards +x, or stop short, pass beside it or above it."""
    scale = robot.scale
    if layout.cabinet is None:
        raise DataError("The layout does not fit the task", where=layout.family, expected="a cabinet")
    kind = str(random.choice(["none", "short", "beside", "above"], p=[0.5, 0.27, 0.13, 0.10]))
    x, y = layout.cabinet
    y += random.normal(0, 0.012 * scale)
    if kind == "beside":
        # Towards the arm's own side, so that the other arm is not in the way.
        y += side(robot, layout.arm) * random.uniform(0.085, 0.11) * scale
    z = random.uniform(0.028, 0.040) * scale if kind != "above" else random.uniform(0.085, 0.11) * scale
    front = x - 0.028 * scale
    travel = DRAWER_TRAVEL * scale
    end = front + 0.004 if kind != "short" else front - random.uniform(0.25, 0.85) * travel
    pace = random.uniform(0.9, 1.08)
    times = np.array([0.0, 1.0, 1.4, 2.7, 3.0, 3.8]) * pace
    start, yaw = layout.start[layout.arm], random.normal(0, 0.1)
    before = front - travel - random.uniform(0.025, 0.04) * scale
    lane = np.array([before, y])
    opening = random.uniform(0.0, 0.15)
    return [
        _point(0.0, start[:2], start[2], start[3], start[4]),
        _point(times[1], lane, z + 0.06 * scale, yaw, opening),
        _point(times[2], lane, z, yaw, opening),
        _point(times[3], np.array([end, y]), z, yaw, opening),
        _point(times[4], np.array([end - 0.05 * scale, y]), z + 0.01 * scale, yaw, opening),
        _point(times[5], np.array([end - 0.08 * scale, y]), z + random.uniform(0.08, 0.14) * scale, yaw, opening),
    ]


def _wander(
    robot: Robot, arm: int, start: np.ndarray, random: np.random.Generator, slow: bool, duration: float
) -> list[Waypoint]:
    """Free smooth motion above the table; with ``slow`` shorter ways and fewer changes of the gripper."""
    opening = float(start[4])
    points = [_point(0.0, start[:2], start[2], start[3], opening)]
    time = 0.0
    while time < duration:
        time += float(random.uniform(1.3, 2.2) if slow else random.uniform(0.65, 1.2))
        goal = sample_tool(robot, arm, random)
        if slow:
            goal = start[:4] + 0.55 * (goal - start[:4])
        elif random.uniform() < 0.3:
            goal[2] = random.uniform(0.05, 0.12) * robot.scale
        if random.uniform() < (0.3 if slow else 0.6):
            opening = float(random.uniform(0.7, 1.0) if opening < 0.5 else random.uniform(0.0, 0.3))
        points.append(_point(time, goal[:2], goal[2], goal[3], opening, 0.0 if slow else random.uniform(-0.1, 0.25)))
    return points


def plan_waypoints(robot: Robot, layout: Layout, random: np.random.Generator, duration: float) -> list[list[Waypoint]]:
    """Waypoints per arm for ``duration`` seconds."""
    plans: list[list[Waypoint]] = []
    for arm in range(len(robot.arms)):
        if layout.family == "play":
            plans.append(_wander(robot, arm, layout.start[arm], random, False, duration))
        elif arm == layout.arm:
            plans.append((_push if layout.family == "state_change" else _pick)(layout, robot, random))
        elif random.uniform() < 0.65:
            plans.append(_wander(robot, arm, layout.start[arm], random, True, duration))
        else:
            x, y, z, yaw, opening = layout.start[arm]
            plans.append([_point(0.0, np.array([x, y]), z, yaw, opening)])
    return plans


def sample_waypoints(points: list[Waypoint], times: np.ndarray) -> tuple[np.ndarray, ...]:
    """Minimum-jerk interpolation at ``times`` (N,): positions (N, 3), yaw (N,), pitch (N,), opening (N,)."""
    values = np.array([[*p.position, p.yaw, p.pitch, p.opening] for p in points])
    knots = np.array([p.time for p in points])
    last = len(points) - 1
    left = np.clip(np.searchsorted(knots, times, side="right") - 1, 0, max(last - 1, 0))
    right = np.minimum(left + 1, last)
    span = np.maximum(knots[right] - knots[left], 1e-6)
    phase = np.clip((times - knots[left]) / span, 0.0, 1.0)
    blend = phase**3 * (10 - 15 * phase + 6 * phase**2)
    out = values[left] + blend[:, None] * (values[right] - values[left])
    return out[:, :3], out[:, 3], out[:, 4], out[:, 5]


def tool_rotation(yaw: float, pitch: float = 0.0) -> np.ndarray:
    """Rotation (3, 3) of a tool pointing down, turned by ``yaw`` about z; ``pitch`` > 0 tilts it forward."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    about_z = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    cos, sin = np.cos(-pitch), np.sin(-pitch)
    about_y = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    return about_z @ about_y @ DOWN


class InverseKinematics:
    """Damped least squares on MuJoCo's site Jacobians, in simulation data of its own."""

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

        Returns the joints and the remaining position error [m]. Orientation errors weigh 0.3 m/rad (0.005 for the small
        arm of five joints, which cannot reach every orientation); the null space of redundant arms draws them towards
        their resting pose.
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
            weight = 0.005 if robot.jaw else 0.3
            jacobian = np.concatenate([self._jac_pos[:, dofs], weight * self._jac_rot[:, dofs]])
            target = np.concatenate([np.clip(delta, -0.1, 0.1), weight * np.clip(turn, -0.5, 0.5)])
            gram = jacobian @ jacobian.T + 2e-4 * np.eye(6)
            step = jacobian.T @ np.linalg.solve(gram, target)
            if len(dofs) > 6:
                pull = 0.05 * (home - joints)
                step += pull - jacobian.T @ np.linalg.solve(gram, jacobian @ pull)
            joints = np.clip(joints + step, low, high)
        return joints, error_pos


def plan_actions(
    scene: SceneModel, solver: InverseKinematics, plans: list[list[Waypoint]], num_frames: int
) -> tuple[np.ndarray, float]:
    """Joint targets and gripper openings (N, J) of all arms, and the solver's largest position error [m]."""
    times = np.arange(num_frames) / FRAME_RATE
    columns, worst = [], 0.0
    for arm, points in enumerate(plans):
        positions, yaws, pitches, openings = sample_waypoints(points, times)
        joints = np.asarray(scene.robot.arms[arm].home, dtype=np.float64)
        targets = []
        for frame in range(num_frames):
            rotation = tool_rotation(yaws[frame], pitches[frame])
            joints, error = solver.solve(arm, joints, positions[frame], rotation, 300 if frame == 0 else 80)
            worst = max(worst, error)
            targets.append(joints)
        columns += [np.array(targets), openings[:, None]]
    return np.concatenate(columns, axis=1).astype(np.float32), worst
