"""Actions and observations of a robot in the form that is asked for, the same in both worlds; where episodes begin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any

import gymnasium
import numpy as np

from worldline_core.errors import ConfigError, DataError
from worldline_core.geometry.embodiment import LIMIT_TOLERANCE_RAD, Embodiment


class RobotSpaces:
    """Commands of a robot as actions; pictures ``uint8 (H, W, 3)`` by view and its state as observations.

    Args:
        flat: observations have one level of keys, the views and ``agent_pos``, instead of ``pixels`` and ``agent_pos``.
        normalised: actions are -1 to 1: linear from a joint's lower to its upper limit, and over a gripper's range (of an
            embodiment whose grippers are 0 when closed: -1 closed, 1 open).

    Attributes:
        action, observation: spaces of one environment.

    Raises:
        ConfigError: actions shall be normalised, and a joint has no limits.
    """

    def __init__(
        self, robot: Embodiment, views: Sequence[str], image_size: tuple[int, int], *, flat: bool, normalised: bool
    ) -> None:
        self.robot, self.flat, self.normalised = robot, flat, normalised
        self._low, self._high = (np.full(robot.state_size, bound) for bound in (-np.inf, np.inf))
        for arm in robot.arms:
            self._low[robot.joint_columns(arm)], self._high[robot.joint_columns(arm)] = np.array(arm.limits).T
            column = robot.gripper_column(arm)
            self._low[column], self._high[column] = sorted((arm.gripper.closed, arm.gripper.open))
        if normalised and not np.isfinite(self._high - self._low).all():
            free = [robot.state_names[column] for column in np.flatnonzero(~np.isfinite(self._high - self._low))]
            raise ConfigError(
                "Commands of a joint without limits cannot be normalised", where=f"embodiment {robot.name}, {free[0]}",
                expected="limits of every joint", next_step="add them to the embodiment's file, or take commands in its units",
            )  # fmt: skip
        low, high = self._low.astype(np.float32), self._high.astype(np.float32)
        self.action = gymnasium.spaces.Box(low, high, dtype=np.float32)
        if normalised:
            self.action = gymnasium.spaces.Box(-1.0, 1.0, low.shape, np.float32)
        # A recording may begin a little beyond a limit, and stays where it is.
        state = gymnasium.spaces.Box(low - LIMIT_TOLERANCE_RAD, high + LIMIT_TOLERANCE_RAD, dtype=np.float32)
        picture = gymnasium.spaces.Box(0, 255, (*image_size, 3), np.uint8)
        pictures: dict[str, gymnasium.Space[Any]] = dict.fromkeys(views, picture)
        parts = pictures if flat else {"pixels": gymnasium.spaces.Dict(pictures)}
        self.observation = gymnasium.spaces.Dict({**parts, "agent_pos": state})

    def observed(self, pictures: Mapping[str, np.ndarray], state: np.ndarray) -> dict[str, Any]:
        """An observation, or a batch of them, from pictures by view and states in the embodiment's units."""
        parts = pictures if self.flat else {"pixels": dict(pictures)}
        return {**parts, "agent_pos": state.astype(np.float32)}

    def commands(self, actions: Any, count: int | None = None) -> np.ndarray:
        """Commands of one step in the embodiment's units, float64 ``(j)``, or ``(count, j)``.

        Raises: DataError: the actions have another shape, are not finite, or beyond -1 to 1 where they are normalised.
        """
        shape = (self.robot.state_size,) if count is None else (count, self.robot.state_size)
        try:
            given = np.asarray(actions)
        except ValueError:  # rows of different lengths
            given = np.empty(0)
        numbers = given.dtype.kind in "fiu" and given.shape == shape
        if not numbers or not np.isfinite(commands := given.astype(np.float64)).all():
            raise DataError(
                "Not the commands of one step", expected=f"finite {shape}: {', '.join(self.robot.state_names)}",
                got="numbers that are not finite" if numbers else f"{given.dtype} {given.shape}",
            )  # fmt: skip
        if not self.normalised:
            return commands
        if (beyond := np.abs(commands) > 1).any():
            column = int(np.argwhere(beyond)[0][-1])
            raise DataError(
                "A normalised action is out of range", where=self.robot.state_names[column], expected="-1 to 1",
                got=commands[beyond][0], next_step="clip the actions; commands in radians need normalised_actions=False",
            )  # fmt: skip
        return ((1 - commands) * self._low + (1 + commands) * self._high) / 2

    def actions(self, commands: np.ndarray) -> np.ndarray:
        """The actions, float32, that are these commands ``(..., j)`` in the embodiment's units: the inverse of `commands`."""
        given = np.asarray(commands, np.float64)
        if self.normalised:
            given = (2 * given - self._low - self._high) / (self._high - self._low)
        return given.astype(np.float32)


def each_seed(given: int | Sequence[int | None] | None, count: int) -> list[int | None]:
    """A seed for each of ``count`` episodes: those given, or counted up from the one given, or None for each.

    Raises: DataError when ``given`` has another number of seeds, or something that is no seed.
    """
    if isinstance(given, int | np.integer):
        given = [int(given) + number for number in range(count)]
    seeds: list[int | None] = [None] * count
    if given is not None:
        seeds = list(given) if isinstance(given, Sequence | np.ndarray) else []
    known = [seed for seed in seeds if seed is not None]
    if len(seeds) != count or not all(isinstance(seed, int | np.integer) and 0 <= seed < 2**63 for seed in known):
        raise DataError("Not the seeds of the episodes", expected=f"one, or {count}, from 0 to 2^63 - 1", got=given)
    return seeds


def each_start(
    options: dict[str, Any] | None, usual: tuple[str | None, int], count: int
) -> list[tuple[str | None, int]]:
    """Recording (None: that of the seed) and frame at which each of ``count`` episodes begins.

    Args:
        options: of a reset: ``start`` and ``frame``, one for all or a list for each; where there is none or None, the usual one.

    Raises: DataError for another number of them, or names that are nearly these.
    """
    given = dict(options or {})
    columns: list[list[Any]] = []
    for name, value in zip(("start", "frame"), usual, strict=True):
        asked = given.pop(name, None)
        each = list(asked) if isinstance(asked, list | tuple | np.ndarray) else [asked] * count
        if len(each) != count:
            raise DataError("Not the starts of the episodes", where=name, expected=f"one, or {count}", got=asked)
        columns.append([value if one is None else one for one in each])
    # Wrappers and LeRobot give options of their own, so that only what looks misspelt is refused.
    misspelt = [name for name in given if get_close_matches(str(name), ("start", "frame"), cutoff=0.75)]
    if misspelt:
        raise DataError("Unknown options of a reset", expected="start, frame", got=", ".join(misspelt))
    return list(zip(*columns, strict=True))
