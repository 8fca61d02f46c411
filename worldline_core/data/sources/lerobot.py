"""Foreign LeRobot datasets, v2.1 and v3.0 (Galaxea, RoboCOIN, DROID's port and many more), without our camera sidecar.

LeRobot states neither the unit of joint angles, nor what a gripper reading means, nor where cameras are, so all three are
declared in the configuration. Without calibration such episodes serve action-free training. RoboCOIN and Galaxea publish
one dataset per task, hundreds of them: a collection reads every dataset below a folder.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache, lru_cache, partial
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from worldline_core.config import StrictModel
from worldline_core.data.episodes.conventions import is_gripper
from worldline_core.data.episodes.episode import NO_EMBODIMENT, REPEATS_STATE, TRAINING_SPLITS, Episode
from worldline_core.data.episodes.source import (
    EVALUATION_ONLY,
    EmbodimentName,
    EpisodeSource,
    ForeignSourceConfig,
    GripperRange,
    LoadedEpisode,
    joint_names,
    says_droid,
    sorted_views,
)
from worldline_core.data.guards.rejection import RejectedInputError, all_of, check_rate, collect_faults, depth_picture
from worldline_core.data.guards.source_paths import AnyPath, fill_template, find_files, relative_name
from worldline_core.data.lerobot.dataset import DatasetInfo, LeRobotV3Dataset, LeRobotV21Dataset, check_files, is_depth
from worldline_core.data.sources.calibration_file import calibrated, read_calibration
from worldline_core.data.video.clip import VideoClip, video_size
from worldline_core.errors import ConfigError, DataError
from worldline_core.geometry.embodiment import load_embodiment

ReadFeature = Callable[[str], np.ndarray]
Features = Mapping[str, Mapping[str, Any]]


AngleUnit = Literal["rad", "deg", "range_m100_100"]


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


Bounds = tuple[float, float]


class JointColumns(ColumnChoice):
    """The joint columns of an arm in the robot's order, and how their readings become its angles [rad]:
    ``sign * (reading - zero)`` in the source's ``angle_unit``; ``range_m100_100`` goes from the lower to the upper bound.
    """

    signs: tuple[Literal[-1, 1], ...] | None = Field(
        default=None, description="of each joint; -1 for one that counts the other way, as on a mirrored arm"
    )
    zeros: tuple[float, ...] | None = Field(
        default=None, description="reading of each joint where the description has zero; for angles"
    )
    ranges: tuple[Bounds, ...] | None = Field(
        default=None,
        description="angles [rad] of each joint at -100 and 100, for range_m100_100; null: the limits of the description",
    )

    @model_validator(mode="after")
    def _two_ends(self) -> JointColumns:
        if any(low == high for low, high in self.ranges or ()):
            raise ValueError("ranges: the angles at -100 and at 100 must differ")
        return self


class GripperColumn(GripperRange, ColumnChoice):
    """The one column of a gripper, and its readings when it is closed and open."""


class ArmTrack(StrictModel):
    """Joints and gripper of one arm in one track."""

    joints: JointColumns
    gripper: GripperColumn | None = None


class ArmTracks(StrictModel):
    """One arm; without `action` the action repeats the state."""

    name: Literal["left", "right"]
    state: ArmTrack
    action: ArmTrack | None = None


class LeRobotSourceConfig(ForeignSourceConfig):
    """A LeRobotDataset, or with `collection` every one below a folder.

    Either `arms` says which columns are whose joints and gripper, or the whole of `observation.state` and `action` is
    taken, with `grippers` naming the columns that are no joints. An episode of a dataset has the dataset's scene: where a
    dataset has several, give each its own source and `include`.
    """

    kind: Literal["lerobot_v21", "lerobot_v3"]
    embodiment: EmbodimentName = Field(description="a robot of `worldline embodiment list`, or none: Stage I")
    angle_unit: AngleUnit = Field(
        description="unit of the joint columns; range_m100_100: LeRobot's -100..100 of a calibrated range, with `arms`;"
        " without them, and with embodiment none, the pictures alone are read"
    )
    views: dict[str, str] = Field(description="camera of the dataset -> view, for example {...cam_high: head}")
    grippers: dict[str, GripperRange] = Field(
        default={}, description="state column -> its readings when closed and open; without `arms`"
    )
    arms: tuple[ArmTracks, ...] | None = Field(
        default=None, min_length=1, description="left, right: columns of joints and grippers; null: the whole state"
    )
    collection: bool = Field(default=False, description="read every dataset below the folder")
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
        if self.arms is not None and self.grippers:
            raise ValueError("give arms (which name their grippers) or grippers, not both")
        tracks = [track for arm in self.arms or () for track in (arm.state, arm.action) if track is not None]
        if self.angle_unit == "range_m100_100":
            if self.arms is None and self.embodiment != NO_EMBODIMENT:
                raise ValueError(
                    "range_m100_100 says where in its range a joint is: declare arms, or embodiment: none for the pictures alone"
                )
            if self.embodiment == NO_EMBODIMENT and any(track.joints.ranges is None for track in tracks):
                raise ValueError("range_m100_100 of a robot without a description: declare ranges of the joints")
            if any(track.joints.zeros is not None for track in tracks):
                raise ValueError("zeros are of angles: range_m100_100 takes ranges")
        elif any(track.joints.ranges is not None for track in tracks):
            raise ValueError(f"ranges are those of range_m100_100, and angle_unit is {self.angle_unit}")
        if len(set(self.views.values())) != len(self.views):
            raise ValueError("two video keys are given the same view")
        return self


def flat_names(feature: Mapping[str, Any]) -> list[str]:
    """Column names of a feature, as far as it has some: a list, groups of them one after the other, or name -> place.

    Names that several groups have begin with their group's.
    """
    named = _grouped(feature.get("names"))
    plain = [name for _, name in named]
    return plain if len(set(plain)) == len(plain) else [f"{group}/{name}" if group else name for group, name in named]


def _grouped(names: Any, group: str = "") -> list[tuple[str, str]]:
    if isinstance(names, dict):
        if names and all(isinstance(place, int) for place in names.values()):
            return [(group, str(name)) for name in sorted(names, key=names.__getitem__)]
        return [each for key, value in names.items() for each in _grouped(value, str(key))]
    if isinstance(names, list):
        parts = [_grouped(name, group) if isinstance(name, list | dict) else [(group, str(name))] for name in names]
        return [each for part in parts for each in part]
    return []


def places(choice: ColumnChoice, features: Features, where: str) -> list[int]:
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
class _Block:
    """Columns of one feature, in the order of the state; all of them where `indices` is None. Joints are
    ``scale * reading + offset`` [rad].
    """

    feature: str
    indices: Sequence[int] | None = None
    gripper: GripperRange | None = None
    scale: np.ndarray | float = 1.0
    offset: np.ndarray | float = 0.0


@dataclass(frozen=True)
class StateColumns:
    """Columns that hold state and action as the contract has them; without `action` the action repeats the state."""

    names: tuple[str, ...] | None
    state: Sequence[_Block]
    action: Sequence[_Block]

    def read(self, read_feature: ReadFeature) -> tuple[np.ndarray, np.ndarray, int]:
        """State and action (N, J) float32, and how many gripper readings were clipped.

        Raises: RejectedInputError (length_mismatch) where a feature has fewer columns than the dataset says.
        """
        read_feature = cache(read_feature)
        overshoot = 0
        tracks: list[np.ndarray] = []
        for blocks in (self.state, self.action):
            parts: list[np.ndarray] = []
            for block in blocks:
                values = read_feature(block.feature).astype(np.float64)
                values = values[:, None] if values.ndim == 1 else values
                if block.indices is not None:
                    if values.shape[1] <= max(block.indices, default=-1):
                        raise RejectedInputError(
                            "length_mismatch",
                            "Feature has fewer columns than the dataset says",
                            where=block.feature,
                            expected=f"more than {max(block.indices)}",
                            got=values.shape[1],
                        )
                    values = values[:, list(block.indices)]
                if block.gripper is not None:
                    values, outside = block.gripper.opening(values)
                    overshoot += outside
                else:
                    values = values * block.scale + block.offset
                parts.append(values)
            if parts:
                with np.errstate(over="ignore"):  # what is no float32 becomes infinite, and is refused as such
                    tracks.append(np.concatenate(parts, axis=1).astype(np.float32))
        return tracks[0], tracks[-1].copy(), overshoot


_SCALES = {"rad": 1.0, "deg": np.pi / 180, "range_m100_100": 1 / 200}
"""Radians, or the share of the joint's range, for each unit of a reading."""


