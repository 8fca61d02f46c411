"""The robot beside the pictures: where a robot that follows commands is, by its limits and, where fitted, its response.

A policy reads the robot's state, which no picture shows. It follows from the commands:

1. Limits. A joint's command is clipped to its position limits and to what its top speed reaches in a frame from the command
   before; a gripper's to its range. These are the *executed* commands. Top speeds are those of the embodiment's file
   (``max_speeds``), else pi rad/s and 1 m/s, which arms of this size reach. A limit never moves a robot that began beyond it.
2. Response. Without a fitted one the joints are at every frame where that frame's command wants them, and a gripper follows
   at its speed (``travel_s`` of the embodiment's file, 0.4 s by default). A fitted :class:`Response` says for each column after
   which delay and with which lag the state follows; it replaces the gripper's speed too.

Axis legend: b clips, n frames, j columns of the state.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from copy import copy
from pathlib import Path

import numpy as np
from pydantic import Field, ValidationError

from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode import Episode
from worldline_core.errors import ArtifactError, DataError
from worldline_core.geometry.embodiment import Embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.store.atomic import write_bytes_atomic

DEFAULT_SPEED_RAD_S, DEFAULT_SPEED_M_S = math.pi, 1.0
MAX_DELAY_FRAMES = 4


class ColumnResponse(StrictModel):
    """Response of one column of the state to its command: ``s' = s + (1 - exp(-dt / lag)) (command(t - delay) - s)``.

    ``rmse``: of the states that the commands alone lead to, over the recordings it was fitted on, in the column's unit.
    """

    name: str
    delay_s: float = Field(ge=0, le=10)
    lag_s: float = Field(ge=0, le=1000)
    rmse: float = Field(ge=0)


class Response(StrictModel):
    """Response of a robot to its commands, column by column of its state (:func:`fit_response`)."""

    embodiment: str
    columns: tuple[ColumnResponse, ...]

    @classmethod
    def load(cls, path: Path | str) -> Response:
        """Read a file that :meth:`save` wrote.

        Raises: ArtifactError when it cannot be read, or is no such file.
        """
        try:
            return cls.model_validate_json(Path(path).read_bytes())
        except (OSError, ValidationError) as error:
            raise ArtifactError("Not a robot's response", where=path, got=str(error)) from error

    def save(self, path: Path | str) -> None:
        """Write it as JSON."""
        write_bytes_atomic(Path(path), (self.model_dump_json(indent=1) + "\n").encode())

    def at(self, fps: float) -> tuple[np.ndarray, np.ndarray]:
        """Delays [whole frames] and gains (0..1, of the remaining way a frame) of all columns."""
        delays = np.array([round(column.delay_s * fps) for column in self.columns], dtype=np.int64)
        gains = [1.0 if column.lag_s == 0 else 1.0 - math.exp(-1.0 / (fps * column.lag_s)) for column in self.columns]
        return delays, np.array(gains)


class CommandedRobot:
    """Robots of one embodiment that follow commands, one for each clip.

    Args:
        start: (b, j) where they are and what was commanded last, in the embodiment's layout and units.
        limits: whether commands are held within the embodiment's limits; without, they are executed as they are.
        response: fitted; by default joints follow at once and grippers at their speed.

    Attributes:
        command, state: (b, j) of the last frame.

    Raises:
        DataError: the response is of another robot.
    """

    def __init__(
        self, kinematics: ArmKinematics, fps: float, start: np.ndarray, *, limits: bool, response: Response | None
    ) -> None:
        embodiment = kinematics.embodiment
        self.command = self.state = start
        self._fastest = np.inf * np.ones(start.shape[1])
        self._low, self._high = -self._fastest, self._fastest.copy()
        self._grippers = [embodiment.gripper_column(arm) for arm in embodiment.arms]
        travels = [abs(arm.gripper.open - arm.gripper.closed) / (arm.gripper.travel_s * fps) for arm in embodiment.arms]
        self._gripper_steps = np.array(travels)
        if limits:
            self._low, self._high, self._fastest = _limits(kinematics, fps)
        # Where a robot begins is no fault of a command.
        self._low, self._high = np.minimum(self._low, start), np.maximum(self._high, start)
        self._response = None if response is None else response.at(fps)
        if response is not None and [column.name for column in response.columns] != list(embodiment.state_names):
            raise DataError(
                "The fitted response is of another robot",
                where=f"embodiment {embodiment.name}",
                expected=", ".join(embodiment.state_names),
                got=f"{response.embodiment}: {', '.join(column.name for column in response.columns)}",
            )
        depth = 0 if self._response is None else int(self._response[0].max())
        self._earlier = np.repeat(start[:, None], depth, axis=1)

    def follow(self, commands: np.ndarray) -> tuple[CommandedRobot, np.ndarray, np.ndarray]:
        """The robots after these commands (this one stays as it is).

        Args:
            commands: (b, n, j), finite.

        Returns:
            The robots, executed commands (b, n, j), and states (b, n, j).
        """
        executed, before = np.empty_like(commands), self.command
        for frame in range(commands.shape[1]):
            reachable = np.clip(commands[:, frame], before - self._fastest, before + self._fastest)
            executed[:, frame] = before = np.clip(reachable, self._low, self._high)
        states = executed.copy() if self._response is None else self._respond(executed, *self._response)
        if self._response is None:
            opening = self.state[:, self._grippers]
            for frame in range(commands.shape[1]):
                wanted = executed[:, frame, self._grippers]
                opening = np.clip(wanted, opening - self._gripper_steps, opening + self._gripper_steps)
                states[:, frame, self._grippers] = opening
        other = copy(self)
        other.command, other.state = executed[:, -1], states[:, -1]
        depth = self._earlier.shape[1]
        other._earlier = np.concatenate((self._earlier, executed), axis=1)[:, executed.shape[1] :][:, :depth]
        return other, executed, states

    def select(self, clips: Sequence[int]) -> CommandedRobot:
        """The robots of these clips, in the state that they are in."""
        other, index = copy(self), list(clips)
        for name in ("command", "state", "_low", "_high", "_earlier"):
            setattr(other, name, getattr(self, name)[index])
        return other

    def _respond(self, executed: np.ndarray, delays: np.ndarray, gains: np.ndarray) -> np.ndarray:
        depth, columns = self._earlier.shape[1], np.arange(executed.shape[2])
        known, states, state = np.concatenate((self._earlier, executed), axis=1), np.empty_like(executed), self.state
        for frame in range(executed.shape[1]):
            state = state + gains * (known[:, depth + frame - delays, columns] - state)
            states[:, frame] = state
        return states


def _limits(kinematics: ArmKinematics, fps: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lowest and highest command of every column, and the largest step of a frame, in the embodiment's units."""
    embodiment = kinematics.embodiment
    low, high, fastest = (np.empty(embodiment.state_size) for _ in range(3))
    for arm in embodiment.arms:
        columns, gripper = embodiment.joint_columns(arm), embodiment.gripper_column(arm)
        low[columns], high[columns] = np.array(arm.limits).T
        usual = [DEFAULT_SPEED_RAD_S if name in kinematics.revolute else DEFAULT_SPEED_M_S for name in arm.joints]
        fastest[columns] = np.array(arm.max_speeds or usual) / fps
        if embodiment.joint_units == "deg":  # no slides then
            fastest[columns] = np.degrees(fastest[columns])
        low[gripper], high[gripper] = sorted((arm.gripper.closed, arm.gripper.open))
        fastest[gripper] = np.inf
    return low, high, fastest


