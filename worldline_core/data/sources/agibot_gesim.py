"""AgiBot World bundles of GE-Sim, both layouts.

v1 (`sample_*`): some frames a view as PNG, tool poses of the state at 30 Hz (xyz, quaternion xyzw, gripper about 35 open
.. 120 closed), one K and per-frame extrinsics a view. No commands are published: the action repeats the state.
v2 (`demo_*`): the first frame a view, joints, poses of state and action (xyz, fixed-axes roll pitch yaw), gripper 0 open
.. about 119 closed in the state and 0 open .. 1 closed in the action.
Extrinsics are camera-to-base with OpenCV axes in both. The poses are of the arm's end link; the tool centre lies further
along its +z (0.23 m with the hands of v1, 0.15 m with those of v2).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from pydantic import Field

from worldline_core.data.episodes.conventions import along_tool_z
from worldline_core.data.episodes.episode import VIEWS, CameraTrack, Episode
from worldline_core.data.episodes.recorded_poses import camera_pose, rejected_as, repair_notes
from worldline_core.data.episodes.source import ForeignSourceConfig, GripperRange, LensConfig, LoadedEpisode, no_masks
from worldline_core.data.guards.images import read_image
from worldline_core.data.guards.plain_files import read_npy, read_text
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside_folder, is_file, relative_name
from worldline_core.geometry.cameras import CameraPose
from worldline_core.geometry.distortion import Distortion
from worldline_core.geometry.transforms import pose_from_euler_fixed_xyz, pose_from_quaternion_xyzw

AGIBOT_CAMERAS = {"head": "head", "left_wrist": "hand_left", "right_wrist": "hand_right"}
"""View -> AgiBot's name of the camera, in file names of every layout."""
GRIPPER_STATE_RAW = GripperRange(closed=120.0, open=35.0)
"""Readings of AgiBot World's `state/effector/position`, checked on images."""
GRIPPER_COMMAND_RAW = GripperRange(closed=1.0, open=0.0)
TOOL_OFFSET_RAW_M = 0.23
"""From the arm's end link to between the fingertips of AgiBot World's hands, along +z."""

_FOLDER_V1 = {"head": "head_color", "left_wrist": "hand_left_color", "right_wrist": "hand_right_color"}
_IMAGE_V2 = {"head": "cur_head.png", "left_wrist": "cur_left.png", "right_wrist": "cur_right.png"}
_POSTURE_V2 = ("head_yaw", "head_pitch", "waist_pitch", "waist_lift")


class AgibotGesimSourceConfig(ForeignSourceConfig):
    """The files state no rate, so it is declared here (AgiBot World records 30 Hz)."""

    kind: Literal["agibot_gesim"] = "agibot_gesim"
    fps: float = Field(gt=0)
    embodiment: str = "agibot_g1"
    gripper_v1: GripperRange = GRIPPER_STATE_RAW
    gripper_v2: GripperRange = GripperRange(closed=119.0, open=0.2)
    tool_offset_v1_m: float = TOOL_OFFSET_RAW_M
    tool_offset_v2_m: float = 0.15
    distortions: dict[str, LensConfig] = Field(default={}, description="view -> lens, where images are distorted")

    @property
    def lenses(self) -> dict[str, Distortion]:
        return {view: lens.distortion for view, lens in self.distortions.items()}


