"""Measured signals of an episode that the detectors look at: tool poses, speeds, small grey images, image change."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from worldline_core.data.episode import Episode
from worldline_core.errors import DataError, UnavailableError

GRAY_WIDTH = 96


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
        gray: by view, uint8 (n, h, w), GRAY_WIDTH wide. change: by view, (n,) mean absolute change, of 255.
        joint_speed, gripper_speed: (n,) fastest joint [rad/s] and gripper [1/s], frame i against i - 1.
        joints: (n, j) joint positions [rad], without grippers; None for pose recordings.
        T_base_tool: (n, a, 4, 4), or None where neither poses nor kinematics are known. arms: its a arms.
    """

    episode: Episode
    gray: Mapping[str, np.ndarray]
    change: Mapping[str, np.ndarray]
    joint_speed: np.ndarray
    gripper_speed: np.ndarray
    joints: np.ndarray | None
    T_base_tool: np.ndarray | None
    arms: tuple[ArmModel, ...]

    def travel(self, arms: tuple[int, ...]) -> np.ndarray:
        """(n,) largest tool travel [m] of some arms, frame i against i - 1; zeros where tools are unknown."""
        if self.T_base_tool is None or not arms:
            return np.zeros(len(self.joint_speed))
        position = self.T_base_tool[:, list(arms)][..., :3, 3]
        steps = np.linalg.norm(np.diff(position, axis=0), axis=-1).max(axis=1)
        return np.concatenate([[0.0], steps])


def measure(episode: Episode, frames: Mapping[str, np.ndarray]) -> Signals:
    """Signals of an episode from its images (by view, uint8 (n, H, W, 3))."""
    num_frames = min(episode.num_video_frames, *(len(images) for images in frames.values()))
    gray = {view: _gray(images[:num_frames]) for view, images in frames.items()}
    joint_columns, gripper_columns = _columns(episode)
    state = episode.state[:num_frames].astype(np.float64)
    tools, arms = tool_poses(episode)
    return Signals(
        episode,
        gray,
        {view: _change(images) for view, images in gray.items()},
        _speed(state[:, joint_columns], episode.fps),
        _speed(state[:, gripper_columns], episode.fps),
        state[:, joint_columns] if episode.state_kind == "joints" else None,
        None if tools is None else tools[:num_frames],
        arms,
    )


def _gray(images: np.ndarray) -> np.ndarray:
    height = max(2, round(images.shape[1] * GRAY_WIDTH / images.shape[2]))
    small = [
        cv2.resize(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), (GRAY_WIDTH, height), interpolation=cv2.INTER_AREA)
        for i in images
    ]
    return np.stack(small)


def _change(gray: np.ndarray) -> np.ndarray:
    value = gray.astype(np.float32)
    return np.concatenate([[0.0], np.abs(np.diff(value, axis=0)).mean(axis=(1, 2))])


def _speed(values: np.ndarray, fps: float) -> np.ndarray:
    if values.shape[1] == 0 or len(values) < 2:
        return np.zeros(len(values))
    steps = np.abs(np.diff(values, axis=0)).max(axis=1) * fps
    return np.concatenate([[steps[0]], steps])


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