def _linear(
    config: LeRobotSourceConfig, arm: str, joints: JointColumns, count: int, where: str
) -> tuple[np.ndarray, np.ndarray]:
    """Scale and offset of the joints of one arm: ``angle = scale * reading + offset``.

    Raises: ConfigError for signs, zeros or ranges of another number of joints, or a joint without limits.
    """
    ranges = joints.ranges
    if config.angle_unit == "range_m100_100" and ranges is None:
        described = {each.name: each.limits for each in load_embodiment(config.embodiment).arms}
        ranges = described.get(arm, ())
    for name, given in (("signs", joints.signs), ("zeros", joints.zeros), ("ranges", ranges)):
        if given is not None and len(given) != count:
            raise ConfigError(
                f"One of `{name}` belongs to each joint", where=where, expected=f"{count} numbers", got=len(given)
            )
    scale = np.array(joints.signs or [1] * count) * _SCALES[config.angle_unit]
    if ranges is None:
        return scale, -scale * np.array(joints.zeros or [0.0] * count)
    low, high = np.array(ranges, dtype=np.float64).T
    if not np.isfinite([low, high]).all():
        raise ConfigError(
            "A joint without limits has no range that -100..100 could be of", where=where, got=ranges,
            next_step="declare `ranges`: its angles [rad] at -100 and at 100",
        )  # fmt: skip
    return scale * (high - low), (low + high) / 2


