"""Measured signals of an episode that the detectors look at: tool poses, speeds, small grey images, image change."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from worldline_core.data.episodes.episode import Episode
from worldline_core.data.video.thumbnails import ViewThumbnails
from worldline_core.errors import DataError, UnavailableError
from worldline_core.filters.picture_statistics import PictureStatistics, picture_statistics
from worldline_core.filters.static import range_speed

_METRES_A_RADIAN = 0.3
"""How far a tool gets whose arm nobody knows, a radian of a joint: half the reach of a small arm."""


@dataclass(frozen=True)
class ArmModel:
    """One arm as the filters see it. `T_tool_mount` is the wrist camera's place in the tool frame where it is known."""

    name: str
    wrist_view: str
    T_tool_mount: np.ndarray | None = None


@dataclass(frozen=True)
class Signals:
    """Everything about one episode; n counts frames with images.

    Attributes:
        gray: by view, uint8 (n, h, 96). sharpness: by view, (n,) variance of the Laplacian at the images' own size.
        pictures: by view, numbers about gray.
        joint_speed, gripper_speed: (n,) fastest joint [rad/s] and gripper [1/s], by their range within half a second.
        joints: (n, j) joint positions [rad], without grippers; None for pose recordings.
        T_base_tool: (n, a, 4, 4), or None where neither poses nor kinematics are known. arms: its a arms.
    """

    episode: Episode
    gray: Mapping[str, np.ndarray]
    sharpness: Mapping[str, np.ndarray]
    pictures: Mapping[str, PictureStatistics]
    joint_speed: np.ndarray
    gripper_speed: np.ndarray
    joints: np.ndarray | None
    T_base_tool: np.ndarray | None
    arms: tuple[ArmModel, ...]

    def tracks(self, arms: tuple[int, ...]) -> np.ndarray:
        """(n, k, 3) positions [m] of the tools of some arms; where tools are unknown, the joints stand in for them.

        Nothing is known to move where joints are unknown too: k is 0.
        """
        count = len(self.joint_speed)
        if self.T_base_tool is not None and arms:
            return self.T_base_tool[:, list(arms)][..., :3, 3]
        if self.joints is None:
            return np.zeros((count, 0, 3))
        return np.concatenate([self.joints[..., None] * _METRES_A_RADIAN, np.zeros((*self.joints.shape, 2))], axis=-1)


def measure(episode: Episode, thumbnails: Mapping[str, ViewThumbnails]) -> Signals:
    """Signals of an episode from the small images of each view."""
    num_frames = min(episode.num_video_frames, *(len(small) for small in thumbnails.values()))
    gray = {view: small.gray[:num_frames] for view, small in thumbnails.items()}
    joint_columns, gripper_columns = _columns(episode)
    state = episode.state[:num_frames].astype(np.float64)
    tools, arms = tool_poses(episode)
    return Signals(
        episode,
        gray,
        {view: small.sharpness[:num_frames] for view, small in thumbnails.items()},
        {view: picture_statistics(images) for view, images in gray.items()},
        range_speed(state[:, joint_columns], episode.fps),
        range_speed(state[:, gripper_columns], episode.fps),
        state[:, joint_columns] if episode.state_kind == "joints" else None,
        None if tools is None else tools[:num_frames],
        arms,
    )


def _columns(episode: Episode) -> tuple[list[int], list[int]]:
    """State columns of joints and of grippers."""
    names = episode.state_names or ()
    grippers = [i for i, name in enumerate(names) if name.endswith("gripper")]
    return [i for i in range(episode.state.shape[1]) if i not in grippers], grippers


def tool_poses(episode: Episode) -> tuple[np.ndarray | None, tuple[ArmModel, ...]]:
    """T_base_tool (N, A, 4, 4): as recorded, else from the embodiment's kinematics, else None; and the arms."""
    if episode.T_base_ee is not None:
        count = episode.T_base_ee.shape[1]
        names = (
            ("left", "right") if count == 2 else ("right",) if count == 1 else tuple(f"arm_{i}" for i in range(count))
        )
        return episode.T_base_ee, tuple(ArmModel(name, f"{name}_wrist") for name in names)
    from worldline_core.geometry.embodiment import embodiment_names

    if episode.embodiment not in embodiment_names() or episode.state_kind != "joints":
        return None, ()
    try:
        kinematics, arms = _kinematics(episode.embodiment)
    except UnavailableError:  # the episode is left out of Stage II as missing_kinematics; the others go on
        return None, ()
    return np.asarray(kinematics.tool_poses(episode.state.astype(np.float64))), arms


@lru_cache(maxsize=8)
def _kinematics(name: str):
    from worldline_core.geometry.embodiment import load_embodiment
    from worldline_core.geometry.kinematics import ArmKinematics

    embodiment = load_embodiment(name)
    arms = []
    for arm in embodiment.arms:
        mount = None
        if arm.wrist_camera is not None and arm.wrist_camera.link == arm.end_effector_link:
            mount = np.linalg.inv(arm.T_link_tool.matrix()) @ np.asarray(arm.wrist_camera.T_link_camera, np.float64)
        arms.append(ArmModel(arm.name, arm.camera_view, mount))
    if not arms:
        raise DataError("Embodiment has no arms", where=name)
    return ArmKinematics(embodiment), tuple(arms)
