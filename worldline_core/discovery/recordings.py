"""Recordings of other layouts than LeRobot's and MCAP: the settings of their readers."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from worldline_core.data.episodes.episode import NO_EMBODIMENT, VIEWS
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.plain_files import expect_layout, read_json
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, find_files, is_file, relative_name
from worldline_core.data.sources.hdf5 import Hdf5File, open_hdf5
from worldline_core.data.sources.robomind import ROBOMIND_LAYOUTS, LayoutName
from worldline_core.data.sources.unitree_h5 import ROBOTS, check_columns
from worldline_core.data.video.clip import video_size
from worldline_core.discovery.arms import Side, gripper_readings
from worldline_core.discovery.cameras import name_views
from worldline_core.discovery.findings import Discovery, Question, named
from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import load_embodiment

_FILES = 8


def discover_episode_set(root: AnyPath) -> Discovery:
    """An EpisodeSet says everything about itself."""
    opened = EpisodeSet.open(root, allow_linked=False)
    rows = opened.rows
    if not rows:
        raise DataError("The EpisodeSet is empty", where=root, next_step="give a set with episodes")
    views = [view for view in VIEWS if all(view in row.views for row in rows)] or list(rows[0].views)
    robots = sorted({row.embodiment for row in rows})
    about = f"EpisodeSet of {named(robots)}: {len(rows)} episodes at {rows[0].fps:g} fps"
    why = "index.parquet and manifest.json of this project"
    found = Discovery.of("episode_set", root, about, why, views=views, fps=rows[0].fps, episodes=len(rows))
    episodes = [opened.episode(i) for i in _spread(rows, _FILES)]
    if episodes[0].state_kind != "none":
        found.state_size = max(episode.state.shape[1] for episode in episodes)
    found.count_cameras(*(episode.cameras for episode in episodes))
    return found


def _spread[T](items: Sequence[T], most: int) -> list[int]:
    return np.unique(np.linspace(0, len(items) - 1, min(len(items), most)).round().astype(int)).tolist()


def discover_videos(root: AnyPath) -> Discovery:
    """Plain videos: nothing but pictures."""
    videos = [path for path in find_files(root, "*") if path.suffix.lower() == ".mp4"]
    rates = [rate for i in _spread(videos, _FILES) if (rate := _rate(videos[i])) is not None]
    if not rates:
        raise DataError(
            "None of the videos can be read", where=root, got=f"{len(videos)} files", next_step="copy the files again"
        )
    same = len(set(rates)) == 1
    about = f"{len(videos)} videos at " + (f"{rates[0]:g} fps" if same else f"{min(rates):g} to {max(rates):g} fps")
    why = "mp4 files, and nothing that a reader of robots' recordings knows"
    found = Discovery.of("video_folder", root, about, why, views=["head"], episodes=len(videos))
    found.fps = rates[0] if same else None
    captions = [path for path in find_files(root, "*.txt") if is_file(path.with_suffix(".mp4"))]
    tables = [path for pattern in ("*.jsonl", "*.csv") for path in find_files(root, pattern) if path.parent == root]
    if not captions and len(tables) == 1:
        found.notes.append(
            f"{tables[0].name} may hold captions: captions: {{file: {tables[0].name}, video: COLUMN, caption: COLUMN}}."
        )
    found.notes.append("Videos without states serve Stage I; no controls are learned from them.")
    return found


def discover_droid(root: AnyPath) -> Discovery:
    """DROID's annotations: where the layout is several times below the folder, all are read."""
    files = find_files(root, "annotation/*/*.json")
    number = _first(files, _number_of_videos)
    about = f"DROID with annotations: {len(files)} episodes of {number} videos"
    why = "annotation/<split>/<n>.json beside the videos that they name"
    found = Discovery.of("droid_annotation", root, about, why, episodes=len(files), trains=False)
    found.say(("embodiment",), "droid_franka", "annotations are of DROID's Franka; gripper 0 open .. 1 closed")
    views = ["head", "exterior_2", "right_wrist"][:number]
    found.say(("views",), views, "DROID's order of cameras: two outside, one on the wrist")
    found.views = [view for view in views if view != "exterior_2"]
    found.state_size = load_embodiment("droid_franka").state_size
    subsets = sorted({file.parents[2] for file in files}, key=str)
    videos = [next(iter(find_files(subset / "videos", "*.mp4")), None) for subset in subsets]
    rates = sorted({rate for video in videos if (rate := _rate(video)) is not None})
    found.fps = rates[0] if len(rates) == 1 else None
    if len(rates) > 1:
        found.notes.append(f"Videos have several rates ({named(rates)} fps); each keeps its own.")
    found.say(("split",), "test", "DROID is for evaluation only: results are compared on it")
    return found


