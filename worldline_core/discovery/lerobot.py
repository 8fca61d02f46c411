"""A LeRobotDataset: versions 2.0, 2.1 and 3.0, with pictures in videos or in the data files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from worldline_core.data.episodes.episode import NO_EMBODIMENT
from worldline_core.data.episodes.source import says_droid
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
from worldline_core.data.sources.calibration_file import read_calibration
from worldline_core.data.sources.lerobot import flat_names
from worldline_core.data.video.clip import decode_frames
from worldline_core.discovery.cameras import Seen, name_views, watch
from worldline_core.discovery.columns import ArmColumns, Column, columns_of, find_arms
from worldline_core.discovery.findings import Discovery, Question, named
from worldline_core.discovery.licence import stated_licence
from worldline_core.discovery.robots import is_lerobot_arm, joint_order, match_robot
from worldline_core.discovery.units import gripper_readings, joint_unit
from worldline_core.discovery.words import Side, words_of
from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import load_embodiment

_EPISODES, _TRIED = 8, 400
_PICTURES, _PICTURE_S = 48, 0.25
_STATE, _ACTION = "observation.state", "action"
_CALIBRATIONS = (
    "meta/calibration.yaml",
    "meta/calibration.yml",
    "meta/calibration.json",
    "calibration.yaml",
    "calibration.json",
)
_OLD_SIGNS, _OLD_ZEROS = (1, -1, 1, 1, 1), (0, 90, 90, 0, 0)
"""Of an SO-100 before LeRobot's change of calibration (PR 777): its arm stretched out is where shoulder and elbow are 0."""
_DROID_VIDEOS = {"observation.images.exterior_1_left", "observation.images.exterior_2_left"}
_FULL_TURN = "wrist_roll"
_MOVES_RAD, _RATE_TOLERANCE = 0.02, 0.02
_ALIKE = 0.5
"""Least correlation of a command with the state that follows it."""


@dataclass
class _Sample:
    """Some episodes that can be read: their numbers, and their columns one after the other."""

    dataset: LeRobotDataset
    indices: list[int]
    listed: int

    def values(self, columns: Sequence[Column]) -> np.ndarray:
        """(N, len(columns)) float64 of all sampled episodes; the median stands for what is no number."""
        values = np.concatenate([self.episode(index, columns) for index in self.indices])
        usual = [np.median(column[np.isfinite(column)]) if np.isfinite(column).any() else 0.0 for column in values.T]
        return np.where(np.isfinite(values), values, usual)

    def episode(self, index: int, columns: Sequence[Column]) -> np.ndarray:
        features = {c.feature: self.dataset.column(index, c.feature) for c in columns}
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


def discover_lerobot(root: AnyPath) -> Discovery:
    """Raises: DataError when the folder is no dataset that can be read, or none of its episodes is."""
    info = read_info(root)
    version = info.codebase_version
    if version == "v3.0":
        check_files(root, [])
    dataset = LeRobotV3Dataset(root) if version == "v3.0" else LeRobotV21Dataset(root)
    sample = _sample(dataset)
    robot_type = info.robot_type if isinstance(info.robot_type, str) else ""
    droid = says_droid(robot_type, root.name, str(info.repo_id)) or set(info.features) >= _DROID_VIDEOS
    about = f"LeRobotDataset {version} of {named([robot_type or 'an unnamed robot'])}: {sample.listed} episodes at {info.fps:g} fps"
    found = Discovery(
        "lerobot",
        about,
        {"kind": "lerobot_v3" if version == "v3.0" else "lerobot_v21", "path": str(root)},
        fps=info.fps,
    )
    found.evidence["kind",] = f"meta/info.json says codebase_version {version}"
    found.episodes, found.frames = (
        sample.listed,
        int(np.median([len(sample.dataset.column(i, "timestamp")) for i in sample.indices])),
    )
    if len(sample.indices) < min(sample.listed, _EPISODES):
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
        _with_arms(found, sample, "droid_franka" if droid else robot_type, arms, action, why)
    _views(found, sample, arms)
    if droid:
        found.say(("split",), "test", "DROID is for evaluation only: results are compared on it")
        found.source["evaluation_only"] = True
        found.trains = False
    _success(found, dataset)
    if (licence := stated_licence(root)) is not None:
        found.say(("license",), *licence)
    _calibration(found, root)
    return found


