"""Inverse kinematics: joint positions that bring the tools of all arms to given poses, within the joint limits.

Damped least squares with a damping that falls with the error (Sugihara, "Solvability-unconcerned inverse kinematics by the
Levenberg-Marquardt method", 2011): quadratic convergence near a reachable pose, and a steady nearest pose where it is out
of reach. A joint that stands at its limit and would pass it takes no part in a step, so that the others do its work.

Axis legend: a arms, j state columns, d joints of an arm. Poses in the base frame [m].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from worldline_core.errors import DataError
from worldline_core.geometry.kinematics import ArmKinematics

ROTATION_WEIGHT_M = 0.3
"""A rotation error of 1 rad counts as much as a position error of this many metres."""
LARGEST_STEP_M, LARGEST_TURN_RAD = 0.1, 0.5
"""Largest correction of one step: beyond it the linear model of the arm says little."""
POSITION_TOLERANCE_M, ROTATION_TOLERANCE_RAD = 1e-4, 1e-3
_DAMPING = 1e-5


@dataclass(frozen=True)
class Reached:
    """Result of the solver.

    Attributes:
        state: (j,) within the limits; gripper columns as they were given.
        position_error_m, rotation_error_rad: (a,) between the wanted tool poses and those of ``state``.
    """

    state: np.ndarray
    position_error_m: np.ndarray
    rotation_error_rad: np.ndarray


class InverseKinematics:
    """Solver for all arms of an embodiment at once."""

    def __init__(self, kinematics: ArmKinematics) -> None:
        self.kinematics = kinematics
        embodiment = kinematics.embodiment
        self._columns = [
            np.arange(*embodiment.joint_columns(arm).indices(embodiment.state_size)) for arm in embodiment.arms
        ]
        self._limits = [np.asarray(arm.limits, np.float64) for arm in embodiment.arms]
        # Where each joint turns: the link that it moves, and its axis there.
        found = {
            joint.name: (f"{body.name}#{i}" if i < len(body.joints) - 1 or joint.position.any() else body.name, joint)
            for body in kinematics.tree.walk()
            for i, joint in enumerate(body.joints)
        }
        self._joints = [[found[name] for name in arm.joints] for arm in embodiment.arms]

    def jacobians(self, state: Float[np.ndarray, " j"]) -> tuple[np.ndarray, list[Float[np.ndarray, "6 d"]]]:
        """Tool poses (a, 4, 4) and the Jacobians of a state, by arm: metres (first three rows) and radians of its tool in the
        base frame per rad or m of each of its joints."""
        links = {name: pose[0].numpy() for name, pose in self.kinematics.link_poses(state[None]).items()}
        jacobians, tools = [], []
        for arm, joints in zip(self.kinematics.embodiment.arms, self._joints, strict=True):
            tool = links[arm.end_effector_link] @ arm.T_link_tool.matrix()
            axes = np.stack([links[link][:3, :3] @ joint.axis for link, joint in joints])
            levers = tool[:3, 3] - np.stack([links[link][:3, 3] for link, _ in joints])
            turns = np.array([joint.kind == "revolute" for _, joint in joints])[:, None]
            columns = np.where(turns, np.cross(axes, levers), axes), np.where(turns, axes, 0.0)
            jacobians.append(np.ascontiguousarray(np.concatenate(columns, axis=1).T))
            tools.append(tool)
        return np.stack(tools), jacobians

    def solve(
        self, start: Float[np.ndarray, " j"], T_base_tool: Float[np.ndarray, "a 4 4"], *, iterations: int = 30
    ) -> Reached:
        """The state nearest to the wanted tool poses that is found from ``start``.

        Args:
            start: where the arms are; joints beyond their limits are first brought back to them.
            T_base_tool: wanted poses of the tools, arms in the embodiment's order.

        Raises:
            DataError: a shape does not fit, or a number is not finite.
        """
        wanted = np.asarray(T_base_tool, np.float64)
        arms = len(self._columns)
        if wanted.shape != (arms, 4, 4) or not np.isfinite(wanted).all():
            raise DataError(
                "Wanted tool poses do not fit the robot", where=self.kinematics.embodiment.name,
                expected=f"finite ({arms}, 4, 4)", got=wanted.shape,
            )  # fmt: skip
        state = np.array(start, np.float64)
        self.kinematics.embodiment.check_state(state[None], "start of inverse kinematics")
        for columns, limits in zip(self._columns, self._limits, strict=True):
            state[columns] = np.clip(state[columns], *limits.T)
        best = state.copy()
        least, errors = np.full(arms, np.inf), np.zeros((arms, 2))
        for _ in range(iterations + 1):
            tools, jacobians = self.jacobians(state)
            shift = wanted[:, :3, 3] - tools[:, :3, 3]
            turn = Rotation.from_matrix(wanted[:, :3, :3] @ tools[:, :3, :3].swapaxes(1, 2)).as_rotvec()
            size = np.stack([np.linalg.norm(shift, axis=1), np.linalg.norm(turn, axis=1)], axis=1)
            total = size[:, 0] ** 2 + (ROTATION_WEIGHT_M * size[:, 1]) ** 2
            for arm in np.flatnonzero(total < least):
                best[self._columns[arm]], least[arm], errors[arm] = state[self._columns[arm]], total[arm], size[arm]
            far = (errors > (POSITION_TOLERANCE_M, ROTATION_TOLERANCE_RAD)).any(axis=1)
            if not far.any():
                break
            for arm in np.flatnonzero(far):
                columns = self._columns[arm]
                # Both by one factor, so that a step goes down the error that is compared.
                part = min(1.0, *((LARGEST_STEP_M, LARGEST_TURN_RAD) / np.maximum(size[arm], 1e-12)))
                error = part * np.concatenate([shift[arm], ROTATION_WEIGHT_M * turn[arm]])
                weighted = jacobians[arm] * np.array([1.0] * 3 + [ROTATION_WEIGHT_M] * 3)[:, None]
                state[columns] = _step(state[columns], self._limits[arm], weighted, error)
        return Reached(best, errors[:, 0], errors[:, 1])


def _step(joints: np.ndarray, limits: np.ndarray, jacobian: np.ndarray, error: np.ndarray) -> np.ndarray:
    """One damped step; joints that would pass a limit go to it, and the others make up for what is missing."""
    free = np.ones(len(joints), bool)
    target = joints.copy()
    left = error
    for _ in range(len(joints)):
        part = jacobian[:, free]
        damping = (_DAMPING + 0.1 * float(error @ error)) * np.eye(6)
        move = part.T @ np.linalg.solve(part @ part.T + damping, left)
        reached = joints[free] + move
        clipped = np.clip(reached, *limits[free].T)
        passed = clipped != reached
        if not passed.any():
            target[free] = reached
            return target
        held = np.flatnonzero(free)[passed]
        target[held] = clipped[passed]
        free[held] = False
        left = error - jacobian[:, ~free] @ (target - joints)[~free]
        if not free.any():
            break
    return target
