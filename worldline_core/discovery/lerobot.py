"""A LeRobotDataset (versions 2.0, 2.1 and 3.0, with pictures in videos or in the data files): its arms, views and rates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from worldline_core.data.episodes.episode import NO_EMBODIMENT
from worldline_core.data.guards.rejection import MAX_COLUMNS, RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, find_files, relative_name
from worldline_core.data.lerobot.dataset import (
    LeRobotDataset,
    LeRobotV3Dataset,
    LeRobotV21Dataset,
    check_files,
    is_depth,
    read_info,
)
from worldline_core.data.sources.lerobot import AngleUnit, flat_names, is_droid
from worldline_core.data.video.clip import decode_frames
from worldline_core.discovery.arms import (
    STRANGERS,
    ArmColumns,
    Column,
    Match,
    Side,
    columns_of,
    find_arms,
    follow_robot,
    gripper_readings,
    is_lerobot_arm,
    joint_unit,
    match_robot,
    words_of,
)
from worldline_core.discovery.cameras import Seen, name_views, watch
from worldline_core.discovery.findings import Discovery, Question, name_calibration, named, stated_licence
from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import load_embodiment

EPISODES, _TRIED = 8, 400


@dataclass
class Sample:
    """Some episodes that can be read: their numbers, and their columns one after the other."""

    dataset: LeRobotDataset
    indices: list[int]
    listed: int

    def __post_init__(self) -> None:
        self._column = cache(self.dataset.column)  # read again and again: for units, limits, grippers and motion

    def values(self, columns: Sequence[Column]) -> np.ndarray:
        """(N, len(columns)) float64 of all sampled episodes; missing numbers are replaced by the median."""
        values = np.concatenate([self.episode(index, columns) for index in self.indices])
        usual = [np.median(column[np.isfinite(column)]) if np.isfinite(column).any() else 0.0 for column in values.T]
        return np.where(np.isfinite(values), values, usual)

    def episode(self, index: int, columns: Sequence[Column]) -> np.ndarray:
        features = {c.feature: self._column(index, c.feature) for c in columns}
        flat = {name: v[:, None] if v.ndim == 1 else v for name, v in features.items()}
        for column in columns:
            if column.index >= flat[column.feature].shape[1]:
                raise RejectedInputError(
                    "length_mismatch", "Feature has fewer columns than the dataset says",
                    where=f"{self.dataset.root}, episode {index}, {column.feature}",
                    expected=f"more than {column.index}", got=flat[column.feature].shape[1],
                    next_step="correct meta/info.json, or write the dataset again",
                )  # fmt: skip
        return np.stack([flat[c.feature][:, c.index].astype(np.float64) for c in columns], axis=1)


def sample_of(dataset: LeRobotDataset) -> Sample:
    """Episodes from all over the list; where their files are not there, others.

    Raises: DataError where none can be read.
    """
    listed = [int(index) for index in dataset.episodes.indices]
    spread = np.linspace(0, len(listed) - 1, min(len(listed), EPISODES)).round().astype(int).tolist()
    order = [listed[i] for i in dict.fromkeys([*spread, *range(len(listed))])][:_TRIED]
    readable: list[int] = []
    fault: DataError | None = None
    for index in order:
        try:
            dataset.column(index, "timestamp")
            readable.append(index)
        except RejectedInputError as error:
            fault = fault or error
        if len(readable) == EPISODES:
            break
    if not readable:
        raise DataError(
            "No episode of the dataset can be read" if listed else "The dataset lists no episodes",
            where=dataset.root, expected="data files of at least one of the listed episodes", got=fault and str(fault),
            next_step="copy or download the dataset again, as a whole",
        )  # fmt: skip
    return Sample(dataset, sorted(readable), len(listed))


_OLD_SIGNS, _OLD_ZEROS = (1, -1, 1, 1, 1), (0, 90, 90, 0, 0)
"""An SO-100 before LeRobot's change of calibration (PR 777): shoulder and elbow are 0 with the arm stretched out."""
_FULL_TURN, _RIGHT_ANGLE = "wrist_roll", 1.5708
_MOVES_RAD = 0.02
_ALIKE = 0.5
"""Least correlation of a command with the state that follows it."""


