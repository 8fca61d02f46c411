"""AgiBot World in its three published layouts: whole recordings, EnerVerse-AC's clips, GE-Sim's first-frame bundles.

`agibot_world`: HDF5 proprioception; per view one mp4 and two JSON files of camera parameters.
    task_info/task_<task>.json                                   instructions of all episodes
    proprio_stats/<task>/<episode>/proprio_stats.h5              timestamp [ns], state/*, action/*
    observations/<task>/<episode>/videos/<camera>_color.mp4
    parameters/<task>/<episode>/parameters/camera/<camera>_{intrinsic_params,extrinsic_params_aligned}.json
`enerverse_ac`: one folder per clip (also of the AgiBot World challenges), with the same files, cut to the clip:
    <clip>/proprio_stats.h5, <camera>_{intrinsic_params,extrinsic_params_aligned}.json, and <camera>_color.mp4 or frame.png
    <clip>/{action,intrinsics,extrinsics}.npy, frame.png         or, of the head camera, as its inference script reads them
`agibot_gesim`: `sample_*` (v1: a few frames per view, end poses) and `demo_*` (v2: the first frame, joints and commands).

Joints are left then right [rad]. Poses are of the arms' end links (xyz [m], quaternion xyzw; GE-Sim v2: fixed-axes roll pitch
yaw) in the base frame of the extrinsics, which are camera-to-base with OpenCV axes. The tool centre lies further along their
+z. Where no commands are published the action repeats the state. Episodes with dexterous hands (12 effector values) are
quarantined: their state is not the two-gripper layout of this embodiment.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache, partial
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from worldline_core.config import FrameRate
from worldline_core.data.episodes.conventions import along_tool_z
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.recorded_poses import RecordedCameras, camera_pose, rejected_as
from worldline_core.data.episodes.source import (
    EmbodimentName,
    EpisodeFiles,
    ForeignSourceConfig,
    GripperRange,
    LoadedEpisode,
    joint_names,
    sorted_views,
    timed_video_size,
)
from worldline_core.data.guards.plain_files import read_image, read_json, read_npy, read_text, validated
from worldline_core.data.guards.rejection import RejectedInputError, all_of, check_finite
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside, inside_folder, is_file, relative_name
from worldline_core.data.sources.hdf5 import ArmPlace, Columns, open_hdf5, require_h5py
from worldline_core.data.video.clip import VideoClip
from worldline_core.geometry.transforms import pose_from_euler_fixed_xyz, pose_from_quaternion_xyzw

View = Literal["head", "left_wrist", "right_wrist"]
_CAMERAS = {"head": "head", "left_wrist": "hand_left", "right_wrist": "hand_right"}
"""View -> AgiBot's name of the camera, in file names of every layout."""
_JOINT_NAMES = joint_names({"left": 7, "right": 7})
_POSE_NAMES = tuple(
    f"{arm}/{name}" for arm in ("left", "right") for name in ("x", "y", "z", "qx", "qy", "qz", "qw", "gripper")
)
_EFFECTORS = Columns("{track}/effector/position", widths=(2,))
_ARMS = tuple(
    ArmPlace(
        arm,
        Columns("{track}/joint/position", slice(7 * n, 7 * n + 7), (14,)),
        Columns(_EFFECTORS.dataset, slice(n, n + 1), (2,)),
    )
    for n, arm in enumerate(("left", "right"))
)
_GRIPPER_STATE = GripperRange(closed=120.0, open=35.0)
"""Readings of `state/effector/position`, checked on images."""
_GRIPPER_STATE_V2 = GripperRange(closed=119.0, open=0.2)
_GRIPPER_COMMAND = GripperRange(closed=1.0, open=0.0)
_TOOL_OFFSET_M = 0.23
"""From the arm's end link to between the fingertips, along +z."""
_TOOL_OFFSET_V2_M = 0.15
_POSTURE = {"head": ("head_yaw_rad", "head_pitch_rad"), "waist": ("waist_pitch_rad", "waist_lift_m")}
"""Names of the joints outside of the state, noted at the first frame: kinematics need them (`Embodiment.noted_posture`)."""
_IMAGES_V2 = {"head": "cur_head.png", "left_wrist": "cur_left.png", "right_wrist": "cur_right.png"}
_STEP_OF_EPISODE = re.compile(r"(\d+)-(\d+)-(\d+)")
"""Name of a clip's folder where all clips are side by side: task, episode, step."""


