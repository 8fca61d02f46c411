"""AgiBot World bundles of GE-Sim, both layouts.

v1 (`sample_*`): a few frames per view as PNG, tool poses of the state at 30 Hz (xyz, quaternion xyzw, gripper about 35
open .. 120 closed), one K and per-frame extrinsics per view. No commands are published: the action repeats the state.
v2 (`demo_*`): the first frame per view, joints, poses of state and action (xyz, fixed-axes roll pitch yaw), gripper 0
open .. about 119 closed in the state and 0 open .. 1 closed in the action.
Extrinsics are camera-to-base with OpenCV axes in both. The poses are of the arm's end link; the tool centre lies further
along its +z (0.23 m with the hands of v1, 0.15 m with those of v2).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field

from worldline_core.data.episodes.conventions import along_tool_z
from worldline_core.data.episodes.episode import VIEWS, Episode
from worldline_core.data.episodes.recorded_poses import RecordedCameras, camera_pose, rejected_as
from worldline_core.data.episodes.source import (
    EmbodimentName,
    ForeignSourceConfig,
    GripperRange,
    LensConfig,
    LoadedEpisode,
    joint_names,
)
from worldline_core.data.guards.plain_files import read_image, read_npy, read_text
from worldline_core.data.guards.rejection import RejectedInputError, check_finite, check_shape
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside_folder, is_file
from worldline_core.data.sources.episode_files import EpisodeFiles
from worldline_core.geometry.transforms import pose_from_euler_fixed_xyz, pose_from_quaternion_xyzw

AGIBOT_CAMERAS = {"head": "head", "left_wrist": "hand_left", "right_wrist": "hand_right"}
"""View -> AgiBot's name of the camera, in file names of every layout."""
AGIBOT_STATE_NAMES = joint_names({"left": 7, "right": 7})
GRIPPER_STATE_RAW = GripperRange(closed=120.0, open=35.0)
"""Readings of AgiBot World's `state/effector/position`, checked on images."""
GRIPPER_COMMAND_RAW = GripperRange(closed=1.0, open=0.0)
TOOL_OFFSET_RAW_M = 0.23
"""From the arm's end link to between the fingertips of AgiBot World's hands, along +z."""

_IMAGE_V2 = {"head": "cur_head.png", "left_wrist": "cur_left.png", "right_wrist": "cur_right.png"}
_POSTURE_V2 = ("head_yaw", "head_pitch", "waist_pitch", "waist_lift")
AGIBOT_POSE_NAMES = tuple(
    f"{arm}/{name}" for arm in ("left", "right") for name in ("x", "y", "z", "qx", "qy", "qz", "qw", "gripper")
)


class AgibotGesimSourceConfig(ForeignSourceConfig):
    """The files state no rate, so it is declared here (AgiBot World records 30 Hz)."""

    kind: Literal["agibot_gesim"] = "agibot_gesim"
    fps: float = Field(gt=0)
    embodiment: EmbodimentName = "agibot_g1"
    gripper_v1: GripperRange = GRIPPER_STATE_RAW
    gripper_v2: GripperRange = GripperRange(closed=119.0, open=0.2)
    tool_offset_v1_m: float = TOOL_OFFSET_RAW_M
    tool_offset_v2_m: float = 0.15
    distortions: dict[str, LensConfig] = Field(default={}, description="view -> lens, where images are distorted")