class ArmDescription:
    """Description of the arms of one dataset: `describe` fills the discovery's source and evidence."""

    def __init__(self, found: Discovery, sample: Sample, robot_type: str, arms: list[ArmColumns]) -> None:
        self._found = found
        self._sample = sample
        self._robot_type = robot_type
        self._arms = arms
        self._lerobot = is_lerobot_arm(robot_type, arms)
        self._joints = [sample.values(arm.joints) for arm in arms]
        words = [column.words for arm in arms for column in arm.joints]
        usual: AngleUnit = "range_m100_100" if any(name in robot_type.lower() for name in STRANGERS) else "deg"
        self._unit, self._unit_evidence, self._doubtful = joint_unit(
            np.concatenate(self._joints, axis=1), words, usual if self._lerobot else None
        )

    def describe(self, action: list[Column], why: str) -> None:
        """Robot, unit, and the columns of each arm.

        Args:
            action: columns of the commands.
            why: how the arms were found.
        """
        match, old = self._robot()
        self._motion()
        commands, unlike = _commands(self._sample, self._arms, action)
        entries: list[dict[str, Any]] = []
        for number, arm in enumerate(self._arms):
            options, said = self._options(arm, number, match, old=old)
            if said:
                self._found.evidence["arms", arm.side, "state", "joints"] = said
            command = commands[number] if commands else None
            entry: dict[str, Any] = {"name": arm.side, "state": self._track(arm, arm, options, "state", command)}
            if command is not None:
                entry["action"] = self._track(command, arm, options, "action", None, entry["state"])
            entries.append(entry)
        self._found.source["arms"] = entries
        self._found.evidence["arms",] = why + (f"; {unlike}" if unlike else "")
        self._found.state_size = sum(len(arm.joints) + (arm.gripper is not None) for arm in self._arms)

    def _angles(self, signs: Any, zeros: Any) -> list[np.ndarray]:
        """Joints of each arm in radians; a share of an unknown range is within all limits."""
        if self._unit == "range_m100_100":
            return [np.zeros_like(values) for values in self._joints]
        scale = np.pi / 180 if self._unit == "deg" else 1.0
        return [(values - np.array(zeros or 0)) * np.array(signs or 1) * scale for values in self._joints]

    def _robot(self) -> tuple[Match | None, bool]:
        """The described robot, whose joint order and sides the arms take, and whether joints are of LeRobot's old calibration."""
        names = [column.name for arm in self._arms for column in arm.joints]
        may_be_old = self._lerobot and self._unit == "deg" and not any(name.endswith(".pos") for name in names)
        may_be_old = may_be_old and all(len(arm.joints) == len(_OLD_SIGNS) for arm in self._arms)
        readings = [(_OLD_SIGNS, _OLD_ZEROS), (None, None)] if may_be_old else [(None, None)]
        matches = [(*match_robot(self._robot_type, self._arms, self._angles(*each)), each) for each in readings]
        # Sorting is stable: of two readings that fit as well, names without `.pos` decide.
        matches.sort(key=lambda each: each[0] is None or not each[0].fits)
        match, others, said, (_, zeros) = matches[0]
        if match is not None:
            for arm in self._arms:
                arm.gripper = arm.gripper or next(
                    (c for c in arm.fingers if "index" in c.words), next(iter(arm.fingers), None)
                )
            if any(arm.gripper is None for arm in self._arms):
                said = f"{match.name} fits ({match.evidence}), but no column is a gripper, which its state has"
                match, others = None, []
        old = zeros is not None
        hint = "; an older calibration of LeRobot: look at signs and zeros" if old else ""
        self._found.say(("angle_unit",), self._unit, self._unit_evidence + hint)
        if self._doubtful:
            self._found.notes.append("angle_unit: deg and range_m100_100 both fit: compare a few poses with pictures.")
        if match is not None:
            self._found.say(("embodiment",), match.name, match.evidence)
            follow_robot(self._arms, match.name)
        elif others:
            choices = f"{', '.join(others[:10])}; or none, or the path of a description (docs/embodiments.md)"
            self._found.say(
                ("embodiment",), Question("embodiment", f"which robot these recordings are of: {choices}"), said
            )
        else:
            said += ": control vectors drive the model; a description (docs/embodiments.md) makes action maps possible"
            self._found.say(("embodiment",), NO_EMBODIMENT, said)
        return match, old

    def _motion(self) -> None:
        episodes = self._sample.indices
        spans = [
            np.ptp(self._sample.episode(index, arm.joints), axis=0).max() for index in episodes for arm in self._arms
        ]
        if float(np.nan_to_num(spans).max()) * (1.0 if self._unit == "rad" else np.pi / 180) < _MOVES_RAD:
            text = f"No joint moves in the {len(episodes)} episodes that were looked at: no controls can be learned from them."
            self._found.notes.append(text)

    def _options(self, arm: ArmColumns, number: int, match: Match | None, *, old: bool) -> tuple[dict[str, Any], str]:
        """Signs, zeros and ranges of an arm's joints, and why."""
        if old:
            said = "names without `.pos`: an SO arm calibrated before LeRobot's PR 777, whose shoulder counts the other way"
            return {"signs": list(_OLD_SIGNS), "zeros": list(_OLD_ZEROS)}, f"{said} and whose zeros are elsewhere"
        if self._unit == "range_m100_100":
            limits: Sequence[tuple[float, float]] = [(-_RIGHT_ANGLE, _RIGHT_ANGLE)] * len(arm.joints)
            said = "nothing says the calibrated ranges: -100..100 is taken for -90..90 degrees, which control vectors do not mind"
            if match is not None:
                limits = load_embodiment(match.name).arms[number].limits
                said = "the description's limits, and a full turn of wrist_roll, stand for the calibrated ranges, which no dataset holds"
            turns = ["_".join(words).endswith(_FULL_TURN) for words in arm.joint_words]
            ends = [(-np.pi, np.pi) if turn else pair for turn, pair in zip(turns, limits, strict=True)]
            return {"ranges": [[round(float(low), 4), round(float(high), 4)] for low, high in ends]}, said
        if match is not None and arm.side in match.signs:
            said = f"joints that are within the limits of {match.name} only with the other sign: a mirrored arm"
            return {"signs": list(match.signs[arm.side])}, said
        return {}, ""

    def _track(
        self, columns: ArmColumns, arm: ArmColumns, options: dict[str, Any], name: str, command: ArmColumns | None,
        measured: dict[str, Any] | None = None,
    ) -> dict[str, Any]:  # fmt: skip
        """Joints and gripper of one arm in one track; `measured` is the state's, where this is the action."""
        track: dict[str, Any] = {"joints": {**_columns(columns.joints), **options}}
        gripper = columns.gripper
        if gripper is None:
            return track
        track["gripper"] = _columns([gripper])
        state = self._sample.values([gripper])[:, 0]
        open_is_high, why = _makers(self._robot_type, self._lerobot, gripper, fingers=bool(arm.fingers))
        if measured is not None and open_is_high is None:
            track["gripper"] |= _like_the_state(self._sample, gripper, arm, measured)
            return track
        commanded = None if command is None or command.gripper is None else self._sample.values([command.gripper])[:, 0]
        readings = gripper_readings(state, commanded, gripper.words, open_is_high=open_is_high, why=why)
        (low, high), said, span = readings.ends, readings.evidence, f"{state.min():.4g} to {state.max():.4g}"
        if gripper in columns.fingers:
            low, high = (0.0, 1.0) if state.min() >= -0.1 and state.max() <= 1.1 else (low, high)
            said = f"of the hand's {len(columns.fingers)} columns one stands for the gripper, which reads {span}; {why}"
        elif self._lerobot and self._unit != "rad":
            low, high, said = 0.0, 100.0, f"{why}; readings {span}"
        if readings.open_is_high is None:
            said += "; nothing says which end is open"
            for end in ("closed", "open"):
                text = f"reading of the {arm.side} gripper when it is {end} (it reads {span})"
                track["gripper"][end] = Question(f"{arm.side}_gripper_{end}", text)
        else:
            track["gripper"] |= (
                {"closed": low, "open": high} if readings.open_is_high else {"closed": high, "open": low}
            )
        self._found.evidence["arms", arm.side, name, "gripper"] = said
        return track