def _sample(dataset: LeRobotDataset) -> _Sample:
    listed = [int(index) for index in dataset.episodes.indices]
    spread = np.linspace(0, len(listed) - 1, min(len(listed), _EPISODES)).round().astype(int).tolist()
    order = [listed[i] for i in dict.fromkeys([*spread, *range(len(listed))])][:_TRIED]
    readable: list[int] = []
    fault: DataError | None = None
    for index in order:
        try:
            dataset.column(index, "timestamp")
            readable.append(index)
        except RejectedInputError as error:
            fault = fault or error
        if len(readable) == _EPISODES:
            break
    if not readable:
        raise DataError(
            "No episode of the dataset can be read" if listed else "The dataset lists no episodes",
            where=dataset.root, expected="data files of at least one of the listed episodes", got=fault and str(fault),
            next_step="copy or download the dataset again, as a whole",
        )  # fmt: skip
    return _Sample(dataset, sorted(readable), len(listed))


def _times(found: Discovery, sample: _Sample) -> None:
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
        """Of a vector of floats; 0 for all else."""
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


def _with_arms(
    found: Discovery, sample: _Sample, robot_type: str, arms: list[ArmColumns], action: list[Column], why: str
) -> None:
    lerobot = is_lerobot_arm(robot_type, arms)
    joints = [sample.values(arm.joints) for arm in arms]
    unit, evidence, doubtful = joint_unit(
        np.concatenate(joints, axis=1), [c.words for a in arms for c in a.joints], lerobot=lerobot
    )
    old = (
        lerobot
        and unit == "deg"
        and not any(c.name.endswith(".pos") for a in arms for c in a.joints)
        and all(len(a.joints) == 5 for a in arms)
    )
    ranges = None

    def angles(signs: Any, zeros: Any) -> list[np.ndarray]:
        if unit == "range_m100_100":
            return [np.zeros_like(values) for values in joints]
        scale = np.pi / 180 if unit == "deg" else 1.0
        return [(values - np.array(zeros or 0)) * np.array(signs or 1) * scale for values in joints]

    readings = [(None, None), (_OLD_SIGNS, _OLD_ZEROS)] if old else [(None, None)]
    matches = [(match_robot(robot_type, arms, angles(*reading)), reading) for reading in reversed(readings)]
    # Sorting is stable: of two readings that fit as well, names without `.pos` decide.
    matches.sort(key=lambda each: each[0][0] is None or not each[0][0].fits)
    (match, others, said), (signs, zeros) = matches[0]
    old = zeros is not None
    fingers = [arm for arm in arms if arm.gripper is None]
    if match is not None and fingers:
        for arm in fingers:
            arm.gripper = next((c for c in arm.fingers if "index" in c.words), None) or (
                arm.fingers[0] if arm.fingers else None
            )
        if any(arm.gripper is None for arm in arms):
            said = f"{match.name} fits ({match.evidence}), but no column is a gripper, which its state has"
            match, others = None, []
    spans = [np.ptp(sample.episode(index, arm.joints), axis=0).max() for index in sample.indices for arm in arms]
    if float(np.nan_to_num(spans).max()) * (1.0 if unit == "rad" else np.pi / 180) < _MOVES_RAD:
        text = f"No joint moves in the {len(sample.indices)} episodes that were looked at: no controls can be learned from them."
        found.notes.append(text)
    found.say(
        ("angle_unit",),
        unit,
        evidence + ("; look at `signs` and `zeros`: an older calibration of LeRobot" if old else ""),
    )
    if doubtful:
        found.notes.append(
            "angle_unit: degrees are likelier, range_m100_100 would fit as well. Compare a few poses with the pictures."
        )
    if match is not None:
        found.say(("embodiment",), match.name, match.evidence)
        robot = load_embodiment(match.name)
        for number, arm in enumerate(arms):
            order = joint_order(arm, robot, number)
            arm.joints = [arm.joints[i] for i in order]
            arm.side = robot.arms[number].name  # type: ignore[assignment]
    elif others:
        text = f"which robot these recordings are of: {', '.join(others[:10])}; or none, or the path of a description (docs/embodiments.md)"
        found.say(("embodiment",), Question("embodiment", text), said)
    else:
        found.say(
            ("embodiment",),
            NO_EMBODIMENT,
            f"{said}: control vectors drive the model; a description (docs/embodiments.md) makes action maps possible",
        )
    commands, unlike = _commands(sample, arms, action)
    entries: list[dict[str, Any]] = []
    for number, arm in enumerate(arms):
        if unit == "range_m100_100":
            ranges = _ranges(arm, None if match is None else match.name, number)
        options = {
            "signs": list(signs)
            if signs
            else list(match.signs[arm.side])
            if match and arm.side in match.signs
            else None,
            "zeros": list(zeros) if zeros else None,
            "ranges": ranges,
        }
        options = {key: value for key, value in options.items() if value is not None}
        entry: dict[str, Any] = {
            "name": arm.side,
            "state": _track(
                found,
                sample,
                arm,
                arm,
                options,
                robot_type,
                lerobot,
                ("arms", arm.side, "state"),
                commands[number] if commands else None,
            ),
        }
        if commands:
            entry["action"] = _track(
                found,
                sample,
                commands[number],
                arm,
                options,
                robot_type,
                lerobot,
                ("arms", arm.side, "action"),
                None,
                entry["state"],
            )
        entries.append(entry)
        if options:
            found.evidence["arms", arm.side, "state", "joints"] = _options_said(options, old, match)
    found.source["arms"] = entries
    found.evidence["arms",] = why + (f"; {unlike}" if unlike else "")
    found.state_size = sum(len(arm.joints) + (arm.gripper is not None) for arm in arms)