class _ClipConfig(ForeignSourceConfig):
    fps: FrameRate = Field(description="stated in no file (AgiBot World records 30 Hz); a video must have it")
    embodiment: EmbodimentName = "agibot_g1"


class AgibotGesimSourceConfig(_ClipConfig):
    """A folder of bundles."""

    kind: Literal["agibot_gesim"] = "agibot_gesim"


class EnerverseAcSourceConfig(_ClipConfig):
    """Clips of one task share a scene unless `scene` says otherwise: several may be cut from one recording."""

    kind: Literal["enerverse_ac"] = "enerverse_ac"
    views: tuple[View, ...] = Field(
        default=("head",), min_length=1, description="views that must be there; clips with frame.png have one"
    )


class AgibotWorldSourceConfig(ForeignSourceConfig):
    """A folder with `observations`, `parameters`, `proprio_stats` and `task_info`.

    Episodes of one task share a scene unless `scene` says otherwise: a task is recorded at one place, and a split by
    episode would test on what was trained on.
    """

    kind: Literal["agibot_world"] = "agibot_world"
    fps: FrameRate = Field(default=30.0, description="rate that videos and timestamps must have")
    embodiment: EmbodimentName = "agibot_g1"
    views: tuple[View, ...] = Field(
        default=("head", "left_wrist", "right_wrist"), min_length=1, description="views that must be there"
    )


class AgibotWorldSource(EpisodeFiles[AgibotWorldSourceConfig]):
    """Reads every `<task>/<episode>` with proprioception or a video; ids are label-task-episode.

    Arrays are read one episode at a time, videos when their frames are asked for.
    """

    looked_for = "proprio_stats/<task>/<episode>/proprio_stats.h5 or observations/<task>/<episode>/videos/*_color.mp4"

    def __init__(self, config: AgibotWorldSourceConfig, root: AnyPath) -> None:
        require_h5py()
        found = [
            *find_files(root / "proprio_stats", "proprio_stats.h5"),
            *find_files(root / "observations", "*_color.mp4"),
        ]
        named = {relative_name(path, root).parts[1:3] for path in found}
        super().__init__(config, root, [root / task / episode for task, episode in named], lambda folder: folder.parts)
        self._instructions_of = lru_cache(maxsize=1)(self._read_task)  # episodes are read in order of tasks

    def load(self, episode_id: str) -> LoadedEpisode:
        config = self.config
        task, number = self.files[episode_id].parts
        instructions = self._instructions_of(task)
        if number not in instructions:
            where = f"{self.root}, task_info/task_{task}.json"
            raise RejectedInputError(
                "missing_column", "Task information does not name the episode", where=where, expected=number
            )
        videos = {
            view: inside(self.root, f"observations/{task}/{number}/videos/{_CAMERAS[view]}_color.mp4")
            for view in config.views
        }
        faults: list[RejectedInputError] = []
        sizes, absent = sorted_views(videos, lambda view: timed_video_size(videos[view], config.fps), faults)
        if faults:
            raise all_of([*faults, *absent.values()], f"episode {episode_id}")
        fields = _proprioception(inside(self.root, f"proprio_stats/{task}/{number}/proprio_stats.h5"), whole=True)
        length = len(fields["state"])
        cameras = RecordedCameras()
        for view, size in sizes.items():
            _add_camera(cameras, view, self.root, f"parameters/{task}/{number}/parameters/camera", size, length)
        episode = self.episode(
            episode_id,
            f"{config.label}-{task}",
            layout="agibot_world",
            instruction=instructions[number],
            cameras=cameras.tracks,
            primary_view=config.views[0],
            conventions={"tool_offset_m": _TOOL_OFFSET_M, **fields.pop("posture", {}), **cameras.notes()},
            **fields,
        )
        clips = {view: VideoClip.whole_file(videos[view], length, config.fps) for view in sizes}
        return LoadedEpisode(episode, tuple(sizes), clips=clips, absent=absent)

    def _read_task(self, task: str) -> dict[str, str]:
        """Instructions of a task's episodes."""
        listed = read_json(inside(self.root, f"task_info/task_{task}.json"))
        rows = [row for row in listed if isinstance(row, dict)] if isinstance(listed, list) else []
        return {str(row.get("episode_id")): str(row.get("task_name") or "").strip() for row in rows}