def _commands(sample: Sample, arms: list[ArmColumns], action: list[Column]) -> tuple[list[ArmColumns], str]:
    """Columns of the commands by arm; none, with the reason, where they are no joint positions."""
    found, _ = find_arms(action, commanded=True)
    if not found:
        return [], ("the action holds no joints" if action else "no action is recorded") + ": it repeats the state"
    if [len(arm.joints) for arm in found] != [len(arm.joints) for arm in arms]:
        return [], "the action has another number of joints than the state, which it repeats"
    for command, arm in zip(found, arms, strict=True):
        command.arrange(arm.joint_words)
        if command.gripper is None and arm.gripper is not None:
            command.gripper = next((c for c in command.fingers if c.words == arm.gripper.words), None) or next(
                (c for c in command.fingers if "index" in c.words), None
            )
        if (command.gripper is None) != (arm.gripper is None):
            return [], "the action has no gripper: it repeats the state"
        state, commanded = sample.values(arm.joints), sample.values(command.joints)
        moving = (np.ptp(state, axis=0) > 0.05 * np.ptp(state, axis=0).max()) & (commanded.std(axis=0) > 0)
        alike = [float(np.corrcoef(state[:, i], commanded[:, i])[0, 1]) for i in np.flatnonzero(moving)]
        if alike and np.median(alike) < _ALIKE:
            return [], (
                f"the action does not follow the state (correlation {np.median(alike):.2f}), so it is no joint position:"
                " it repeats the state"
            )
    return found, ""


