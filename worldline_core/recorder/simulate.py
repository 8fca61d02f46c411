"""Run one episode: waypoints to joint targets at the frame rate, physics in between, state at every frame.

The commanded targets of frame t are executed at t and interpolated linearly up to those of frame t+1, so that the
recorded actions alone reproduce the motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from worldline_core.recorder.controllers import Waypoint, sample_waypoints
from worldline_core.recorder.inverse_kinematics import InverseKinematics, tool_rotation
from worldline_core.recorder.robots import Robot
from worldline_core.recorder.scene_model import FRAME_RATE, SUBSTEPS, SceneModel
from worldline_core.recorder.task_layout import Layout, apply_layout, outcome


@dataclass(frozen=True)
class Motion:
    """What happened: ``state`` and ``action`` (N, J), full positions ``qpos`` (N, nq), and the measured outcome."""

    state: np.ndarray
    action: np.ndarray
    qpos: np.ndarray
    outcome: str


def opening_to_fingers(robot: Robot, opening: np.ndarray) -> np.ndarray:
    """Finger joint positions for an opening 0 (closed) .. 1 (open)."""
    closed, opened = robot.finger_travel
    return closed + np.asarray(opening) * (opened - closed)


def fingers_to_opening(robot: Robot, fingers: np.ndarray) -> np.ndarray:
    """Opening 0..1 (clipped) from finger joints (..., F)."""
    closed, opened = robot.finger_travel
    return np.clip((np.mean(fingers, axis=-1) - closed) / (opened - closed), 0.0, 1.0)


def plan_actions(
    scene: SceneModel, solver: InverseKinematics, plans: list[list[Waypoint]], num_frames: int
) -> tuple[np.ndarray, float]:
    """Joint targets and openings (N, J) of all arms, and the largest position error of the solver [m]."""
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


def execute(scene: SceneModel, data: Any, layout: Layout, action: np.ndarray) -> Motion:
    """Drive the simulator with the recorded actions (N, J) from the layout's initial state."""
    import mujoco

    model, robot = scene.model, scene.robot
    apply_layout(scene, data, layout)
    # Actions are stored as float32; the simulator is driven by exactly what is stored.
    control = np.zeros((len(action), model.nu))
    column = 0
    for arm in range(len(robot.arms)):
        count = len(scene.joint_qpos[arm])
        joints = action[:, column : column + count].astype(np.float64)
        fingers = opening_to_fingers(robot, action[:, column + count].astype(np.float64))
        control[:, scene.arm_actuators[arm]] = joints
        control[:, scene.finger_actuators[arm]] = fingers[:, None]
        data.qpos[scene.joint_qpos[arm]] = joints[0]
        data.qpos[scene.finger_qpos[arm]] = fingers[0]
        column += count + 1
    mujoco.mj_forward(model, data)
    states, snapshots = [], []
    for frame in range(len(action)):
        states.append(read_state(scene, data))
        snapshots.append(data.qpos.copy())
        if frame + 1 == len(action):
            break
        for substep in range(SUBSTEPS):
            blend = (substep + 1) / SUBSTEPS
            data.ctrl[:] = (1 - blend) * control[frame] + blend * control[frame + 1]
            mujoco.mj_step(model, data)
    return Motion(np.array(states, dtype=np.float32), action, np.array(snapshots), outcome(scene, data, layout))


def read_state(scene: SceneModel, data: Any) -> np.ndarray:
    """(J,) joint positions then opening, arm after arm."""
    parts: list[np.ndarray] = []
    for arm in range(len(scene.robot.arms)):
        parts.append(data.qpos[scene.joint_qpos[arm]])
        parts.append(np.atleast_1d(fingers_to_opening(scene.robot, data.qpos[scene.finger_qpos[arm]])))
    return np.concatenate(parts)
