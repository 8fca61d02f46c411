"""Recorded commands as a teleoperator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from lerobot.utils.errors import DeviceNotConnectedError

from lerobot_robot_worldline.device import Announcements, Columns, Recordings
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.model.checkpoint import read_checkpoint_info


@TeleoperatorConfig.register_subclass("worldline_replay")
@dataclass(kw_only=True)
class WorldLineReplayConfig(TeleoperatorConfig, Recordings):
    """Options of ``--teleop.type=worldline_replay``."""


class WorldLineReplay(Teleoperator):
    """Commands of a recorded episode, one a call; after its last one it stays there.

    The episode is that of the start that the robot begins at where both have the same options.
    """

    config_class = WorldLineReplayConfig
    name = "worldline_replay"

    def __init__(self, config: WorldLineReplayConfig) -> None:
        super().__init__(config)
        self.config = config
        self._columns = Columns(ArmKinematics(load_embodiment(config.embodiment)), use_degrees=config.use_degrees)
        self._announced = Announcements()
        self._commands: np.ndarray | None = None

    @property
    def action_features(self) -> dict[str, Any]:
        return self._columns.features

    @property
    def feedback_features(self) -> dict[str, Any]:
        return {}

    @property
    def is_connected(self) -> bool:
        return self._commands is not None

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Nothing to do: a recording feels nothing."""

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Open the recordings."""
        del calibrate
        self._starts = self.config.starts(read_checkpoint_info(self.config.checkpoint))
        self._commands, self._next = self._recorded(0), 0
        self._announced.listen()

    @check_if_not_connected
    def disconnect(self) -> None:
        """Let go of the recordings."""
        self._announced.leave()
        self._commands = None

    def get_action(self) -> dict[str, Any]:
        """The next command."""
        if self._commands is None:
            raise DeviceNotConnectedError
        announced = self._announced.take()
        if announced is not None:
            self._commands, self._next = self._recorded(announced), 0
        row, self._next = self._commands[self._next], min(self._next + 1, len(self._commands) - 1)
        return self._columns.named(row)

    def _recorded(self, episode: int) -> np.ndarray:
        return self._starts.commands((self.config.seed + episode) % len(self._starts))
