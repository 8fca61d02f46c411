"""Which columns of a LeRobot dataset are an arm's joints and gripper.

LeRobot fixes neither: RoboCOIN has one vector with a name per column, Galaxea one feature per arm and gripper. What is
picked here becomes the state of the contract: for each arm in order joints [rad], then gripper opening. The configuration
also declares whatever else a LeRobot dataset does not say about itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode import TRAINING_SPLITS
from worldline_core.data.episodes.source import ForeignSourceConfig, GripperRange
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.errors import ConfigError

ReadColumn = Callable[[str], np.ndarray]


class ColumnChoice(StrictModel):
    """Columns of one feature: all of them, those of some names, or those at some places."""

    feature: str
    columns: tuple[str, ...] | None = Field(
        default=None, description="names or shell patterns, in this order; a pattern keeps the feature's order"
    )
    indices: tuple[int, ...] | None = Field(default=None, description="places of the columns, where they have no names")

    @model_validator(mode="after")
    def _one_way(self) -> ColumnChoice:
        if self.columns is not None and self.indices is not None:
            raise ValueError("give columns or indices, not both")
        return self


class GripperColumn(ColumnChoice):
    """The one column of a gripper, and its readings when it is closed and open."""

    closed: float
    open: float

    @property
    def range(self) -> GripperRange:
        return GripperRange(closed=self.closed, open=self.open)


class ArmTrack(StrictModel):
    """Joints and gripper of one arm in one track."""

    joints: ColumnChoice
    gripper: GripperColumn | None = None


class ArmColumns(StrictModel):
    """One arm; without `action` the action repeats the state."""

    name: Literal["left", "right"]
    state: ArmTrack
    action: ArmTrack | None = None


def flat_names(feature: Mapping[str, Any]) -> list[str]:
    """Column names of a feature: LeRobot writes them as a list, a list of one list, or a dict of a list; or not at all."""
    names = feature.get("names") or []
    if isinstance(names, dict):
        names = next(iter(names.values()), [])
    if names and isinstance(names, list) and isinstance(names[0], list):
        names = names[0]
    return [str(name) for name in names] if isinstance(names, list) else []


def places(choice: ColumnChoice, features: Mapping[str, Mapping[str, Any]], where: str) -> list[int]:
    """Indices of the chosen columns in their feature.

    Raises: ConfigError for a feature, name, pattern or place that the dataset does not have, or a column chosen twice.
    """
    if choice.feature not in features:
        known = ", ".join(name for name in features if not name.startswith("observation.images"))
        raise ConfigError("The dataset has no such feature", where=where, expected=known, got=choice.feature)
    feature = features[choice.feature]
    names, shape = flat_names(feature), feature.get("shape") or [1]
    width = int(shape[0]) if len(shape) == 1 else 0
    if choice.columns is not None:
        found = []
        for pattern in choice.columns:
            matching = [i for i, name in enumerate(names) if fnmatchcase(name, pattern)]
            if not matching:
                raise ConfigError(
                    "The feature has no such column",
                    where=f"{where}, {choice.feature}",
                    expected=", ".join(names) or "a feature whose columns have names (else use indices)",
                    got=pattern,
                )
            found += matching
    else:
        found = list(range(width)) if choice.indices is None else list(choice.indices)
    if not found or len(set(found)) != len(found) or not all(0 <= i < width for i in found):
        raise ConfigError(
            "Columns cannot be chosen like this",
            where=f"{where}, {choice.feature}",
            expected=f"different columns of a vector, 0..{width - 1}",
            got=found,
        )
    return found


@dataclass(frozen=True)
class Picked:
    """One chosen column set: its feature, its places, and how it becomes the contract's numbers."""

    feature: str
    indices: tuple[int, ...]
    gripper: GripperRange | None


class ArmVectors:
    """Picks state and action of the arms of one dataset.

    Raises: ConfigError on creation for columns that the dataset does not have, an arm that is declared twice, or a
        gripper of more than one column.
    """

    def __init__(self, arms: tuple[ArmColumns, ...], features: Mapping[str, Mapping[str, Any]], where: str) -> None:
        order = [arm.name for arm in arms]
        if order != sorted(set(order)):
            raise ConfigError("Arms are declared in another order", where=where, expected="left, right", got=order)
        self.names: tuple[str, ...] = ()
        self._state: list[Picked] = []
        self._action: list[Picked] = []
        for arm in arms:
            picked = _pick(arm.state, features, f"{where}, {arm.name} arm, state")
            self._state += picked
            width = [len(part.indices) for part in picked]
            self.names += tuple(f"{arm.name}/joint_{i + 1}" for i in range(width[0]))
            self.names += (f"{arm.name}/gripper",) * (len(picked) - 1)
            if arm.action is not None:
                action = _pick(arm.action, features, f"{where}, {arm.name} arm, action")
                if [len(part.indices) for part in action] != width:
                    raise ConfigError(
                        "State and action of an arm differ in size",
                        where=f"{where}, {arm.name} arm",
                        expected=f"{width} columns (joints, gripper)",
                        got=[len(part.indices) for part in action],
                    )
                self._action += action
        if self._action and len(self._action) != len(self._state):
            raise ConfigError("Either all arms have actions or none has", where=where)

    @property
    def repeats_state(self) -> bool:
        return not self._action

    def read(self, read: ReadColumn, *, degrees: bool) -> tuple[np.ndarray, np.ndarray, int]:
        """State and action (N, J) float32, and how many gripper readings were clipped.

        Raises: RejectedInputError (length_mismatch) where a feature has another width than the dataset says.
        """
        column = cache(lambda feature: _matrix(read(feature)))
        state, overshoot = _vector(self._state, column, degrees)
        if self.repeats_state:
            return state, state.copy(), overshoot
        action, more = _vector(self._action, column, degrees)
        return state, action, overshoot + more


