"""Damped least squares on MuJoCo site Jacobians: tool poses to joint targets."""

from __future__ import annotations

from typing import Any

import numpy as np

from worldline_core.recorder.scene_model import SceneModel

# Fingers straight down: tool x back to the robot, y to the left, z down (columns are the tool axes in the base).
DOWN = np.diag([-1.0, 1.0, -1.0])


def tool_rotation(yaw: float, pitch: float = 0.0) -> np.ndarray:
    """Rotation (3, 3) of a tool pointing down, turned by ``yaw`` about z; ``pitch`` > 0 tilts it forward."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    about_z = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    cos, sin = np.cos(-pitch), np.sin(-pitch)
    about_y = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    return about_z @ about_y @ DOWN


class InverseKinematics:
    """Solver with its own scratch data; one per process."""

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

        Returns the joints and the remaining position error [m]. Orientation errors weigh 0.3 m/rad (0.005 for a small arm of five joints, which
        cannot reach every orientation); redundant arms
        are drawn to their resting pose in the null space.
        """
        import mujoco

        scene, data = self.scene, self._data
        model = scene.model
        address, dofs = scene.joint_qpos[arm], scene.joint_dofs[arm]
        low, high = scene.limits[arm].T
        home = np.asarray(scene.robot.arms[arm].home)
        joints = np.clip(np.asarray(start, dtype=np.float64), low, high)
        error_pos = np.inf
        for _ in range(iterations):
            data.qpos[address] = joints
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            site = scene.tool_sites[arm]
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
            weight = 0.005 if scene.robot.jaw else 0.3
            jacobian = np.concatenate([self._jac_pos[:, dofs], weight * self._jac_rot[:, dofs]])
            target = np.concatenate([np.clip(delta, -0.1, 0.1), weight * np.clip(turn, -0.5, 0.5)])
            gram = jacobian @ jacobian.T + 2e-4 * np.eye(6)
            step = jacobian.T @ np.linalg.solve(gram, target)
            if len(dofs) > 6:
                pull = 0.05 * (home - joints)
                step += pull - jacobian.T @ np.linalg.solve(gram, jacobian @ pull)
            joints = np.clip(joints + step, low, high)
        return joints, error_pos