class EnerverseAcSource(EpisodeFiles[EnerverseAcSourceConfig]):
    """Reads every folder below the root that holds a file of a clip; videos are decoded when their frames are asked for."""

    looked_for = "folders with one of proprio_stats.h5, action.npy, frame.png, <camera>_color.mp4"

    def __init__(self, config: EnerverseAcSourceConfig, root: AnyPath) -> None:
        names = (
            "proprio_stats.h5",
            "action.npy",
            "frame.png",
            *(f"{camera}_color.mp4" for camera in _CAMERAS.values()),
        )
        found = sorted({path.parent for name in names for path in find_files(root, name)})
        super().__init__(config, root, found, lambda folder: folder.parts or (root.name,))

    def load(self, episode_id: str) -> LoadedEpisode:
        config, relative = self.config, self.files[episode_id]
        folder = inside_folder(self.root, str(relative))
        recorded = is_file(folder / "proprio_stats.h5") or not is_file(folder / "action.npy")
        if recorded:
            fields = _proprioception(folder / "proprio_stats.h5", whole=False)
        else:
            fields = _end_poses(read_npy(folder / "action.npy", (None, 16)), folder / "action.npy")
        length = len(fields["state"])
        videos = {view: folder / f"{_CAMERAS[view]}_color.mp4" for view in config.views}
        picture = folder / "frame.png"
        clips: dict[str, VideoClip] = {}
        if is_file(picture) and not any(map(is_file, videos.values())):
            if len(config.views) != 1:
                raise RejectedInputError(
                    "missing_view",
                    "Clip has a single picture",
                    where=picture,
                    expected="one view in curate.sources[].views",
                    got=", ".join(config.views),
                )
            sizes = {config.views[0]: read_image(picture, calibrated=True).shape[:2]}
        else:
            sizes = {view: timed_video_size(path, config.fps) for view, path in videos.items()}
            clips = {view: VideoClip.whole_file(path, length, config.fps) for view, path in videos.items()}
        cameras = RecordedCameras()
        for view, size in sizes.items():
            if recorded:
                _add_camera(cameras, view, self.root, str(relative), size, length)
                continue
            pose = read_npy(folder / "extrinsics.npy", (4, 4))[None]
            if view != "head" and length > 1:
                raise RejectedInputError(
                    "missing_calibration",
                    "Clip has one pose of a camera that moves",
                    where=f"{folder}, view {view}",
                    expected="the head camera, or proprio_stats.h5 with a pose for each frame",
                    got=f"one pose for {length} states",
                )
            cameras.add(view, read_npy(folder / "intrinsics.npy", (3, 3)), camera_pose(view, pose, where=folder), size)
        clip = _STEP_OF_EPISODE.fullmatch(folder.name)
        task = clip[1] if clip is not None else "-".join(relative.parts[:-1])
        episode = self.episode(
            episode_id,
            "-".join(filter(None, [config.label, task])),
            layout="enerverse_ac",
            cameras=cameras.tracks,
            video_frames=None if clips or length == 1 else 1,
            primary_view=config.views[0],
            conventions={"tool_offset_m": _TOOL_OFFSET_M, **fields.pop("posture", {}), **cameras.notes()},
            **fields,
        )
        return LoadedEpisode(episode, config.views, lambda view: [read_image(picture, calibrated=True)], clips=clips)


class AgibotGesimSource(EpisodeFiles[AgibotGesimSourceConfig]):
    """Reads `sample_*` and `demo_*` folders anywhere below the root."""

    looked_for = "folders with actions.npy (sample_*) or state_joints_0.npy (demo_*)"

    def __init__(self, config: AgibotGesimSourceConfig, root: AnyPath) -> None:
        found = sorted(p.parent for name in ("actions.npy", "state_joints_0.npy") for p in find_files(root, name))
        super().__init__(config, root, found, lambda folder: folder.parts or (root.name,))

    def load(self, episode_id: str) -> LoadedEpisode:
        folder = inside_folder(self.root, str(self.files[episode_id]))
        fields, conventions, images, K, poses = (_demo if is_file(folder / "state_joints_0.npy") else _sample)(folder)
        length = len(fields["state"])
        counts = {view: len(images[view]) for view in VIEWS}
        num_images = counts["head"]
        if len(set(counts.values())) != 1 or num_images > length:
            raise RejectedInputError(
                "length_mismatch",
                "Views differ in the number of images, or have more than there are states",
                where=folder,
                expected=f"at most {length} images",
                got=counts,
            )
        cameras = RecordedCameras()
        for view in VIEWS:
            cameras.add(view, K[view], camera_pose(view, poses[view], where=folder), read_image(images[view][0]).shape)
        episode = self.episode(
            episode_id,
            f"{self.config.label}-{folder.name}",
            cameras=cameras.tracks,
            video_frames=None if num_images == length else num_images,
            conventions=conventions | cameras.notes(),
            **fields,
        )
        return LoadedEpisode(episode, VIEWS, lambda view: map(partial(read_image, calibrated=True), images[view]))