def _number_of_videos(file: AnyPath) -> int:
    record = read_json(file)
    with expect_layout(file, "an annotation: a mapping with videos"):
        return len(record["videos"])


def _rate(video: AnyPath | None) -> float | None:
    if video is None:
        return None
    try:
        return video_size(video)[2]
    except RejectedInputError:
        return None


def _first[T](files: Sequence[AnyPath], read: Callable[[AnyPath], T]) -> T:
    """Contents of the first readable file."""
    fault: RejectedInputError | None = None
    for path in files[:50]:
        try:
            return read(path)
        except RejectedInputError as error:
            fault = fault or error
    raise fault or DataError("No file can be read", got=f"{len(files)} files")


def discover_gesim(root: AnyPath) -> Discovery:
    """AgiBot's first-frame bundles."""
    found = sorted({path.parent for name in ("actions.npy", "state_joints_0.npy") for path in find_files(root, name)})
    why = "folders with actions.npy or state_joints_0.npy, and pictures"
    result = _agibot("agibot_gesim", f"AgiBot first-frame bundles: {len(found)}", root, why)
    result.views = list(VIEWS)
    result.say(("fps",), 30, "no file states the rate; AgiBot World records 30 Hz")
    result.notes.append(
        "Bundles hold first frames alone: they are for looking at controls and for predictions, not for training."
    )
    result.trains = False
    return result


def discover_agibot_world(root: AnyPath) -> Discovery:
    """AgiBot World's own layout."""
    episodes = {relative_name(path, root).parts[1:3] for path in find_files(root, "*_color.mp4")}
    why = "proprio_stats/ and observations/ of AgiBot World"
    result = _agibot("agibot_world", f"AgiBot World: {len(episodes)} episodes", root, why)
    present, result.views = _agibot_views(root)
    if not result.views:
        raise DataError(
            "AgiBot World without videos of its cameras",
            where=root,
            expected="head_color.mp4, hand_left_color.mp4, hand_right_color.mp4",
            next_step="unpack observations/",
        )
    result.say(("views",), result.views, f"videos of {named(present)}")
    result.fps = 30
    return result


def discover_enerverse(root: AnyPath) -> Discovery:
    """EnerVerse-AC's clips."""
    clips = {path.parent for name in ("proprio_stats.h5", "action.npy") for path in find_files(root, name)}
    result = _agibot(
        "enerverse_ac", f"EnerVerse-AC: {len(clips)} clips", root, "clips with proprio_stats.h5 or action.npy"
    )
    videos, views = _agibot_views(root)
    result.views = views or ["head"]
    result.say(("views",), result.views, f"videos of {named(videos) or 'no camera: first frames of the head'}")
    result.say(("fps",), 30, "no file states the rate; AgiBot World records 30 Hz, a clip cut with a stride has less")
    result.trains = bool(videos)
    return result


def _agibot_views(root: AnyPath) -> tuple[list[str], list[str]]:
    """AgiBot's cameras that have videos, and their views."""
    cameras = sorted({path.name.removesuffix("_color.mp4") for path in find_files(root, "*_color.mp4")})
    names = zip(VIEWS, ("head", "hand_left", "hand_right"), strict=True)
    return cameras, [view for view, camera in names if camera in cameras]


def _agibot(kind: str, about: str, root: AnyPath, why: str) -> Discovery:
    result = Discovery.of(kind, root, about, why, fps=30, cameras="all")
    result.say(("embodiment",), "agibot_g1", "AgiBot World is recorded with this robot")
    robot = load_embodiment("agibot_g1")
    result.state_size = robot.state_size
    if not robot.description_path.is_file():
        result.notes.append(
            f"Action maps need the robot's kinematic description: {robot.description.obtain}; then set WORLDLINE_DESCRIPTION_AGIBOT_G1 to its path."
        )
    return result


