"""The robot beside the pictures: where a robot that follows commands is, within its limits.

A joint's command is clipped to its position limits and to what pi rad/s or 1 m/s reaches in a frame from the command before; a
gripper's to its range. These are the *executed* commands. Joints are at every frame where that frame's command wants them, a
gripper follows within 0.4 s from open to closed.

Axis legend: b clips, n frames, j columns of the state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy

import numpy as np

from worldline_core.geometry.kinematics import ArmKinematics

SPEED_RAD_S, SPEED_M_S, GRIPPER_TRAVEL_S = math.pi, 1.0, 0.4


class CommandedRobot:
    """Robots of one embodiment that follow commands, one for each clip.

    Args:
        start: (b, j) where they are and what was commanded last, in the embodiment's layout. A limit never moves a robot that
            began beyond it.
        limits: hold commands within the embodiment's limits.
        earlier: commands (n, j) of each clip that were executed since then as they are, whatever the limits.

    Attributes:
        command, state: (b, j) of the last frame.
    """

    def __init__(
        self,
        kinematics: ArmKinematics,
        fps: float,
        start: np.ndarray,
        *,
        limits: bool,
        earlier: Sequence[np.ndarray] = (),
    ) -> None:
        embodiment = kinematics.embodiment
        self.command = self.state = start
        self._fastest = np.full(start.shape[1], np.inf)
        self._low, self._high = np.full_like(start, -np.inf), np.full_like(start, np.inf)
        self._grippers = [embodiment.gripper_column(arm) for arm in embodiment.arms]
        ranges = np.array([sorted((arm.gripper.closed, arm.gripper.open)) for arm in embodiment.arms])
        self._gripper_steps = (ranges[:, 1] - ranges[:, 0]) / (GRIPPER_TRAVEL_S * fps)
        for clip, commands in enumerate(earlier):
            if len(commands):
                moved = self.select([clip]).follow(commands[None])[0]
                self.command, self.state = self.command.copy(), self.state.copy()
                self.command[clip], self.state[clip] = moved.command[0], moved.state[0]
        if not limits:
            return
        for arm, gripper_range in zip(embodiment.arms, ranges, strict=True):
            columns, gripper = embodiment.joint_columns(arm), embodiment.gripper_column(arm)
            self._low[:, columns], self._high[:, columns] = np.array(arm.limits).T
            self._low[:, gripper], self._high[:, gripper] = gripper_range
            speeds = [SPEED_RAD_S if name in kinematics.revolute else SPEED_M_S for name in arm.joints]
            self._fastest[columns] = np.array(speeds) / fps
        self._low, self._high = np.minimum(self._low, self.command), np.maximum(self._high, self.command)

    def follow(self, commands: np.ndarray) -> tuple[CommandedRobot, np.ndarray, np.ndarray]:
        """The robots after finite commands (b, n, j), executed commands (b, n, j) and states (b, n, j); this one stays."""
        executed, before = np.empty_like(commands), self.command
        for frame in range(commands.shape[1]):
            reachable = np.clip(commands[:, frame], before - self._fastest, before + self._fastest)
            executed[:, frame] = before = np.clip(reachable, self._low, self._high)
        states, opening = executed.copy(), self.state[:, self._grippers]
        for frame in range(commands.shape[1]):
            wanted = executed[:, frame, self._grippers]
            opening = np.clip(wanted, opening - self._gripper_steps, opening + self._gripper_steps)
            states[:, frame, self._grippers] = opening
        other = copy(self)
        other.command, other.state = executed[:, -1], states[:, -1]
        return other, executed, states

    def select(self, clips: Sequence[int]) -> CommandedRobot:
        """The robots of these clips, in their present state."""
        other, index = copy(self), list(clips)
        for name in ("command", "state", "_low", "_high"):
            setattr(other, name, getattr(self, name)[index])
        return other