class WholeVectors:
    """Takes state and action whole, with the named columns as grippers."""

    repeats_state = False

    def __init__(self, names: list[str], grippers: Mapping[str, GripperRange]) -> None:
        self.names = tuple(names) or None
        self._grippers = {names.index(name): span for name, span in grippers.items()}

    def read(self, read: ReadColumn, *, degrees: bool) -> tuple[np.ndarray, np.ndarray, int]:
        """As `ArmVectors.read`."""
        state, overshoot = self._track(_matrix(read("observation.state")), degrees)
        action, more = self._track(_matrix(read("action")), degrees)
        return state, action, overshoot + more

    def _track(self, values: np.ndarray, degrees: bool) -> tuple[np.ndarray, int]:
        parts = [Picked("", (column,), self._grippers.get(column)) for column in range(values.shape[1])]
        return _vector(parts, lambda _: values, degrees)


def _matrix(values: np.ndarray) -> np.ndarray:
    """(N,) or (N, D) as (N, D) float64."""
    values = values.astype(np.float64)
    return values[:, None] if values.ndim == 1 else values


def _pick(track: ArmTrack, features: Mapping[str, Mapping[str, Any]], where: str) -> list[Picked]:
    parts = [Picked(track.joints.feature, tuple(places(track.joints, features, where)), None)]
    if track.gripper is not None:
        found = places(track.gripper, features, f"{where}, gripper")
        if len(found) != 1:
            raise ConfigError("A gripper is one column", where=f"{where}, gripper", expected=1, got=len(found))
        parts.append(Picked(track.gripper.feature, tuple(found), track.gripper.range))
    return parts


def _vector(parts: list[Picked], column: ReadColumn, degrees: bool) -> tuple[np.ndarray, int]:
    blocks, overshoot = [], 0
    for part in parts:
        values = column(part.feature)
        if values.shape[1] <= max(part.indices):
            raise RejectedInputError(
                "length_mismatch",
                "Feature has fewer columns than the dataset says",
                where=part.feature,
                expected=f"more than {max(part.indices)}",
                got=values.shape[1],
                evidence={"feature": part.feature, "columns": int(values.shape[1])},
            )
        chosen = values[:, list(part.indices)]
        if part.gripper is not None:
            chosen, outside = part.gripper.opening(chosen)
            overshoot += outside
        elif degrees:
            chosen = np.deg2rad(chosen)
        blocks.append(chosen)
    with np.errstate(over="ignore"):  # what is no float32 becomes infinite, and is refused as such
        return np.concatenate(blocks, axis=1).astype(np.float32), overshoot


class LeRobotSourceConfig(ForeignSourceConfig):
    """A LeRobotDataset, or with `collection` every one below a folder.

    Either `arms` says which columns are whose joints and gripper, or the whole of `observation.state` and `action` is
    taken, with `grippers` naming the columns that are no joints. An episode of a dataset has the dataset's scene: where a
    dataset has several, give each its own source and `include`.
    """

    kind: Literal["lerobot_v21", "lerobot_v3"]
    embodiment: str
    angle_unit: Literal["rad", "deg"] = Field(description="unit of the joint columns")
    views: dict[str, str] = Field(description="video key of the dataset -> view, for example {...cam_high: head}")
    grippers: dict[str, GripperRange] = Field(
        default={}, description="state column -> its readings when closed and open; without `arms`"
    )
    arms: tuple[ArmColumns, ...] | None = Field(
        default=None, min_length=1, description="left, right: columns of joints and grippers; null: the whole state"
    )
    collection: bool = Field(default=False, description="read every dataset below the folder")
    calibration: str | None = Field(
        default=None,
        description="file in the dataset's folder with K and poses of the views (docs/sources.md); a name with "
        "{episode_index:06d} is one file per episode",
    )
    task_column: str = Field(default="task_index", description="column of indices into the dataset's tasks")
    task_separator: str | None = Field(
        default=None, min_length=1, description="of texts in several languages the part after the last one is taken"
    )
    success_column: str | None = Field(default=None, description="column of truth values: the episode's outcome")
    evaluation_only: bool = Field(
        default=False, description="refuse the splits train and validation; DROID is always refused them"
    )

    @model_validator(mode="after")
    def _consistent(self) -> LeRobotSourceConfig:
        if self.evaluation_only and self.split in TRAINING_SPLITS:
            raise ValueError(
                f"these recordings are for evaluation only: split {self.split} is refused, use test or ood_test"
            )
        if self.arms is not None and self.grippers:
            raise ValueError("give arms (which name their grippers) or grippers, not both")
        if len(set(self.views.values())) != len(self.views):
            raise ValueError("two video keys are given the same view")
        return self