def _options_said(options: dict[str, Any], old: bool, match: Any) -> str:
    if old:
        return "names without `.pos`: an SO arm calibrated before LeRobot's PR 777, whose shoulder counts the other way and whose zeros are elsewhere"
    if "ranges" in options:
        return "the limits of the description, and a full turn of wrist_roll, stand for the calibrated ranges, which the dataset does not hold"
    return f"joints that are within the limits of {match.name} only with the other sign: a mirrored arm"


def _ranges(arm: ArmColumns, robot: str | None, number: int) -> list[Any]:
    limits = (
        [(-np.pi / 2, np.pi / 2)] * len(arm.joints) if robot is None else load_embodiment(robot).arms[number].limits
    )
    return [
        [-3.1416, 3.1416] if "_".join(words).endswith(_FULL_TURN) else [round(float(low), 4), round(float(high), 4)]
        for words, (low, high) in zip(arm.joint_words, limits, strict=True)
    ]


def _commands(sample: _Sample, arms: list[ArmColumns], action: list[Column]) -> tuple[list[ArmColumns], str]:
    """Columns of the commands by arm; none, with the reason, where they are no joint positions."""
    found, _ = find_arms(action, commanded=True)
    if not found:
        return (
            [],
            "the action holds no joints: it repeats the state"
            if action
            else "no action is recorded: it repeats the state",
        )
    if [len(arm.joints) for arm in found] != [len(arm.joints) for arm in arms]:
        return [], "the action has another number of joints than the state, which it repeats"
    for command, arm in zip(found, arms, strict=True):
        order = (
            [command.joint_words.index(words) for words in arm.joint_words]
            if sorted(command.joint_words) == sorted(arm.joint_words) and len(set(arm.joint_words)) == len(arm.joints)
            else range(len(arm.joints))
        )
        command.joints = [command.joints[i] for i in order]
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


