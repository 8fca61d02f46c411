"""A LeRobotDataset: versions 2.0, 2.1 and 3.0, with pictures in videos or in the data files."""

from __future__ import annotations

import numpy as np

from worldline_core.data.episodes.episode import NO_EMBODIMENT
from worldline_core.data.episodes.source import says_droid
from worldline_core.data.guards.rejection import MAX_COLUMNS
from worldline_core.data.guards.source_paths import AnyPath, find_files, relative_name
from worldline_core.data.lerobot.dataset import (
    LeRobotDataset,
    LeRobotV3Dataset,
    LeRobotV21Dataset,
    check_files,
    is_depth,
    read_info,
)
from worldline_core.data.sources.lerobot import flat_names
from worldline_core.data.video.clip import decode_frames
from worldline_core.discovery.cameras import Seen, name_views, watch
from worldline_core.discovery.columns import ArmColumns, Column, Side, columns_of, find_arms
from worldline_core.discovery.findings import Discovery, name_calibration, named, stated_licence
from worldline_core.discovery.lerobot_arms import EPISODES, ArmDescription, Sample, sample_of
from worldline_core.errors import DataError

_PICTURES, _PICTURE_S = 48, 0.25
_STATE, _ACTION = "observation.state", "action"
_DROID_VIDEOS = {"observation.images.exterior_1_left", "observation.images.exterior_2_left"}
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
    droid = says_droid(robot_type, root.name, str(info.repo_id)) or set(info.features) >= _DROID_VIDEOS
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