def fit_response(episodes: Iterable[Episode], embodiment: Embodiment) -> Response:
    """Delay and first-order lag of every column of the state, from recorded states and commands.

    For every delay of whole frames the gain is that of least squares of the state's steps on the remaining way, or 1 (no lag);
    kept is what, run from the first state on the commands alone, comes closest to the recorded states.

    Args:
        episodes: of this embodiment and one rate, with commands.

    Raises:
        DataError: there is no episode; one is of another robot or rate, or has no commands.
    """
    recorded = list(episodes)
    rates = {episode.fps for episode in recorded}
    if len(rates) != 1:
        raise DataError("A response is fitted on recordings of one rate", got=sorted(rates) or "no recording")
    pairs: list[tuple[np.ndarray, np.ndarray]] = []
    for episode in recorded:
        where = f"episode {episode.episode_id}"
        if episode.embodiment != embodiment.name or not episode.commanded or episode.state_kind != "joints":
            raise DataError(
                "Not a recording that a response can be fitted on",
                where=where,
                expected=f"states and commands of {embodiment.name}",
                got=f"{episode.embodiment}, states of {episode.state_kind}, commanded: {episode.commanded}",
            )
        state, command = (np.asarray(values, np.float64) for values in (episode.state, episode.action))
        embodiment.check_state(state, where)
        embodiment.check_state(command, where)
        pairs.append((state, command))
    fps, columns = rates.pop(), []
    for column, name in enumerate(embodiment.state_names):
        tracks = [(state[:, column], command[:, column]) for state, command in pairs]
        fits = [_fit(tracks, delay) for delay in range(MAX_DELAY_FRAMES + 1)]
        rmse, gain, delay = min((rmse, gain, delay) for delay, (rmse, gain) in enumerate(fits))
        lag_s = 0.0 if gain >= 1.0 else -1.0 / (fps * math.log1p(-gain))
        columns.append(ColumnResponse(name=name, delay_s=delay / fps, lag_s=lag_s, rmse=rmse))
    return Response(embodiment=embodiment.name, columns=tuple(columns))


def _fit(tracks: Sequence[tuple[np.ndarray, np.ndarray]], delay: int) -> tuple[float, float]:
    """Error of the better response at a delay of whole frames, and its gain."""
    # The state of frame t follows the command of t - delay; before the first command stands the first one.
    delayed = [(state, command[np.maximum(np.arange(len(command)) - delay, 0)]) for state, command in tracks]
    ways = np.concatenate([late[1:] - state[:-1] for state, late in delayed])
    moved = float(ways @ ways)
    steps = np.concatenate([np.diff(state) for state, _ in delayed])
    least = 1.0 if moved == 0.0 else float(np.clip(ways @ steps / moved, 1e-3, 1.0))
    return min((_error(delayed, gain), gain) for gain in (least, 1.0))


def _error(delayed: Sequence[tuple[np.ndarray, np.ndarray]], gain: float) -> float:
    """Root mean square between recorded states and those that the commands alone lead to."""
    errors: list[float] = []
    for state, late in delayed:
        followed = float(state[0])
        for measured, wanted in zip(state[1:], late[1:], strict=True):
            followed += gain * (wanted - followed)
            errors.append(followed - measured)
    return float(np.sqrt(np.mean(np.square(errors))))