def state_columns(config: LeRobotSourceConfig, features: Features, where: str) -> StateColumns:
    """The columns that the configuration names, in a dataset with these features.

    Raises: ConfigError for columns that the dataset does not have, an arm that is declared twice, or a gripper of more
        than one column.
    """
    if config.arms is None and config.angle_unit == "range_m100_100":  # of no known robot: pictures alone
        return StateColumns((), [_Block("timestamp", [])], [])
    if config.arms is None:
        names = flat_names(features.get("observation.state", {}))
        if config.angle_unit == "deg" and (
            undeclared := [n for n in names if is_gripper(n) and n not in config.grippers]
        ):
            raise ConfigError(
                "Columns of grippers are no angles in degrees",
                where=where,
                got=", ".join(undeclared),
                next_step="declare their readings: grippers: {" + undeclared[0] + ": {closed: ..., open: ...}}",
            )
        scale = _SCALES[config.angle_unit]
        state, action = (
            [_Block(feature, [i], config.grippers.get(name), scale) for i, name in enumerate(names)]
            if config.grippers
            else [_Block(feature, scale=scale)]
            for feature in ("observation.state", "action")
        )
        return StateColumns(tuple(names) or None, state, action)
    order = [arm.name for arm in config.arms]
    if order != sorted(set(order)):
        raise ConfigError("Arms are declared in another order", where=where, expected="left, right", got=order)
    if len({arm.action is None for arm in config.arms}) > 1:
        raise ConfigError("Either all arms have actions or none has", where=where)
    names: list[str] = []
    blocks: dict[str, list[_Block]] = {"state": [], "action": []}
    for arm in config.arms:
        widths: dict[str, list[int]] = {}
        for name, track in (("state", arm.state), ("action", arm.action)):
            if track is None:
                continue
            at = f"{where}, {arm.name} arm, {name}"
            joints = places(track.joints, features, at)
            scale, offset = _linear(config, arm.name, track.joints, len(joints), at)
            blocks[name].append(_Block(track.joints.feature, joints, scale=scale, offset=offset))
            widths[name] = [len(joints)]
            if track.gripper is not None:
                gripper = places(track.gripper, features, f"{at}, gripper")
                if len(gripper) != 1:
                    raise ConfigError("A gripper is one column", where=at, expected=1, got=len(gripper))
                blocks[name].append(_Block(track.gripper.feature, gripper, track.gripper))
                widths[name].append(1)
        if len(set(map(tuple, widths.values()))) > 1:
            raise ConfigError("State and action of an arm differ in size", where=where, got=widths)
        names += joint_names({arm.name: widths["state"][0]}, gripper=arm.state.gripper is not None)
    return StateColumns(tuple(names), blocks["state"], blocks["action"])


_DROID_VIDEOS = {"observation.images.exterior_1_left", "observation.images.exterior_2_left"}