def _columns(columns: Sequence[Column]) -> dict[str, Any]:
    """A choice of columns of one feature, by their names where they have some that are no patterns."""
    feature = columns[0].feature
    if any(column.feature != feature for column in columns):
        raise DataError(
            "Joints of one arm are in several features",
            got=named([c.label for c in columns]),
            next_step="write the source by hand (docs/sources.md)",
        )
    if all(column.name and not set(column.name) & set("*?[]") for column in columns):
        return {"feature": feature, "columns": [column.name for column in columns]}
    return {"feature": feature, "indices": [column.index for column in columns]}


def _like_the_state(sample: Sample, column: Column, arm: ArmColumns, measured: dict[str, Any]) -> dict[str, Any]:
    """Ends of a commanded gripper: the state's, or its own range in the same direction where it is of another size."""
    ends = {end: measured["gripper"][end] for end in ("closed", "open")}
    if arm.gripper is None or any(isinstance(value, Question) for value in ends.values()):
        return ends
    values, state = sample.values([column])[:, 0], sample.values([arm.gripper])[:, 0]
    low, high = sorted(ends.values())
    margin = 0.25 * (high - low)
    with np.errstate(invalid="ignore"):
        turned = values.std() > 0 and state.std() > 0 and float(np.corrcoef(values, state)[0, 1]) < -0.5
    if (
        values.min() >= low - margin
        and values.max() <= high + margin
        and not turned
        and np.ptp(values) >= 0.2 * np.ptp(state)
    ):
        return ends
    own = gripper_readings(values, None, column.words, open_is_high=True, why="")
    first, last = own.ends if (ends["closed"] < ends["open"]) != turned else own.ends[::-1]
    return {"closed": first, "open": last}


def _makers(robot_type: str, lerobot: bool, column: Column, *, fingers: bool) -> tuple[bool | None, str]:
    """True if high readings are open, where the makers of the recording's robot state it."""
    said = "".join(words_of(robot_type))
    if lerobot:
        return True, "LeRobot's grippers are 0 closed .. 100 open"
    if "droid" in said:
        return False, "DROID's gripper is 0 open .. 1 closed"
    if "aloha" in said or "viperx" in said or "trossen" in said or "widowx" in said:
        return True, "ALOHA's grippers are 0 closed .. 1 open"
    if "r1lite" in said or "galaxea" in said:
        return True, "Galaxea's grippers are 0 closed .. 100 open"
    if fingers and "inspire" in said:
        return True, "Inspire's fingers are 0 closed .. 1 open in Unitree's recordings"
    return None, ""


