"""Inputs of the detectors: tool poses and speeds of an episode, its small grey images, and statistics of each image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from worldline_core.calibration.observation import ObservedArm, arms_of
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.video.thumbnails import ViewThumbnails
from worldline_core.errors import UnavailableError
from worldline_core.geometry.embodiment import embodiment_names, load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics

SPEED_WINDOW_S = 0.5
WHITE_LEVEL = 245
"""Luma from which a pixel counts as saturated."""
_FLAT_LEVELS = 2
_COARSE = 4


@dataclass(frozen=True)
class PictureStatistics:
    """All (n,), of small pictures; grey levels are of 255.

    Attributes:
        mean, contrast: mean and standard deviation of the levels. bright_level: their 95th percentile.
        white_share: share of pixels at WHITE_LEVEL or above.
        roughness: 1 minus the correlation of adjacent pixels (the lower of across and down): near 0 for pictures, near 1
            for noise. It does not depend on gain.
        detail: mean squared difference of adjacent pixels, across plus down.
        flat_share: share of rows at the lower edge that have together one grey level, plus those at the upper edge.
        change: mean absolute difference from the picture before (0 for the first).
        coarse_change: the same of pictures reduced by four, in which sensor noise hardly shows.
    """

    mean: np.ndarray
    contrast: np.ndarray
    bright_level: np.ndarray
    white_share: np.ndarray
    roughness: np.ndarray
    detail: np.ndarray
    flat_share: np.ndarray
    change: np.ndarray
    coarse_change: np.ndarray


def picture_statistics(gray: np.ndarray) -> PictureStatistics:
    """Per-frame statistics of grey images uint8 (n, h, w)."""
    count, height, width = gray.shape
    pixels = height * width
    histograms = np.stack([np.bincount(image.reshape(-1), minlength=256) for image in gray]).astype(np.float64)
    levels = np.arange(256)
    mean = histograms @ levels / pixels
    variance = np.maximum(histograms @ levels**2 / pixels - mean**2, 0)
    coarse_size = (max(1, width // _COARSE), max(1, height // _COARSE))
    across, down, change, coarse_change = np.zeros((4, count))
    before = coarse_before = None
    for i, image in enumerate(gray):
        # Sums of whole numbers, rounded: on some machines OpenCV takes a root and squares it again.
        across[i] = round(cv2.norm(image[:, 1:], image[:, :-1], cv2.NORM_L2SQR)) / (height * (width - 1))
        down[i] = round(cv2.norm(image[1:], image[:-1], cv2.NORM_L2SQR)) / ((height - 1) * width)
        coarse = cv2.resize(image.astype(np.float32), coarse_size, interpolation=cv2.INTER_AREA)
        if before is not None and coarse_before is not None:
            change[i] = cv2.norm(image, before, cv2.NORM_L1) / pixels
            coarse_change[i] = cv2.norm(coarse, coarse_before, cv2.NORM_L1) / coarse.size
        before, coarse_before = image, coarse
    low, high = gray.min(axis=2).astype(np.int16), gray.max(axis=2).astype(np.int16)
    return PictureStatistics(
        mean,
        np.sqrt(variance),
        (np.cumsum(histograms, axis=1) < 0.95 * pixels).sum(axis=1).astype(np.float64),
        histograms[:, WHITE_LEVEL:].sum(axis=1) / pixels,
        np.minimum(np.maximum(across, down) / (2 * np.maximum(variance, 1e-3)), 1.0),
        across + down,
        _flat_edge(low, high) + _flat_edge(low[:, ::-1], high[:, ::-1]),
        change,
        coarse_change,
    )


def _flat_edge(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Share of rows, from the last one up, that together span no more than a few levels.

    Args:
        low, high: (n, h) darkest and brightest level of each row.
    """
    lowest = np.minimum.accumulate(low[:, ::-1], axis=1)
    highest = np.maximum.accumulate(high[:, ::-1], axis=1)
    return (highest - lowest <= _FLAT_LEVELS).mean(axis=1)


_METRES_PER_RADIAN = 0.3
"""Motion of an unknown arm's tool per radian of a joint: half the reach of a small arm."""


def range_speed(values: np.ndarray, fps: float) -> np.ndarray:
    """(n,) largest range of a column within SPEED_WINDOW_S around each frame, per second.

    A difference of neighbours would multiply encoder noise by the frame rate.

    Args:
        values: (n, j).
    """
    if values.shape[1] == 0 or len(values) < 2:
        return np.zeros(len(values))
    reach = max(1, round(SPEED_WINDOW_S * fps / 2))
    largest, smallest = (
        window(values, 2 * reach + 1, axis=0, mode="nearest") for window in (maximum_filter1d, minimum_filter1d)
    )
    return (largest - smallest).max(axis=1) * fps / (2 * reach)