class AgibotGesimSource:
    """Reads `sample_*` and `demo_*` folders anywhere below the root."""

    def __init__(self, config: AgibotGesimSourceConfig, root: AnyPath) -> None:
        self._config = config
        self._root = root
        found = sorted(p.parent for name in ("actions.npy", "state_joints_0.npy") for p in find_files(root, name))
        self._folders = {"-".join(relative_name(folder, root).parts) or root.name: folder for folder in found}

    def episode_ids(self) -> list[str]:
        return sorted(f"{self._config.label}-{key}" for key in self._folders)

    def load(self, episode_id: str) -> LoadedEpisode:
        found = self._folders[episode_id.removeprefix(f"{self._config.label}-")]
        folder = inside_folder(self._root, str(relative_name(found, self._root)))
        is_v2 = is_file(folder / "state_joints_0.npy")
        return self._load_v2(episode_id, folder) if is_v2 else self._load_v1(episode_id, folder)

    def _common(self, episode_id: str, folder: AnyPath, num_frames: int) -> dict[str, Any]:
        return {
            "episode_id": episode_id,
            "source": self._config.label,
            "embodiment": self._config.embodiment,
            "scene": self._config.scene or f"{self._config.label}-{folder.name}",
            "task_family": self._config.task_family,
            "outcome": self._config.outcome,
            "split": self._config.split,
            "fps": self._config.fps,
            "timestamps": np.arange(num_frames) / self._config.fps,
        }

    def _load_v1(self, episode_id: str, folder: AnyPath) -> LoadedEpisode:
        config = self._config
        raw = _array(folder / "actions.npy", (None, 16))
        opening, overshoot = config.gripper_v1.opening(raw[:, [7, 15]])
        with rejected_as("nan_state", folder / "actions.npy"):
            ends = [pose_from_quaternion_xyzw(raw[:, a : a + 3], raw[:, a + 3 : a + 7]) for a in (0, 8)]
        poses = np.stack(ends, axis=1)
        state = raw.copy()
        state[:, [7, 15]] = opening
        images = {view: _png_folder(folder / name) for view, name in _FOLDER_V1.items()}
        counts = {view: len(files) for view, files in images.items()}
        if len(set(counts.values())) != 1:
            raise RejectedInputError(
                "length_mismatch", "Views differ in the number of images", where=folder, got=counts, evidence=counts
            )
        cameras: dict[str, CameraTrack] = {}
        recorded: dict[str, CameraPose] = {}
        for view, name in AGIBOT_CAMERAS.items():
            height, width = read_image(images[view][0]).shape[:2]
            K = _array(folder / f"intrinsic_{name}.npy", (3, 3)).astype(np.float64)
            track = _array(folder / f"extrinsic_{name}.npy", (len(raw), 4, 4)).astype(np.float64)
            recorded[view] = camera_pose(view, track, extrinsics="camera_to_base", axes="opencv", where=folder)
            cameras[view] = CameraTrack.from_pose(view, K, recorded[view], width=width, height=height)
        episode = Episode(
            **self._common(episode_id, folder, len(raw)),
            instruction="",
            state=state.astype(np.float32),
            action=state.astype(np.float32),
            cameras=cameras,
            T_base_ee=along_tool_z(poses, config.tool_offset_v1_m),
            gripper=opening,
            state_names=tuple(
                f"{arm}/{name}"
                for arm in ("left", "right")
                for name in ("x", "y", "z", "qx", "qy", "qz", "qw", "gripper")
            ),
            state_kind="ee_pose",
            video_frames=_fewer(counts["head"], len(raw), folder),
            conventions={
                "layout": "agibot_gesim v1",
                "action": "repeats the state: no commands are published",
                "tool_offset_m": config.tool_offset_v1_m,
                "gripper_overshoot": overshoot,
                **repair_notes({view: pose.repair for view, pose in recorded.items()}),
            },
        )
        frames: Callable[[str], np.ndarray] = lambda view: np.stack([read_image(path) for path in images[view]])  # noqa: E731
        return LoadedEpisode(episode, VIEWS, frames, no_masks, config.lenses)

    def _load_v2(self, episode_id: str, folder: AnyPath) -> LoadedEpisode:
        config = self._config
        joints = _array(folder / "state_joints_0.npy", (None, 20))
        num_frames = len(joints)
        commands = _array(folder / "actions_0.npy", (num_frames, 16))
        ends = _array(folder / "state_eef_poses_0.npy", (num_frames, 14))
        opening, overshoot = config.gripper_v2.opening(joints[:, 14:16])
        commanded, command_overshoot = GRIPPER_COMMAND_RAW.opening(commands[:, [7, 15]])
        left, right = slice(0, 7), slice(7, 14)
        state = np.concatenate([joints[:, left], opening[:, :1], joints[:, right], opening[:, 1:]], axis=1)
        action = np.concatenate([commands[:, :7], commanded[:, :1], commands[:, 8:15], commanded[:, 1:]], axis=1)
        poses = np.stack(
            [pose_from_euler_fixed_xyz(ends[:, a : a + 3], ends[:, a + 3 : a + 6]) for a in (0, 7)], axis=1
        )
        intrinsics = _array(folder / "intrinsic.npy", (3, 3, 3)).astype(np.float64)
        tracks = _array(folder / "extrinsic_alignstate_0.npy", (3, num_frames, 4, 4)).astype(np.float64)
        cameras: dict[str, CameraTrack] = {}
        recorded: dict[str, CameraPose] = {}
        for index, view in enumerate(VIEWS):
            height, width = read_image(folder / _IMAGE_V2[view]).shape[:2]
            recorded[view] = camera_pose(view, tracks[index], extrinsics="camera_to_base", axes="opencv", where=folder)
            cameras[view] = CameraTrack.from_pose(view, intrinsics[index], recorded[view], width=width, height=height)
        task = folder / "task.txt"
        posture = {name: float(joints[0, 16 + i]) for i, name in enumerate(_POSTURE_V2)}
        names = [f"{arm}/{n}" for arm in ("left", "right") for n in (*(f"joint_{j}" for j in range(1, 8)), "gripper")]
        episode = Episode(
            **self._common(episode_id, folder, num_frames),
            instruction=read_text(task).strip() if is_file(task) else "",
            state=state.astype(np.float32),
            action=action.astype(np.float32),
            cameras=cameras,
            T_base_ee=along_tool_z(poses, config.tool_offset_v2_m),
            gripper=opening,
            state_names=tuple(names),
            video_frames=_fewer(1, num_frames, folder),
            conventions={
                "layout": "agibot_gesim v2",
                "tool_offset_m": config.tool_offset_v2_m,
                "gripper_overshoot": overshoot + command_overshoot,
                "wrist_extrinsics": "follow the action's kinematics, up to 6 mm from the state's",
                **posture,
                **repair_notes({view: pose.repair for view, pose in recorded.items()}),
            },
        )
        first: Callable[[str], np.ndarray] = lambda view: read_image(folder / _IMAGE_V2[view])[None]  # noqa: E731
        return LoadedEpisode(episode, VIEWS, first, no_masks, config.lenses)


def _fewer(images: int, states: int, folder: AnyPath) -> int | None:
    if images > states:
        raise RejectedInputError(
            "length_mismatch",
            "More images than states",
            where=folder,
            expected=f"at most {states} images",
            got=images,
            evidence={"images": images, "states": states},
        )
    return None if images == states else images


def _array(path: AnyPath, shape: tuple[int | None, ...]) -> np.ndarray:
    values = read_npy(path)
    if values.dtype.kind not in "fiu":
        raise RejectedInputError("unreadable", "Array is not numeric", where=path, expected="numbers", got=values.dtype)
    if values.ndim != len(shape) or any(
        want is not None and want != got for want, got in zip(shape, values.shape, strict=True)
    ):
        raise RejectedInputError(
            "length_mismatch",
            "Array has a wrong shape",
            where=path,
            expected=shape,
            got=values.shape,
            evidence={"shape": list(values.shape)},
        )
    return values


def _png_folder(folder: AnyPath) -> list[AnyPath]:
    files = sorted((p for p in find_files(folder, "*.png") if p.stem.isdigit()), key=lambda p: int(p.stem))
    if not files:
        raise RejectedInputError("missing_file", "No images", where=folder, expected="0.png, 1.png, ...", got="none")
    return files