type Bundle = tuple[
    dict[str, Any], dict[str, Any], Mapping[str, list[AnyPath]], Mapping[str, np.ndarray], Mapping[str, np.ndarray]
]
"""Fields of the episode, its conventions, and by view: images, K (3, 3), extrinsics (N, 4, 4)."""


def _sample(folder: AnyPath) -> Bundle:
    rows = read_npy(folder / "actions.npy", (None, 16))
    fields = _end_poses(rows, folder / "actions.npy") | {"layout": "agibot_gesim v1"}
    images: dict[str, list[AnyPath]] = {}
    for view, name in _CAMERAS.items():
        numbered = [path for path in find_files(folder / f"{name}_color", "*.png") if path.stem.isdigit()]
        images[view] = sorted(numbered, key=lambda path: int(path.stem))
        if not numbered:
            raise RejectedInputError("missing_file", "No images 0.png, 1.png, ...", where=folder / f"{name}_color")
    K = {view: read_npy(folder / f"intrinsic_{name}.npy", (3, 3)) for view, name in _CAMERAS.items()}
    poses = {view: read_npy(folder / f"extrinsic_{name}.npy", (len(rows), 4, 4)) for view, name in _CAMERAS.items()}
    return fields, {"tool_offset_m": _TOOL_OFFSET_M}, images, K, poses


def _demo(folder: AnyPath) -> Bundle:
    joints = read_npy(folder / "state_joints_0.npy", (None, 20))
    length = len(joints)
    action = read_npy(folder / "actions_0.npy", (length, 16))
    recorded = read_npy(folder / "state_eef_poses_0.npy", (length, 14))
    ends = [pose_from_euler_fixed_xyz(recorded[:, a : a + 3], recorded[:, a + 3 : a + 6]) for a in (0, 7)]
    opening, overshoot = _GRIPPER_STATE_V2.opening(joints[:, 14:16])
    action[:, [7, 15]], more = _GRIPPER_COMMAND.opening(action[:, [7, 15]])
    task, posture = folder / "task.txt", (name for names in _POSTURE.values() for name in names)
    fields = {
        "layout": "agibot_gesim v2",
        "state": np.hstack([joints[:, :7], opening[:, :1], joints[:, 7:14], opening[:, 1:]]),
        "action": action,
        "overshoot": overshoot + more,
        "instruction": read_text(task).strip() if is_file(task) else "",
        "T_base_ee": along_tool_z(np.stack(ends, axis=1), _TOOL_OFFSET_V2_M),
        "gripper": opening,
        "state_names": _JOINT_NAMES,
    }
    K = read_npy(folder / "intrinsic.npy", (3, 3, 3))
    # Those of the wrists follow the action's kinematics, up to 6 mm from the state's.
    poses = read_npy(folder / "extrinsic_alignstate_0.npy", (3, length, 4, 4))
    images = {view: [folder / name] for view, name in _IMAGES_V2.items()}
    return (
        fields,
        {"tool_offset_m": _TOOL_OFFSET_V2_M, **dict(zip(posture, joints[0, 16:].tolist(), strict=True))},
        images,
        dict(zip(images, K, strict=True)),
        dict(zip(images, poses, strict=True)),
    )


def _end_poses(rows: np.ndarray, where: object) -> dict[str, Any]:
    """Fields of an episode whose state is (N, 16): xyz [m], quaternion xyzw and gripper reading of each arm.

    Raises: RejectedInputError (nan_state) for a quaternion of no length, or numbers that are not finite.
    """
    check_finite("End poses", rows, where)
    with rejected_as("nan_state", where):
        ends = [pose_from_quaternion_xyzw(rows[:, a : a + 3], rows[:, a + 3 : a + 7]) for a in (0, 8)]
    opening, overshoot = _GRIPPER_STATE.opening(rows[:, [7, 15]])
    state = rows.copy()
    state[:, [7, 15]] = opening
    return {
        "state": state,
        "overshoot": overshoot,
        "T_base_ee": along_tool_z(np.stack(ends, axis=1), _TOOL_OFFSET_M),
        "gripper": opening,
        "state_names": _POSE_NAMES,
        "state_kind": "ee_pose",
    }


