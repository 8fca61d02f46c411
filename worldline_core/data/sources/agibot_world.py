"""AgiBot World as published: HDF5 proprioception; per view one mp4 and two JSON files of camera parameters.

    task_info/task_<task>.json                                   instructions and labelled steps of all episodes
    proprio_stats/<task>/<episode>/proprio_stats.h5              timestamp [ns], state/*, action/*
    observations/<task>/<episode>/videos/<camera>_color.mp4
    parameters/<task>/<episode>/parameters/camera/<camera>_{intrinsic_params,extrinsic_params_aligned}.json

Joints are left then right [rad]; poses are of the arm's end link (xyz [m], quaternion xyzw) in the base frame of the
extrinsics, which are camera-to-base with OpenCV axes, one per frame or one for all. The gripper's state reads about 35 open
.. 120 closed, its command 0 open .. 1 closed. Episodes with dexterous hands (12 effector values) are quarantined: their
state is not the two-gripper layout of this embodiment.
"""

from __future__ import annotations

import json
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from worldline_core.data.episodes.conventions import along_tool_z
from worldline_core.data.episodes.recorded_poses import RecordedCameras, camera_pose, rejected_as
from worldline_core.data.episodes.source import (
    EmbodimentName,
    ForeignSourceConfig,
    GripperRange,
    LensConfig,
    LoadedEpisode,
    sorted_views,
)
from worldline_core.data.guards.plain_files import read_json, validated
from worldline_core.data.guards.rejection import RejectedInputError, all_of, check_rate
from worldline_core.data.guards.source_paths import AnyPath, find_folders, inside
from worldline_core.data.sources.agibot_gesim import (
    AGIBOT_CAMERAS,
    AGIBOT_STATE_NAMES,
    GRIPPER_COMMAND_RAW,
    GRIPPER_STATE_RAW,
    TOOL_OFFSET_RAW_M,
)
from worldline_core.data.sources.episode_files import EpisodeFiles
from worldline_core.data.sources.hdf5 import Hdf5File, open_hdf5, require_h5py
from worldline_core.data.video.clip import VideoClip, video_size
from worldline_core.geometry.transforms import pose_from_quaternion_xyzw

View = Literal["head", "left_wrist", "right_wrist"]
_POSTURE = {"head": ("head_yaw_rad", "head_pitch_rad"), "waist": ("waist_pitch_rad", "waist_lift_m")}
_MAX_NUMBER = 1e12


class _Intrinsic(BaseModel):
    """[pixels], and the coefficients of radtan."""

    model_config = ConfigDict(strict=True)
    fx: float
    fy: float
    ppx: float
    ppy: float
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0


class _IntrinsicFile(BaseModel):
    intrinsic: _Intrinsic


class AgibotWorldSourceConfig(ForeignSourceConfig):
    """A folder with `observations`, `parameters`, `proprio_stats` and `task_info`.

    Episodes of one task share a scene unless `scene` says otherwise: a task is recorded at one place, and a split by
    episode would test on what was trained on.
    """

    kind: Literal["agibot_world"] = "agibot_world"
    fps: float = Field(default=30.0, gt=0, description="rate that videos and timestamps must have")
    embodiment: EmbodimentName = "agibot_g1"
    views: tuple[View, ...] = Field(
        default=("head", "left_wrist", "right_wrist"), min_length=1, description="views that must be there"
    )
    gripper_state: GripperRange = GRIPPER_STATE_RAW
    gripper_command: GripperRange = GRIPPER_COMMAND_RAW
    tool_offset_m: float = TOOL_OFFSET_RAW_M
    distortions: dict[View, LensConfig] = Field(
        default={},
        description="view -> lens. Recorded coefficients are not applied: whether the published images still have the "
        "distortion is not documented; the largest is noted in the episode's conventions",
    )