def discover_robomind(root: AnyPath) -> Discovery:
    """RoboMIND: one robot's folder."""
    files = find_files(root, "trajectory.hdf5")
    parts = [*root.parts, *relative_name(files[0], root).parts]
    layout: LayoutName | None = next((name for name in ROBOMIND_LAYOUTS if name in parts), None)
    found = Discovery.of("robomind", root, f"RoboMIND: {len(files)} episodes", "trajectory.hdf5 files")
    others = sorted({name for name in ROBOMIND_LAYOUTS for path in files if name in relative_name(path, root).parts})
    if len(others) > 1:
        raise DataError(
            "Several robots' folders of RoboMIND",
            where=root,
            expected="one of them",
            got=named(others),
            next_step=f"give one robot's folder: {root / others[0]}",
        )
    if layout is None:
        choices = Question("layout", f"folder of the release that these files are from: {', '.join(ROBOMIND_LAYOUTS)}")
        found.source["layout"] = choices
    else:
        found.say(("layout",), layout, "by the folder's name")
        described = ROBOMIND_LAYOUTS[layout]
        found.views = list(described.views)
        found.evidence["views",] = "the release says where its cameras are"
        for key, track in (("gripper_state", "puppet"), ("gripper_command", "master")):
            if described.grippers and (key == "gripper_state" or described.commanded):
                _ask_gripper(found, key, described.arms, files, track)
        if described.channels is None:
            text = "standard, or as_written where red looks blue in the pictures"
            found.source["channels"] = Question("channels", text)
    rate = "frames a second: the release does not say it (30 is what other readers use for version 1)"
    found.say(("fps",), Question("fps", rate), "no file states the rate")
    return found


def _ask_gripper(found: Discovery, key: str, arms: Any, files: Sequence[AnyPath], track: str) -> None:
    """Gripper readings of one track: known where the readings say so, asked otherwise."""
    values = []
    for i in _spread(files, _FILES):
        try:
            with open_hdf5(files[i]) as file:
                values += [
                    file.columns(arm.gripper, None, "missing_column", track).ravel()
                    for arm in arms
                    if arm.gripper is not None
                ]
        except RejectedInputError:
            continue
    if not values:
        raise DataError("Grippers of no file can be read", where=files[0], next_step="check that the files are whole")
    readings = gripper_readings(np.concatenate(values), None, (), open_is_high=None, why="")
    text = f"reading of the gripper ({key}) when it is {{}} ({readings.evidence})"
    asked = {end: Question(f"{key}_{end}", text.format(end)) for end in ("closed", "open")}
    found.say((key,), asked, f"{readings.evidence}; nothing says which end is open")


def discover_unitree(root: AnyPath) -> Discovery:
    """Unitree's HDF5 sets, and those of ACT's recorder, which ALOHA uses."""
    trained = [path for path in find_files(root, "*.h5") if relative_name(path, root).parts[:-2] == ("transitions",)]
    files = trained or find_files(root, "episode_*.hdf5")
    track = "observation.state" if trained else "observations/qpos"

    def look(path: AnyPath) -> tuple[np.ndarray, list[str], bool]:
        with open_hdf5(path) as file:
            cameras = [] if trained else file.names("observations/images")
            return file.array(track, (None, None)), cameras, not trained and _pixels(file)

    values, cameras, pixels = _first(files, look)
    about = f"Unitree's or ACT's HDF5: {len(files)} episodes of {values.shape[1]} columns"
    why = "transitions/<dataset>/<n>.h5" if trained else "episode_<n>.hdf5 with observations/qpos"
    found = Discovery.of("unitree_h5", root, about, why)
    if trained:
        cameras = sorted({relative_name(path, root).parts[2] for path in find_files(root / "videos", "*.mp4")})
    robot = _unitree_robot(found, values, bool(trained), root)
    sides: list[Side] = [arm.name for arm in ROBOTS[robot]] if robot else ["right"]
    chosen = name_views(cameras, sides, {})
    if not chosen.views:
        raise DataError(
            "The recordings have no pictures", where=root, expected="observations/images or videos/<dataset>/<camera>"
        )
    found.source["views"] = {view: camera for camera, view in chosen.views.items()}
    for camera, view in chosen.views.items():
        found.evidence["views", view] = chosen.evidence[camera]
    found.views = list(found.source["views"])
    rate = _rate(next(iter(find_files(root / "videos", "*.mp4")), None)) if trained else None
    if rate is not None:
        found.say(("fps",), rate, "the videos have it")
        found.fps = rate
    elif robot == "aloha":
        found.say(("fps",), 50, "no file states the rate; ACT's recorder writes 50 Hz")
        found.fps = 50
    else:
        found.say(("fps",), 30, "no file states the rate; Unitree records 30 Hz")
        found.fps = 30
    if robot:
        for key, name in (("gripper_state", track), ("gripper_command", "action")):
            if robot == "aloha":
                found.say((key,), {"closed": 0, "open": 1}, "ACT's recorder writes 0 closed .. 1 open")
            elif robot == "g1_dex1":
                why = "Unitree's teleoperation commands a Dex1 gripper 0 closed .. 5.4 rad open"
                found.say((key,), {"closed": 0.0, "open": 5.4}, why)
            else:
                _ask_gripper(found, key, ROBOTS[robot], files, name)
        if robot == "aloha" or (not trained and not pixels):
            text = "order of the pictures' channels: standard, or as_written where red looks blue; ACT's recorder hands OpenCV RGB: as_written"
            found.source["channels"] = "as_written" if robot == "aloha" else Question("channels", text)
            found.evidence["channels",] = "ACT's recorder hands OpenCV pictures in RGB"
        found.state_size = sum((arm.joints.chosen.stop - arm.joints.chosen.start) + 1 for arm in ROBOTS[robot])  # pyright: ignore[reportOptionalMemberAccess]
    return found