class AgibotGesimSource(EpisodeFiles[AgibotGesimSourceConfig]):
    """Reads `sample_*` and `demo_*` folders anywhere below the root."""

    looked_for = "folders with actions.npy (sample_*) or state_joints_0.npy (demo_*)"

    def __init__(self, config: AgibotGesimSourceConfig, root: AnyPath) -> None:
        found = sorted(p.parent for name in ("actions.npy", "state_joints_0.npy") for p in find_files(root, name))
        super().__init__(config, root, found, lambda folder: folder.parts or (root.name,))

    def load(self, episode_id: str) -> LoadedEpisode:
        folder = inside_folder(self.root, str(self.files[episode_id]))
        read = self._read_v2 if is_file(folder / "state_joints_0.npy") else self._read_v1
        return read(episode_id, folder)

    def _read_v1(self, episode_id: str, folder: AnyPath) -> LoadedEpisode:
        raw = numbers(folder / "actions.npy", (None, 16))
        state, ends, overshoot = pose_state(raw, self.config.gripper_v1, folder / "actions.npy")
        images = {view: _numbered_images(folder / f"{name}_color") for view, name in AGIBOT_CAMERAS.items()}
        counts = {view: len(files) for view, files in images.items()}
        if len(set(counts.values())) != 1:
            raise RejectedInputError(
                "length_mismatch", "Views differ in the number of images", where=folder, got=counts
            )
        K = {view: numbers(folder / f"intrinsic_{name}.npy", (3, 3)) for view, name in AGIBOT_CAMERAS.items()}
        poses = {
            view: numbers(folder / f"extrinsic_{name}.npy", (len(raw), 4, 4)) for view, name in AGIBOT_CAMERAS.items()
        }
        offset = self.config.tool_offset_v1_m
        episode = self.episode(
            episode_id,
            f"{self.config.label}-{folder.name}",
            layout="agibot_gesim v1",
            state=state,
            overshoot=overshoot,
            T_base_ee=along_tool_z(ends, offset),
            gripper=state[:, [7, 15]],
            state_names=AGIBOT_POSE_NAMES,
            state_kind="ee_pose",
            conventions={"tool_offset_m": offset},
        )
        return self._loaded(episode, folder, images, K, poses)

    def _read_v2(self, episode_id: str, folder: AnyPath) -> LoadedEpisode:
        joints = numbers(folder / "state_joints_0.npy", (None, 20))
        num_frames = len(joints)
        action = numbers(folder / "actions_0.npy", (num_frames, 16))
        recorded = numbers(folder / "state_eef_poses_0.npy", (num_frames, 14))
        ends = np.stack(
            [pose_from_euler_fixed_xyz(recorded[:, a : a + 3], recorded[:, a + 3 : a + 6]) for a in (0, 7)], axis=1
        )
        opening, overshoot = self.config.gripper_v2.opening(joints[:, 14:16])
        action[:, [7, 15]], more = GRIPPER_COMMAND_RAW.opening(action[:, [7, 15]])
        state = np.hstack([joints[:, :7], opening[:, :1], joints[:, 7:14], opening[:, 1:]])
        task, offset = folder / "task.txt", self.config.tool_offset_v2_m
        episode = self.episode(
            episode_id,
            f"{self.config.label}-{folder.name}",
            layout="agibot_gesim v2",
            state=state,
            action=action,
            overshoot=overshoot + more,
            instruction=read_text(task).strip() if is_file(task) else "",
            T_base_ee=along_tool_z(ends, offset),
            gripper=opening,
            state_names=AGIBOT_STATE_NAMES,
            conventions={
                "tool_offset_m": offset,
                "wrist_extrinsics": "follow the action's kinematics, up to 6 mm from the state's",
                **{name: float(joints[0, 16 + i]) for i, name in enumerate(_POSTURE_V2)},
            },
        )
        images = {view: [folder / name] for view, name in _IMAGE_V2.items()}
        K = numbers(folder / "intrinsic.npy", (3, 3, 3))
        poses = numbers(folder / "extrinsic_alignstate_0.npy", (3, num_frames, 4, 4))
        return self._loaded(
            episode, folder, images, dict(zip(VIEWS, K, strict=True)), dict(zip(VIEWS, poses, strict=True))
        )

    def _loaded(
        self,
        episode: Episode,
        folder: AnyPath,
        images: Mapping[str, Sequence[AnyPath]],
        K: Mapping[str, np.ndarray],
        poses: Mapping[str, np.ndarray],
    ) -> LoadedEpisode:
        """With cameras, and images of the first frames or of all."""
        num_images = len(images["head"])
        if num_images > episode.num_frames:
            raise RejectedInputError(
                "length_mismatch",
                "More images than states",
                where=folder,
                expected=f"at most {episode.num_frames} images",
                got=num_images,
            )
        cameras = RecordedCameras()
        for view in VIEWS:
            pose = camera_pose(view, poses[view], extrinsics="camera_to_base", axes="opencv", where=folder)
            cameras.add(view, K[view], pose, read_image(images[view][0]).shape)
        episode = replace(
            episode,
            cameras=cameras.tracks,
            video_frames=None if num_images == episode.num_frames else num_images,
            conventions={**episode.conventions, **cameras.notes()},
        )
        lenses = {view: lens.distortion for view, lens in self.config.distortions.items()}
        return LoadedEpisode(episode, VIEWS, lambda view: map(read_image, images[view]), distortions=lenses)


def pose_state(raw: np.ndarray, gripper: GripperRange, where: object) -> tuple[np.ndarray, np.ndarray, int]:
    """The state of rows (N, 16) of xyz [m], quaternion xyzw and gripper reading of each arm, as AgiBot's tools write them.

    Returns: the state with openings for the readings; poses (N, 2, 4, 4) of the end links; how many readings were clipped.

    Raises: RejectedInputError (nan_state) for a quaternion of no length, or numbers that are not finite.
    """
    check_finite("End poses", raw, where)
    with rejected_as("nan_state", where):
        ends = [pose_from_quaternion_xyzw(raw[:, a : a + 3], raw[:, a + 3 : a + 7]) for a in (0, 8)]
    state = raw.copy()
    state[:, [7, 15]], overshoot = gripper.opening(raw[:, [7, 15]])
    return state, np.stack(ends, axis=1), overshoot


def numbers(path: AnyPath, shape: tuple[int | None, ...]) -> np.ndarray:
    """float64 array of a .npy file, of a wanted shape; None for any size but 0.

    Raises: RejectedInputError: length_mismatch, and as `read_npy`.
    """
    values = read_npy(path)
    if values.dtype.kind not in "fiu":
        raise RejectedInputError("unreadable", "Array is not numeric", where=path, expected="numbers", got=values.dtype)
    check_shape("Array", path, values.shape, shape)
    return values.astype(np.float64)


def _numbered_images(folder: AnyPath) -> list[AnyPath]:
    files = sorted((p for p in find_files(folder, "*.png") if p.stem.isdigit()), key=lambda p: int(p.stem))
    if not files:
        raise RejectedInputError("missing_file", "No images", where=folder, expected="0.png, 1.png, ...", got="none")
    return files