_PICTURES, _PICTURE_S = 48, 0.25
_STATE, _ACTION = "observation.state", "action"
_RATE_TOLERANCE = 0.02


def discover_lerobot(root: AnyPath) -> Discovery:
    """Raises: DataError when the folder is no dataset that can be read, or none of its episodes is."""
    info = read_info(root)
    version = info.codebase_version
    if version == "v3.0":
        check_files(root, [])
    dataset = LeRobotV3Dataset(root) if version == "v3.0" else LeRobotV21Dataset(root)
    sample = sample_of(dataset)
    robot_type = info.robot_type if isinstance(info.robot_type, str) else ""
    droid = is_droid(info, root.name)
    about = f"LeRobotDataset {version} of {named([robot_type or 'an unnamed robot'])}: {sample.listed} episodes at {info.fps:g} fps"
    source = {"kind": "lerobot_v3" if version == "v3.0" else "lerobot_v21", "path": str(root)}
    found = Discovery("lerobot", about, source, fps=info.fps, episodes=sample.listed)
    found.evidence["kind",] = f"meta/info.json says codebase_version {version}"
    found.frames = int(np.median([len(dataset.column(index, "timestamp")) for index in sample.indices]))
    if len(sample.indices) < min(sample.listed, EPISODES):
        found.episodes = len(sample.indices)
        found.notes.append(
            f"Only {found.episodes} of the {sample.listed} listed episodes can be read; curation quarantines the others."
        )
    _times(found, sample)
    state, action = _vectors(dataset, _STATE), _vectors(dataset, _ACTION)
    arms, why = find_arms(state)
    if not arms:
        _without_arms(found, dataset, why)
    else:
        ArmDescription(found, sample, "droid_franka" if droid else robot_type, arms).describe(action, why)
    _views(found, sample, arms)
    if droid:
        found.say(("split",), "test", "DROID is for evaluation only: results are compared on it")
        found.source["evaluation_only"] = True
        found.trains = False
    _success(found, dataset)
    if (licence := stated_licence(root)) is not None:
        found.say(("license",), *licence)
    name_calibration(found, root)
    return found


def _times(found: Discovery, sample: Sample) -> None:
    """Compare the stated rate with the time stamps."""
    steps = np.concatenate([np.diff(sample.dataset.column(i, "timestamp").reshape(-1)) for i in sample.indices])
    steps = steps[np.isfinite(steps) & (steps > 0)]
    if len(steps) and abs(np.median(steps) * sample.dataset.fps - 1) > _RATE_TOLERANCE:
        rate = 1 / float(np.median(steps))
        found.notes.append(
            f"meta/info.json says {sample.dataset.fps:g} fps, the time stamps {rate:.4g}: curation refuses that (wrong_fps)."
        )


def _vectors(dataset: LeRobotDataset, prefix: str) -> list[Column]:
    """Columns of the feature of this name, where its names or its width say whose they are; else of those that begin with it."""

    def width(name: str) -> int:
        """Size of a vector of floats; 0 for all else."""
        feature = dataset.features[name]
        match feature.get("dtype"), feature.get("shape"):
            case (("float32" | "float64"), [int(size)]) if 0 < size <= MAX_COLUMNS:
                return size
        return 0

    for wanted in ([prefix], [name for name in dataset.features if name.startswith(f"{prefix}.")]):
        columns: list[Column] = []
        for name in wanted:
            if name in dataset.features and (size := width(name)):
                columns += columns_of(name, flat_names(dataset.features[name]), size, prefix)
        if columns and find_arms(columns)[0]:
            return columns
    return []


def _without_arms(found: Discovery, dataset: LeRobotDataset, why: str) -> None:
    """The whole of the state, whatever its columns are."""
    shape = dataset.features.get(_STATE, {}).get("shape")
    if not isinstance(shape, list) or len(shape) != 1:
        raise DataError(
            "The dataset has no joints", where=f"{dataset.root}, meta/info.json", expected=f"a vector {_STATE}",
            got=named(list(dataset.features), 12), next_step="its videos alone serve Stage I: worldline init on the folder videos",
        )  # fmt: skip
    found.say(("embodiment",), NO_EMBODIMENT, f"no joints were recognised: {why}")
    found.say(("angle_unit",), "rad", "the whole state is taken as it is")
    found.state_size = int(shape[0])
    found.notes.append("No joints were recognised: declare `arms` (docs/sources.md) where the state has some.")