class AgibotWorldSource(EpisodeFiles[AgibotWorldSourceConfig]):
    """Reads every `<task>/<episode>` that `proprio_stats` or `observations` has a folder of; ids are label-task-episode.

    Arrays are read one episode at a time, videos when their frames are asked for.
    """

    looked_for = "folders proprio_stats/<task>/<episode> or observations/<task>/<episode>"

    def __init__(self, config: AgibotWorldSourceConfig, root: AnyPath) -> None:
        require_h5py()
        folders = [folder for part in ("proprio_stats", "observations") for folder in find_folders(root / part, 2)]
        named = {(folder.parent.name, folder.name) for folder in folders}
        super().__init__(config, root, [root / task / episode for task, episode in named], lambda folder: folder.parts)
        self._episodes_of = lru_cache(maxsize=1)(self._read_task)  # episodes are read in order of tasks

    def load(self, episode_id: str) -> LoadedEpisode:
        config = self.config
        task, number = self.files[episode_id].parts
        info = self._info(task, number)
        videos = {
            view: inside(self.root, f"observations/{task}/{number}/videos/{AGIBOT_CAMERAS[view]}_color.mp4")
            for view in config.views
        }
        faults: list[RejectedInputError] = []
        sizes, absent = sorted_views(videos, lambda view: timed_video_size(videos[view], config.fps), faults)
        if faults:
            raise all_of([*faults, *absent.values()], f"episode {episode_id}")
        path = inside(self.root, f"proprio_stats/{task}/{number}/proprio_stats.h5")
        with open_hdf5(path) as file:
            positions = file.array("state/end/position", (None, 2, 3))
            length = len(positions)
            quaternions = file.array("state/end/orientation", (length, 2, 4))
            state, opening, overshoot = arm_vector(file, "state", length, config.gripper_state, path)
            action, _, command_overshoot = arm_vector(file, "action", length, config.gripper_command, path)
            times = file.times_ns("timestamp", length)
            posture = first_posture(file, length)
        with rejected_as("nan_state", path):
            ends = pose_from_quaternion_xyzw(positions, quaternions)
        cameras = RecordedCameras()
        folder = f"parameters/{task}/{number}/parameters/camera"
        distortion = max(
            (add_camera(cameras, view, self.root, folder, sizes[view], length) for view in sizes), default=0.0
        )
        episode = self.episode(
            episode_id,
            f"{config.label}-{task}",
            layout="agibot_world",
            state=state,
            action=action,
            overshoot=overshoot + command_overshoot,
            instruction=str(info.get("task_name") or "").strip(),
            timestamps=times,
            cameras=cameras.tracks,
            T_base_ee=along_tool_z(ends, config.tool_offset_m),
            gripper=opening,
            primary_view=config.views[0],
            state_names=AGIBOT_STATE_NAMES,
            conventions={
                "tool_offset_m": config.tool_offset_m,
                "distortion_not_applied": distortion if not config.distortions else 0.0,
                "steps": _steps(info),
                **posture,
                **cameras.notes(),
            },
        )
        return LoadedEpisode(
            episode,
            tuple(sizes),
            distortions={view: lens.distortion for view, lens in config.distortions.items() if view in sizes},
            clips={view: VideoClip.whole_file(videos[view], length, config.fps) for view in sizes},
            absent=absent,
        )

    def _read_task(self, task: str) -> dict[str, Any]:
        """What `task_info` says about the episodes of a task, by episode."""
        listed = read_json(inside(self.root, f"task_info/task_{task}.json"))
        rows = [row for row in listed if isinstance(row, dict)] if isinstance(listed, list) else []
        return {str(row.get("episode_id")): row for row in rows}

    def _info(self, task: str, number: str) -> dict[str, Any]:
        """What `task_info` says about an episode."""
        known = self._episodes_of(task)
        info = known.get(number)
        if info is None:
            raise RejectedInputError(
                "missing_column",
                "Task information does not name the episode",
                where=f"{self.root}, task_info/task_{task}.json",
                expected=f"an entry with episode_id {number}",
                got=f"{len(known)} entries",
            )
        return info


def arm_vector(
    file: Hdf5File, track: str, length: int, gripper: GripperRange, path: AnyPath
) -> tuple[np.ndarray, np.ndarray, int]:
    """(N, 16) in the embodiment's order, the openings (N, 2), and how many readings were clipped."""
    joints = file.array(f"{track}/joint/position", (length, 14))
    effector = two_grippers(file, track, length, path)
    opening, overshoot = gripper.opening(effector)
    vector = np.concatenate([joints[:, :7], opening[:, :1], joints[:, 7:], opening[:, 1:]], axis=1)
    return vector, opening, overshoot


def first_posture(file: Hdf5File, length: int) -> dict[str, float]:
    """Joints of head and waist at the first frame [rad, m], as far as they are recorded."""
    return {
        name: float(file.array(f"state/{part}/position", (length, 2))[0, i])
        for part, names in _POSTURE.items()
        if file.has(f"state/{part}/position")
        for i, name in enumerate(names)
    }