class LeRobotSource:
    """Reads a LeRobotDataset.

    Raises: DataError when the folder is no such dataset; ConfigError when a declared column or view is unknown, or when
        the dataset is DROID and its split would train or select a model.
    """

    looked_for = "episodes that meta/ lists"

    def __init__(self, config: LeRobotSourceConfig, root: AnyPath, label: str | None = None) -> None:
        self._config = config
        self._root = root
        self._label = label or config.label
        if config.kind == "lerobot_v3":
            check_files(root, list(config.views))
        self._dataset = LeRobotV21Dataset(root) if config.kind == "lerobot_v21" else LeRobotV3Dataset(root)
        features = self._dataset.features
        names = config.label, config.embodiment, root.name
        self._evaluation_only = config.evaluation_only or is_droid(self._dataset.info, *names)
        if self._evaluation_only and config.split in TRAINING_SPLITS:
            raise ConfigError(
                "DROID is for evaluation only",
                where=str(root),
                expected="split test or ood_test",
                got=config.split,
                next_step="set the source's split, or name datasets that are not DROID otherwise",
            )
        columns = [name for name in (config.task_column, config.success_column) if name is not None]
        cameras = self._dataset.camera_keys
        # A dataset may lack some views (`views: available`); one that has none is of another configuration.
        views = {} if set(config.views) & set(cameras) else config.views
        names = flat_names(features.get("observation.state", {}))
        missing: dict[str, tuple[str, str]] = {}
        for what, wanted, known in (
            ("camera", views, cameras),
            ("state column", config.grippers, names),
            ("feature", columns, list(features)),
        ):
            unknown = sorted(set(wanted) - set(known) - {"task_index"})
            if unknown:
                missing[what] = ", ".join(known) or f"a dataset with a {what}", ", ".join(unknown)
        if missing:
            raise ConfigError(
                f"The dataset has no {' and no '.join(missing)} of this name",
                where=root,
                expected="; ".join(expected for expected, _ in missing.values()),
                got="; ".join(got for _, got in missing.values()),
            )
        if depth := [key for key in config.views if is_depth(features.get(key, {}))]:
            raise depth_picture(root, f"is_depth_map of {', '.join(depth)} in meta/info.json")
        self._columns = state_columns(config, features, str(root))
        self._calibration = lru_cache(maxsize=1)(partial(read_calibration, root))

    def episode_ids(self) -> list[str]:
        return [f"{self._label}-{int(index):06d}" for index in self._dataset.episodes.indices]

    def load(self, episode_id: str) -> LoadedEpisode:
        config, dataset = self._config, self._dataset
        index = int(episode_id.rsplit("-", 1)[1])
        key_of = {view: key for key, view in config.views.items()}

        def read_view(view: str) -> VideoClip | None:
            key = key_of[view]
            if key not in dataset.features:
                known = ", ".join(dataset.camera_keys)
                raise RejectedInputError(
                    "missing_view",
                    "Dataset has no such camera",
                    where=self._root,
                    expected=key,
                    got=known,
                    next_step="correct the source's views, or keep what is there: curate.views: available",
                )
            if not dataset.has_video(key):
                dataset.image_size(index, key)
                return None
            clip = dataset.clip(index, key)
            check_rate(video_size(clip.path)[2], dataset.fps, f"{episode_id}, view {view}")
            return clip

        faults: list[RejectedInputError] = []
        views, absent = sorted_views(key_of, read_view, faults)
        with collect_faults(faults):
            times = dataset.column(index, "timestamp").reshape(-1).astype(np.float64)
            loaded = LoadedEpisode(
                self._episode(episode_id, index, times),
                tuple(views),
                images=lambda view: dataset.images(index, key_of[view]),
                clips={view: clip for view, clip in views.items() if clip is not None},
                absent=absent,
            )
            if config.calibration is not None:
                name = fill_template(config.calibration, episode_index=index)
                read_feature = partial(dataset.column, index)
                entries, where = self._calibration(name), f"{self._root}, {name}"
                loaded = calibrated(loaded, entries, where, config.views.values(), read_feature)
            if not faults:
                return loaded
        raise all_of([*faults, *absent.values()], f"episode {episode_id}")

    def _episode(self, episode_id: str, index: int, times: np.ndarray) -> Episode:
        config, dataset = self._config, self._dataset
        state, action, overshoot = self._columns.read(partial(dataset.column, index))
        instruction, tasks = self._instruction(index)
        return Episode(
            **config.declared(self._label),
            episode_id=episode_id,
            embodiment=config.embodiment,
            instruction=instruction,
            outcome=self._outcome(index),
            fps=dataset.fps,
            state=state,
            action=action,
            timestamps=times - times[0],
            primary_view=config.primary_view or "head",
            state_names=self._columns.names,
            state_kind="none" if self._columns.names == () else "joints",
            conventions={
                "layout": f"lerobot {dataset.info.codebase_version}",
                "declared_angle_unit": config.angle_unit,
                "gripper_overshoot": overshoot,
                **({EVALUATION_ONLY: "true"} if self._evaluation_only else {}),
                **({"action": REPEATS_STATE} if not self._columns.action else {}),
                **({"tasks": tasks} if tasks > 1 else {}),
            },
        )

    def _instruction(self, index: int) -> tuple[str, int]:
        """The first frame's task, and how many different ones the episode has."""
        values = self._dataset.column(index, self._config.task_column).reshape(-1)
        listed = self._dataset.tasks
        unknown = [value for value in dict.fromkeys(values.tolist()) if value not in listed]
        if unknown:
            raise RejectedInputError(
                "missing_column",
                "Task is not in the list of tasks",
                where=f"{self._root}, episode {index}, {self._config.task_column}",
                expected=f"one of the {len(listed)} indices in meta/tasks",
                got=", ".join(map(str, unknown[:5])),
                next_step="add the task to meta/tasks, or drop the episode",
            )
        text = listed[values[0]]
        separator = self._config.task_separator
        return (text if separator is None else text.rsplit(separator, 1)[-1]).strip(), len(set(values.tolist()))

    def _outcome(self, index: int) -> str:
        if self._config.success_column is None:
            return self._config.outcome
        succeeded = self._dataset.column(index, self._config.success_column).reshape(-1)
        return "success" if bool(succeeded[-1]) else "failure"