def _pixels(file: Hdf5File) -> bool:
    return all(file.holds_pixels(f"observations/images/{camera}") for camera in file.names("observations/images"))


_Z1 = re.compile(r"(?<![a-z0-9])(unitree)?z1(?![a-z0-9])", re.IGNORECASE)  # and not a name that ends so by chance


def _unitree_robot(found: Discovery, values: np.ndarray, trained: bool, root: AnyPath) -> Any:
    """The robot whose columns these are; asked where two would do."""
    width = values.shape[1]
    if width == 16:
        found.say(("robot",), "g1_dex1", "16 columns: 7 joints of each arm, then both grippers")
        found.say(("embodiment",), "unitree_g1_29dof", "the G1's arms have 7 joints")
        return "g1_dex1"
    fitting = []
    for robot in ("z1_single",) if width == 7 else ("z1_dual", "z1_dual_grippers_last") if width == 14 else ():
        try:
            check_columns(values, robot, "")
            fitting.append(robot)
        except RejectedInputError:
            continue
    if width == 14 and (not fitting or (not trained and not _Z1.search(str(root)))):
        beyond = "" if fitting else ", beyond the limits of a Z1"
        why = f"14 columns{beyond}: ALOHA's 6 joints and gripper of each arm, by ACT's recorder"
        found.say(("robot",), "aloha", why)
        found.say(("embodiment",), "aloha", "two arms of 6 joints; aloha_viperx where yours stand side by side")
        return "aloha"
    if not fitting:
        raise DataError(
            "Columns of no robot that is read",
            where=root,
            expected="16 (G1 with Dex1 grippers), 14 (two Z1, ALOHA), 7 (one Z1)",
            got=width,
            next_step="robots with dexterous hands are read as LeRobot datasets",
        )
    also = f"; {fitting[1]} would fit too" if len(fitting) > 1 else ""
    found.say(("robot",), fitting[0], f"{width} columns within a Z1's limits{also}")
    found.say(("embodiment",), NO_EMBODIMENT, "no file of configs/embodiments describes a Z1")
    return fitting[0]


def discover_robotwin(root: AnyPath) -> Discovery:
    """RoboTwin 2's simulated episodes."""
    files = find_files(root, "episode*.hdf5")

    def cameras(path: AnyPath) -> list[str]:
        with open_hdf5(path) as file:
            return file.names("observation")

    known: Mapping[str, str] = {"head": "head_camera", "left_wrist": "left_camera", "right_wrist": "right_camera"}
    present = _first(files, cameras)
    about, why = f"RoboTwin 2: {len(files)} episodes", "data/episode<n>.hdf5 with observation/<camera>"
    found = Discovery.of("robotwin", root, about, why, cameras="all", trains=False)
    views = {view: camera for view, camera in known.items() if camera in present}
    found.say(("views",), views, f"cameras of the file: {named(present)}")
    found.views = list(found.source["views"])
    rate = "frames a second: 250 divided by `save_freq` of the task's configuration (15: 16.667)"
    found.say(("fps",), Question("fps", rate), "no file states the rate")
    found.say(("split",), "test", "RoboTwin is for evaluation only: results are compared on it")
    return found