def _track(
    found: Discovery, sample: _Sample, columns: ArmColumns, arm: ArmColumns, options: dict[str, Any], robot_type: str,
    lerobot: bool, place: tuple[str, ...], commands: ArmColumns | None, measured: dict[str, Any] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Joints and gripper of one arm in one track; `measured` is the state's, where this is the action."""
    track: dict[str, Any] = {"joints": {**_columns(columns.joints), **options}}
    if columns.gripper is None:
        return track
    state = sample.values([columns.gripper])[:, 0]
    command = None if commands is None or commands.gripper is None else sample.values([commands.gripper])[:, 0]
    open_is_high, why = _makers(robot_type, lerobot, columns.gripper, fingers=bool(arm.fingers))
    if measured is not None and open_is_high is None:
        return {
            **track,
            "gripper": {**_columns([columns.gripper]), **_like_the_state(sample, columns.gripper, arm, measured)},
        }
    if columns.gripper in columns.fingers:
        ends = (0.0, 1.0) if state.min() >= -0.1 and state.max() <= 1.1 else None
        readings = gripper_readings(state, command, columns.gripper.words, open_is_high=open_is_high, why=why)
        low, high = ends or readings.ends
        said = f"of the hand's {len(columns.fingers)} columns one stands for the gripper, which reads {state.min():.3g} to {state.max():.3g}; {why}"
    else:
        readings = gripper_readings(state, command, columns.gripper.words, open_is_high=open_is_high, why=why)
        (low, high), said = (
            ((0.0, 100.0), f"LeRobot's grippers: 0 closed .. 100 open; readings {state.min():.4g} to {state.max():.4g}")
            if lerobot
            else (readings.ends, readings.evidence)
        )
    if readings.open_is_high is None:
        side = place[1]
        text = f"reading of the {side} gripper when it is"
        range_said = f"(it reads {state.min():.4g} to {state.max():.4g})"
        ends_said: dict[str, Any] = {
            end: Question(f"{side}_gripper_{end}", f"{text} {end} {range_said}") for end in ("closed", "open")
        }
        said += "; nothing says which end is open"
    else:
        ends_said = {"closed": low, "open": high} if readings.open_is_high else {"closed": high, "open": low}
    found.evidence[(*place, "gripper")] = said
    return {**track, "gripper": {**_columns([columns.gripper]), **ends_said}}


def _like_the_state(sample: _Sample, column: Column, arm: ArmColumns, measured: dict[str, Any]) -> dict[str, Any]:
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
    """Whether high readings are open, where the makers of the recording's robot state it."""
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


def _views(found: Discovery, sample: _Sample, arms: list[ArmColumns]) -> None:
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


def _watched(sample: _Sample, camera: str, arms: list[ArmColumns]) -> Seen | None:
    """What the camera's picture does while the arms of one episode move; None where it cannot be read."""
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


def _calibration(found: Discovery, root: AnyPath) -> None:
    for name in _CALIBRATIONS:
        if not (root / name).exists():
            continue
        known = list(read_calibration(root / name).views)
        found.say(("calibration",), name, f"cameras of {named(known)}")
        found.calibrated = set(found.views) <= set(known)
        return


def discover_collection(root: AnyPath) -> Discovery:
    """Several datasets below one folder: the first one says how all are read; those that differ are named."""
    folders = [path.parent.parent for path in find_files(root, "info.json") if path.parent.name == "meta"]
    found = discover_lerobot(folders[0])
    features = {
        name: {key: feature.get(key) for key in ("dtype", "shape", "names")}
        for name, feature in read_info(folders[0]).features.items()
    }
    other = []
    for folder in folders[1:]:
        info = read_info(folder)
        alike = {
            name: {key: feature.get(key) for key in ("dtype", "shape", "names")}
            for name, feature in info.features.items()
        }
        if alike != features or info.fps != found.fps:
            other.append(relative_name(folder, root))
    found.source["path"] = str(root)
    found.say(("collection",), True, f"{len(folders)} datasets below this folder; the first one says how they are read")
    found.about = f"{len(folders)} LeRobotDatasets, the first: {found.about}"
    if other:
        found.notes.append(
            f"Datasets with other columns, cameras or rates, which need a source of their own: {named(other)}."
        )
    return found