def _proprioception(path: AnyPath, *, whole: bool) -> dict[str, Any]:
    """Fields of an episode from its `proprio_stats.h5`, and the joints outside of the state as `posture`.

    Args:
        whole: joints, commands and times must be there; otherwise the state is the end poses where they are not.
    """
    with open_hdf5(path) as file:
        positions = file.array("state/end/position", (None, 2, 3))
        length = len(positions)
        quaternions = file.array("state/end/orientation", (length, 2, 4))
        effectors = file.columns(_EFFECTORS, length, "invalid_gripper", "state")
        rows = np.concatenate([positions, quaternions, effectors[..., None]], axis=2)
        fields = _end_poses(rows.reshape(length, 16), path)
        if whole or file.has("timestamp"):
            fields["timestamps"] = file.times_ns("timestamp", length)
        if whole or all(file.has(f"{track}/joint/position") for track in ("state", "action")):
            state = file.arms(_ARMS, _GRIPPER_STATE, track="state", length=length)
            action = file.arms(_ARMS, _GRIPPER_COMMAND, track="action", length=length)
            fields |= {"state": state.values, "action": action.values, "overshoot": state.overshoot + action.overshoot}
            fields |= {"state_names": state.names, "state_kind": "joints"}
        fields["posture"] = {
            name: float(value)
            for part, names in _POSTURE.items()
            if file.has(f"state/{part}/position")
            for name, value in zip(names, file.array(f"state/{part}/position", (length, 2))[0], strict=True)
        }
    return fields


class _Intrinsic(BaseModel):
    model_config = ConfigDict(strict=True)
    fx: float
    fy: float
    ppx: float
    ppy: float


class _IntrinsicFile(BaseModel):
    intrinsic: _Intrinsic


def _add_camera(
    cameras: RecordedCameras, view: str, root: AnyPath, folder: str, size: tuple[int, int], length: int
) -> None:
    """Add a view's camera, whose two files are in a folder below root.

    Recorded distortion coefficients are not applied: whether the published images still have the distortion is not
    documented.

    Args:
        size: (height, width) of the images.
        length: number of states; there is a pose for each, or one for all.
    """
    intrinsic_path = inside(root, f"{folder}/{_CAMERAS[view]}_intrinsic_params.json")
    extrinsic_path = inside(root, f"{folder}/{_CAMERAS[view]}_extrinsic_params_aligned.json")
    read = validated(_IntrinsicFile, read_json(intrinsic_path), intrinsic_path, "File of camera parameters").intrinsic
    if not (0 < read.ppx < size[1] and 0 < read.ppy < size[0]):
        raise RejectedInputError(
            "missing_calibration",
            "Principal point is outside of the image: the calibration is of another image size",
            where=intrinsic_path,
            expected=f"inside of {size[1]}x{size[0]}",
            got=(read.ppx, read.ppy),
        )
    listed = read_json(extrinsic_path)
    if not isinstance(listed, list) or len(listed) not in (1, length):
        raise RejectedInputError(
            "length_mismatch",
            "Extrinsics and states differ in length",
            where=extrinsic_path,
            expected=f"a list of {length} (or 1)",
            got=len(listed) if isinstance(listed, list) else type(listed).__name__,
        )
    poses = np.tile(np.eye(4), (len(listed), 1, 1))
    try:
        poses[:, :3, :3] = [item["extrinsic"]["rotation_matrix"] for item in listed]
        poses[:, :3, 3] = [item["extrinsic"]["translation_vector"] for item in listed]
    except (KeyError, TypeError, ValueError) as error:
        raise RejectedInputError(
            "invalid_extrinsics" if isinstance(error, ValueError) else "missing_column",
            "Extrinsics lack a field, or have a wrong shape",
            where=extrinsic_path,
            expected="extrinsic.rotation_matrix (3, 3) and extrinsic.translation_vector (3,) in each entry",
            got=repr(error),
        ) from error
    K = np.array([[read.fx, 0.0, read.ppx], [0.0, read.fy, read.ppy], [0.0, 0.0, 1.0]])
    cameras.add(view, K, camera_pose(view, poses, where=extrinsic_path), size)
