"""The simulator as a robot."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.robots import Robot, RobotConfig
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from lerobot.utils.errors import DeviceNotConnectedError

from lerobot_robot_worldline.curation import write_cameras, write_source
from lerobot_robot_worldline.device import Announcements, Columns, Recordings
from worldline_core.environment.environment import CommandedSimulation
from worldline_core.errors import ConfigError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.model.checkpoint import read_checkpoint_info
from worldline_core.rollout.recorded_starts import RecordedStart, RecordedStarts, read_start
from worldline_core.rollout.worldline import WorldLine

LOG = logging.getLogger(__name__)


@RobotConfig.register_subclass("worldline")
@dataclass(kw_only=True)
class WorldLineRobotConfig(RobotConfig, Recordings):
    """Options of ``--robot.type=worldline``.

    Attributes:
        observation: begin all episodes here instead of at recordings: a folder with ``<view>.png``, ``calibration.yaml`` and
            ``state.yaml`` (``worldline_core.rollout.recorded_starts.read_start``).
        observe_every: commands between two observations of new pictures, a divisor of the model's block; by default the block.
        limits: hold commands within the embodiment's limits.
        dataset_root: that of ``--dataset.root``: the cameras of each episode are written into the dataset, and ``curate.yaml``, by
            which ``worldline task curate --config`` reads it.
    """

    observation: str | None = None
    observe_every: int | None = None
    limits: bool = True
    dataset_root: str | None = None
    device: str = "cpu"


class WorldLineRobot(Robot):
    """A robot in the simulator.

    Raises:
        ConfigError: there is no such embodiment, or ``observe_every`` does not divide the block.
        DataError: no recording fits, or an action cannot be used.
    """

    config_class = WorldLineRobotConfig
    name = "worldline"

    def __init__(self, config: WorldLineRobotConfig) -> None:
        super().__init__(config)
        self.config = config
        self._info = read_checkpoint_info(config.checkpoint)
        self._kinematics = ArmKinematics(load_embodiment(config.embodiment))
        self._columns = Columns(self._kinematics, use_degrees=config.use_degrees)
        cells, compression = self._info.contract.grid_size, self._info.config.spatial_compression
        size = (cells[0] * compression, cells[1] * compression, 3)
        self.cameras = dict.fromkeys(config.shown_views(self._info), size)
        self._announced = Announcements()
        self._running: CommandedSimulation | None = None
        self._executed: list[np.ndarray] = []

    @property
    def observation_features(self) -> dict[str, Any]:
        return {**self._columns.features, **self.cameras}

    @property
    def action_features(self) -> dict[str, Any]:
        return self._columns.features

    @property
    def is_connected(self) -> bool:
        return self._running is not None

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None:
        """Nothing to do: joints are those of the embodiment."""

    def configure(self) -> None:
        """Nothing to do."""

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Load the model and begin at the first start."""
        del calibrate
        config = self.config
        self._world = WorldLine.from_pretrained(config.checkpoint, device=config.device)
        self._starts: Sequence[RecordedStart] | RecordedStarts = (
            config.starts(self._info)
            if config.observation is None
            else [
                read_start(
                    Path(config.observation),
                    self._kinematics.embodiment,
                    list(self.cameras),
                    needs_cameras=self._info.vectors is None,
                )
            ]
        )
        self._running = self._begun(0)
        self._sent: list[float] = []
        self._announced.listen()

    @check_if_not_connected
    def disconnect(self) -> None:
        """Let go of the simulation and of the model."""
        self._announced.leave()
        self._running = None
        del self._world, self._starts
        self._finish_episode()

    def get_observation(self) -> dict[str, Any]:
        """The robot's state after the last command, and the newest pictures, ``uint8 (H, W, 3)`` by view."""
        running = self._going_on()
        whole, rest = divmod(len(running.commands), running.simulation.frames_per_step)
        due = rest > 0 and rest % self._observe_every == 0 and self._unseen
        for _ in range(whole + due):
            _, clips = running.predict()
            self._pictures = {view: video[-1] for view, video in clips[0].items()}
        self._unseen = False
        return {**self._columns.named(self._state), **{view: self._pictures[view].copy() for view in self.cameras}}

    def send_action(self, action: Mapping[str, Any]) -> dict[str, Any]:
        """Advance by one frame under a command, and return what is executed of it.

        Raises:
            DataError: the action has other names than the robot's, or a number that is not finite.
        """
        running = self._going_on()
        command = self._columns.values(action)
        self._check_pace()
        executed, states = running.take(command[None])
        self._state, self._unseen = states[0], True
        if self._executed:
            self._executed.append(executed[0])
        return self._columns.named(executed[0])

    def _begun(self, episode: int) -> CommandedSimulation:
        config, seed = self.config, self.config.seed + episode
        self._start = start = self._starts[seed % len(self._starts)]
        simulation = self._world.start(
            start.images, start.cameras, embodiment=self._kinematics, state=start.state, seed=seed, limits=config.limits
        )
        self._observe_every = config.observe_every or simulation.frames_per_step
        if self._observe_every < 1 or simulation.frames_per_step % self._observe_every:
            raise ConfigError(
                "Pictures cannot be observed so often", where="observe_every",
                expected=f"a divisor of the model's {simulation.frames_per_step} frames", got=self._observe_every,
            )  # fmt: skip
        self._pictures, self._state, self._unseen = simulation.pictures[0], simulation.state[0], False
        self._episode = episode
        return CommandedSimulation(simulation)

    def _going_on(self) -> CommandedSimulation:
        """The running episode, begun anew where LeRobot has announced one."""
        if self._running is None:
            raise DeviceNotConnectedError
        announced = self._announced.take()
        if announced is not None or self._announced.ended:
            self._finish_episode()
        if announced is not None:
            if (announced, 0) != (self._episode, self._running.age):
                self._running = self._begun(announced)
            self._executed = [self._start.state]
        return self._running

    def _finish_episode(self) -> None:
        """Write the cameras of the episode that was recorded; of the last command no frame was."""
        config, rows, self._executed = self.config, self._executed[:-1], []
        if config.dataset_root is not None and rows:
            root, robot, fps = Path(config.dataset_root), self._kinematics.embodiment, self._info.contract.fps
            write_cameras(root, self._episode, self._start, self._kinematics, np.stack(rows), fps)
            names = [self._columns.names[robot.gripper_column(arm)] for arm in robot.arms]
            ends = [(0.0, 100.0) if config.use_degrees else (a.gripper.closed, a.gripper.open) for a in robot.arms]
            unit = "deg" if config.use_degrees else "rad"
            write_source(root, robot.name, unit, dict(zip(names, ends, strict=True)), list(self.cameras))

    def _check_pace(self) -> None:
        """Warn once where the first commands come clearly faster than frames: a recording would state a wrong rate."""
        if len(self._sent) > 16:
            return
        self._sent.append(time.perf_counter())
        fps = self._info.contract.fps
        if len(self._sent) > 16 and (interval := float(np.median(np.diff(self._sent)))) < 1 / (1.2 * fps):
            LOG.warning(
                "Commands come at %.0f Hz, and each one is a frame of 1/%g s. A recording must say so: --dataset.fps=%g "
                "(lerobot-record), --fps=%g --dataset.fps=%g (lerobot-rollout).", 1 / max(interval, 1e-3), fps, fps, fps, fps,
            )  # fmt: skip