def _views(found: Discovery, sample: Sample, arms: list[ArmColumns]) -> None:
    dataset = sample.dataset
    cameras = [key for key in dataset.camera_keys if not is_depth(dataset.features[key])]
    depth = [key for key in dataset.camera_keys if key not in cameras]
    if not cameras:
        raise DataError(
            "The dataset has no camera in colour",
            where=f"{dataset.root}, meta/info.json",
            expected="a feature of dtype video or image",
            got=named(depth) or None,
        )
    sides: list[Side] = [arm.side for arm in arms]
    seen: dict[str, Seen | None] = {camera: _watched(sample, camera, arms) for camera in cameras}
    chosen = name_views(cameras, sides, seen)
    found.source["views"] = dict(chosen.views)
    for camera, why in chosen.evidence.items():
        found.evidence["views", camera] = why
    found.views = list(chosen.views.values())
    if chosen.unused:
        found.notes.append(f"Not used: {named(chosen.unused)}; models see a head view and a wrist view of each arm.")
    if depth:
        found.notes.append(f"Depth is left out: {named(depth)}.")


def _watched(sample: Sample, camera: str, arms: list[ArmColumns]) -> Seen | None:
    """Motion of the camera's picture while the arms of one episode move; None where it cannot be read."""
    if not arms:
        return None
    dataset = sample.dataset
    for index in sample.indices[:3]:
        states: dict[Side, np.ndarray] = {arm.side: sample.episode(index, arm.joints) for arm in arms}
        length = len(next(iter(states.values())))
        step = max(1, min(round(_PICTURE_S * dataset.fps), length // (_PICTURES // 2)))
        frames = np.arange(0, length, step)[:_PICTURES].tolist()
        try:
            pictures = _pictures(dataset, index, camera, frames)
        except DataError:  # curation says why
            continue
        scale = max(float(np.ptp(values, axis=0).max()) for values in states.values()) or 1.0
        motion: dict[Side, np.ndarray] = {
            side: np.abs(np.diff(values[frames], axis=0)).max(axis=1) / scale for side, values in states.items()
        }
        return watch(pictures, motion)
    return None


def _pictures(dataset: LeRobotDataset, index: int, camera: str, frames: list[int]) -> np.ndarray:
    if dataset.has_video(camera):
        return decode_frames(dataset.clip(index, camera), frames)
    return np.stack([image for number, image in enumerate(dataset.images(index, camera)) if number in set(frames)])


def _success(found: Discovery, dataset: LeRobotDataset) -> None:
    known = next(
        (name for name in ("next.success", "is_episode_successful", "success") if name in dataset.features), None
    )
    if known is not None:
        found.say(("success_column",), known, "a column of outcomes")


def discover_collection(root: AnyPath) -> Discovery:
    """Several datasets below one folder: the first one says how all are read; those that differ are named."""
    folders = [path.parent.parent for path in find_files(root, "info.json") if path.parent.name == "meta"]
    found = discover_lerobot(folders[0])

    def columns(folder: AnyPath) -> tuple[float, dict[str, Any]]:
        info = read_info(folder)
        kept = {
            key: {name: feature.get(name) for name in ("dtype", "shape", "names")}
            for key, feature in info.features.items()
        }
        return info.fps, kept

    first = columns(folders[0])
    other = [relative_name(folder, root) for folder in folders[1:] if columns(folder) != first]
    found.source["path"] = str(root)
    found.say(("collection",), True, f"{len(folders)} datasets below this folder; the first one says how they are read")
    found.about = f"{len(folders)} LeRobotDatasets, the first: {found.about}"
    if other:
        found.notes.append(
            f"Datasets with other columns, cameras or rates, which need a source of their own: {named(other)}."
        )
    return found