def is_droid(info: DatasetInfo, *names: str) -> bool:
    """True if a dataset is DROID by its names, its robot's name or its cameras' names (its port calls the robot Franka)."""
    return says_droid(*names, str(info.robot_type), str(info.repo_id)) or set(info.features) >= _DROID_VIDEOS


class LeRobotCollection:
    """Datasets of one layout; each has its own scene unless the configuration names one.

    A dataset that cannot be opened, or that the configuration does not fit, is listed as one input, and is quarantined.

    Raises: ConfigError as `LeRobotSource` where the configuration fits none of them.
    """

    looked_for = (
        "folders with meta/info.json (archives must be unpacked; without `collection` the folder is the dataset)"
    )

    def __init__(self, config: LeRobotSourceConfig, root: AnyPath) -> None:
        self._roots: dict[str, AnyPath] = {}
        for info in find_files(root, "info.json"):
            place = relative_name(info, root)
            if place.parent.name == "meta":
                self._roots["-".join([config.label, *place.parts[:-2]])] = info.parent.parent
        self._open = lru_cache(maxsize=8)(lambda label: LeRobotSource(config, self._roots[label], label))

    def episode_ids(self) -> list[str]:
        listed: list[str] = []
        misfits: list[ConfigError] = []
        for label in sorted(self._roots):
            try:
                listed += self._open(label).episode_ids()
            except (DataError, ConfigError) as error:
                listed.append(label)
                misfits += [error] if isinstance(error, ConfigError) else []
        if misfits and set(listed) <= set(self._roots):
            raise misfits[0]  # and none could be opened
        return listed

    def load(self, episode_id: str) -> LoadedEpisode:
        if episode_id in self._roots:
            try:
                self._open(episode_id).episode_ids()  # raises what the listing met
            except ConfigError as error:
                raise RejectedInputError(
                    "missing_column",
                    error.what,
                    where=error.where,
                    expected=error.expected,
                    got=error.got,
                    next_step=error.next_step or "give this dataset its own source",
                ) from error
        return self._open(episode_id.rsplit("-", 1)[0]).load(episode_id)


def open_lerobot(config: LeRobotSourceConfig, root: AnyPath) -> EpisodeSource:
    """The dataset, or the collection of datasets, that the configuration names."""
    return LeRobotCollection(config, root) if config.collection else LeRobotSource(config, root)