@dataclass(frozen=True)
class Signals:
    """Everything about one episode; n counts frames with images.

    Attributes:
        gray: by view, uint8 (n, h, 96). sharpness: by view, (n,) variance of the Laplacian at the images' own size.
        pictures: by view, numbers about gray.
        joint_speed, gripper_speed: (n,) fastest joint [rad/s] and gripper [1/s], by their range within half a second.
        joints: (n, j) joint positions [rad], without grippers; None for pose recordings. commands: the same of the commands,
            None where none are recorded.
        T_base_tool: (n, a, 4, 4), or None where neither poses nor kinematics are known. arms: its a arms.
    """

    episode: Episode
    gray: Mapping[str, np.ndarray]
    sharpness: Mapping[str, np.ndarray]
    pictures: Mapping[str, PictureStatistics]
    joint_speed: np.ndarray
    gripper_speed: np.ndarray
    joints: np.ndarray | None
    commands: np.ndarray | None
    T_base_tool: np.ndarray | None
    arms: tuple[ObservedArm, ...]

    @property
    def primary_view(self) -> str:
        """The view that decides for Stage I: the episode's primary one, or its first where that one has no images."""
        return self.episode.primary_view if self.episode.primary_view in self.gray else next(iter(self.gray))

    @property
    def calibrated_tools(self) -> np.ndarray | None:
        """T_base_tool where there are calibrated cameras to compare the tools with; else None."""
        return self.T_base_tool if self.episode.state_kind != "none" and self.episode.cameras else None

    @property
    def wrist_cameras(self) -> list[tuple[int, CameraTrack]]:
        """(index of the arm, its wrist camera), of the calibrated ones."""
        cameras = self.episode.cameras
        return [(i, cameras[arm.wrist_view]) for i, arm in enumerate(self.arms) if arm.wrist_view in cameras]

    def arms_in(self, view: str) -> tuple[int, ...]:
        """Arms whose motion a view must show: its own for a wrist view, all for any other."""
        own = tuple(i for i, arm in enumerate(self.arms) if arm.wrist_view == view)
        return own or tuple(range(len(self.arms)))

    def tracks(self, arms: tuple[int, ...]) -> np.ndarray:
        """(n, k, 3) positions [m] of the tools of some arms; where tools are unknown, joints stand in for them.

        k is 0 where joints are unknown too.
        """
        count = len(self.joint_speed)
        if self.T_base_tool is not None and arms:
            return self.T_base_tool[:, list(arms)][..., :3, 3]
        if self.joints is None:
            return np.zeros((count, 0, 3))
        return np.concatenate([self.joints[..., None] * _METRES_PER_RADIAN, np.zeros((*self.joints.shape, 2))], axis=-1)


def measure(episode: Episode, thumbnails: Mapping[str, ViewThumbnails]) -> Signals:
    """Signals of an episode from the small images of each view."""
    num_frames = min(episode.num_video_frames, *(len(small) for small in thumbnails.values()))
    gray = {view: small.gray[:num_frames] for view, small in thumbnails.items()}
    names = episode.state_names or ()
    gripper_columns = [i for i, name in enumerate(names) if name.endswith("gripper")]
    joint_columns = [i for i in range(episode.state.shape[1]) if i not in gripper_columns]
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
        episode.action[:num_frames, joint_columns].astype(np.float64)
        if episode.state_kind == "joints" and episode.commanded
        else None,
        None if tools is None else tools[:num_frames],
        arms,
    )


def tool_poses(episode: Episode) -> tuple[np.ndarray | None, tuple[ObservedArm, ...]]:
    """T_base_tool (N, A, 4, 4): as recorded, else from the embodiment's kinematics, else None; and the arms."""
    if episode.T_base_ee is not None:
        return episode.T_base_ee, arms_of(episode, None)
    kinematics = known_kinematics(episode.embodiment) if episode.state_kind == "joints" else None
    if kinematics is None:  # the episode is left out of Stage II as missing_kinematics; the others go on
        return None, ()
    return np.asarray(kinematics.tool_poses(episode.state.astype(np.float64))), arms_of(episode, kinematics)


@lru_cache(maxsize=16)
def known_kinematics(embodiment: str) -> ArmKinematics | None:
    """Kinematics of an embodiment; None where it, or its description, is not here."""
    try:
        return ArmKinematics(load_embodiment(embodiment)) if embodiment in embodiment_names() else None
    except UnavailableError:
        return None
