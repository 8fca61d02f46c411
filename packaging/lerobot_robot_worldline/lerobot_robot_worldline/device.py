"""Common parts of the robot and the teleoperator: the recordings, LeRobot's names and units, and its announcements of episodes."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from worldline_core.errors import DataError
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.model.checkpoint import CheckpointInfo
from worldline_core.model.world_model_config import match_views
from worldline_core.rollout.recorded_starts import RecordedStarts
from worldline_core.shipped import shipped_folder


@dataclass(kw_only=True)
class Recordings:
    """Options that the robot and the teleoperator share, so that both mean the same recordings.

    Attributes:
        model: a Stage II or causal checkpoint; by default the shipped causal one.
        recordings: an EpisodeSet, whose first frames are the starts; by default the shipped one.
        embodiment, splits: of the recordings that are used.
        views: that are simulated, a set that the model was trained on; by default the largest.
        seed: of the first episode.
        use_degrees: joints in degrees and grippers from 0 (closed) to 100 (open), as LeRobot's leader arms send them; by default
            radians and the embodiment's gripper (0 closed, 1 open).
    """

    model: str | None = None
    recordings: str | None = None
    embodiment: str = "ur5e_silver"
    splits: list[str] = field(default_factory=lambda: ["test"])
    views: list[str] | None = None
    seed: int = 0
    use_degrees: bool = False

    @property
    def checkpoint(self) -> Path:
        """Folder of the model."""
        return Path(self.model or shipped_folder() / "models" / "causal")

    def shown_views(self, info: CheckpointInfo) -> tuple[str, ...]:
        """Views that are simulated. Raises: DataError: the model was not trained on these together."""
        return match_views(info.view_sets, self.views or info.views, "views")

    def starts(self, info: CheckpointInfo) -> RecordedStarts:
        """First frames of the recordings that the model can go on from."""
        return RecordedStarts(
            Path(self.recordings or shipped_folder() / "recordings"),
            embodiment=self.embodiment, splits=self.splits, view_sets=[self.shown_views(info)], fps=info.contract.fps,
            needs_cameras=info.vectors is None,
        )  # fmt: skip


class Columns:
    """Commands and states of a robot, between LeRobot's names and units and the embodiment's.

    Names are those of the state's columns as LeRobot writes joints: ``left_shoulder_pan_joint.pos``; of a robot with a single arm
    without the arm's name: ``shoulder_pan.pos``.
    """

    def __init__(self, kinematics: ArmKinematics, *, use_degrees: bool) -> None:
        robot = kinematics.embodiment
        single = f"{robot.arms[0].name}/" if len(robot.arms) == 1 else ""
        self.names = [f"{name.removeprefix(single).replace('/', '_')}.pos" for name in robot.state_names]
        self._scale, self._zero = np.ones(robot.state_size), np.zeros(robot.state_size)
        if use_degrees:
            turning = [name in kinematics.revolute for name in robot.state_names]
            self._scale[turning] = np.degrees(1.0)
            for arm in robot.arms:
                column, gripper = robot.gripper_column(arm), arm.gripper
                self._scale[column], self._zero[column] = 100 / (gripper.open - gripper.closed), gripper.closed

    @property
    def features(self) -> dict[str, type]:
        """As LeRobot's devices describe them."""
        return dict.fromkeys(self.names, float)

    def named(self, values: np.ndarray) -> dict[str, float]:
        """LeRobot's values by name for one row ``(state size)`` in the embodiment's units."""
        return dict(zip(self.names, ((values - self._zero) * self._scale).tolist(), strict=True))

    def values(self, action: Mapping[str, Any]) -> np.ndarray:
        """``(state size)`` in the embodiment's units.

        Raises:
            DataError: a name is missing or unknown, or a number is not finite.
        """
        missing, unknown = [name for name in self.names if name not in action], sorted(set(action) - set(self.names))
        if missing or unknown:
            raise DataError(
                "An action has other names than the robot's",
                expected=", ".join(self.names),
                got=f"missing: {', '.join(missing) or 'none'}; unknown: {', '.join(unknown) or 'none'}",
                next_step="use a teleoperator or a policy of this robot, and the same use_degrees for both",
            )
        row = np.array([float(action[name]) for name in self.names])
        if not np.isfinite(row).all():
            wrong = {
                name: value for name, value in zip(self.names, row.tolist(), strict=True) if not np.isfinite(value)
            }
            raise DataError("A command is not finite", expected="finite numbers", got=wrong)
        return row / self._scale + self._zero


class Announcements(logging.Handler):
    """Hears which episode LeRobot begins, and that one ended, from the root logger, between ``listen`` and ``leave``.

    Attributes:
        ended: no episode is recorded now.
    """

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self._episode: int | None = None
        self.ended = True

    def listen(self) -> None:
        logging.getLogger().addHandler(self)

    def leave(self) -> None:
        logging.getLogger().removeHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        found = re.fullmatch(r"Recording episode (\d+)|Reset the environment|Stop recording", record.getMessage())
        if found:
            self.ended = found[1] is None
            self._episode = self._episode if self.ended else int(found[1])

    def take(self) -> int | None:
        """Number of the episode that was announced since the last call."""
        episode, self._episode = self._episode, None
        return episode