def two_grippers(file: Hdf5File, track: str, length: int, path: AnyPath) -> np.ndarray:
    """Readings (N, 2).

    Raises: RejectedInputError: invalid_gripper for dexterous hands, and as `Hdf5File.array`.
    """
    effector = file.array(f"{track}/effector/position", (length, None))
    if effector.shape[1] != 2:
        raise RejectedInputError(
            "invalid_gripper",
            "Effectors are no two grippers",
            where=f"{path}, {track}/effector/position",
            expected="2 values per frame, left and right gripper",
            got=f"{effector.shape[1]} (12: dexterous hands)",
        )
    return effector


def timed_video_size(path: AnyPath, fps: float) -> tuple[int, int]:
    """(height, width) of a video.

    Raises: RejectedInputError: wrong_fps, and as `video_size`.
    """
    height, width, rate = video_size(path)
    check_rate(rate, fps, path, tolerance=0.02)
    return height, width


def add_camera(
    cameras: RecordedCameras, view: str, root: AnyPath, folder: str, size: tuple[int, int], length: int
) -> float:
    """Add a view's camera, whose two files lie in a folder below root; returns its largest recorded distortion coefficient.

    Args:
        size: (height, width) of the images.
        length: number of states.
    """
    name = AGIBOT_CAMERAS[view]
    intrinsic_path = inside(root, f"{folder}/{name}_intrinsic_params.json")
    extrinsic_path = inside(root, f"{folder}/{name}_extrinsic_params_aligned.json")
    read = validated(_IntrinsicFile, read_json(intrinsic_path), intrinsic_path, "File of camera parameters").intrinsic
    if not all(abs(value) <= _MAX_NUMBER for _, value in read):  # NaN is not either
        raise RejectedInputError(
            "singular_intrinsics", "Intrinsics are not finite", where=intrinsic_path, expected="numbers", got=read
        )
    height, width = size
    if not (0 < read.ppx < width and 0 < read.ppy < height):
        raise RejectedInputError(
            "missing_calibration",
            "Principal point lies outside of the image: the calibration is of another image size",
            where=intrinsic_path,
            expected=f"inside of {width}x{height}",
            got=(read.ppx, read.ppy),
        )
    matrices = _extrinsics(extrinsic_path, length)
    pose = camera_pose(view, matrices, extrinsics="camera_to_base", axes="opencv", where=extrinsic_path)
    K = np.array([[read.fx, 0.0, read.ppx], [0.0, read.fy, read.ppy], [0.0, 0.0, 1.0]])
    cameras.add(view, K, pose, size)
    return max(map(abs, (read.k1, read.k2, read.k3, read.p1, read.p2)))


def _extrinsics(path: AnyPath, length: int) -> np.ndarray:
    """(N or 1, 4, 4) camera-to-base."""
    listed = read_json(path)
    if not isinstance(listed, list) or len(listed) not in (1, length):
        raise RejectedInputError(
            "length_mismatch",
            "Extrinsics and states differ in length",
            where=path,
            expected=f"a list of {length} (or 1)",
            got=len(listed) if isinstance(listed, list) else type(listed).__name__,
        )
    matrices = np.tile(np.eye(4), (len(listed), 1, 1))
    expected = "extrinsic.rotation_matrix (3, 3) and extrinsic.translation_vector (3,) in each entry"
    try:
        matrices[:, :3, :3] = [item["extrinsic"]["rotation_matrix"] for item in listed]
        matrices[:, :3, 3] = [item["extrinsic"]["translation_vector"] for item in listed]
    except (KeyError, TypeError) as error:
        raise RejectedInputError(
            "missing_column", "Extrinsics lack a field", where=path, expected=expected, got=repr(error)
        ) from error
    except ValueError as error:
        raise RejectedInputError(
            "invalid_extrinsics", "Extrinsics have a wrong shape", where=path, expected=expected, got=str(error)
        ) from error
    return matrices


def _steps(info: dict[str, Any]) -> str:
    """The labelled steps (first and last frame, text, skill) as JSON, as they were published."""
    label = info.get("label_info")
    steps = label.get("action_config") if isinstance(label, dict) else None
    return json.dumps(steps if isinstance(steps, list) else [], ensure_ascii=False, sort_keys=True)
