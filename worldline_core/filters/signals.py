"""Inputs of the detectors: tool poses and speeds of an episode, its small grey images, and statistics of each image.

The statistics take about 0.05 ms per image.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from worldline_core.calibration.observation import Arm, arms_of
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
_BATCH = 16
"""Images whose differences are computed at a time: they stay in the processor's cache."""


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
    histograms = np.stack([np.bincount(image.reshape(-1), minlength=256) for image in gray]).astype(np.float64)
    levels = np.arange(256)
    pixels = height * width
    mean = histograms @ levels / pixels
    variance = np.maximum(histograms @ levels**2 / pixels - mean**2, 0)
    across, down, change = _differences(gray)
    coarse_size = (max(1, width // _COARSE), max(1, height // _COARSE))
    coarse_change = np.zeros(count)
    coarse_before = None
    for i, image in enumerate(gray):
        coarse = cv2.resize(image.astype(np.float32), coarse_size, interpolation=cv2.INTER_AREA)
        if coarse_before is not None:
            coarse_change[i] = cv2.norm(coarse, coarse_before, cv2.NORM_L1) / coarse.size
        coarse_before = coarse
    across, down, change = across / (height * (width - 1)), down / ((height - 1) * width), change / pixels
    low, high = gray.min(axis=2).astype(np.int16), gray.max(axis=2).astype(np.int16)
    cumulative = np.cumsum(histograms, axis=1)
    return PictureStatistics(
        mean,
        np.sqrt(variance),
        (cumulative < 0.95 * pixels).sum(axis=1).astype(np.float64),
        histograms[:, WHITE_LEVEL:].sum(axis=1) / pixels,
        np.minimum(np.maximum(across, down) / (2 * np.maximum(variance, 1e-3)), 1.0),
        across + down,
        _flat_edge(low, high) + _flat_edge(low[:, ::-1], high[:, ::-1]),
        change,
        coarse_change,
    )


def _differences(gray: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For uint8 (n, h, w) three (n,): summed squared differences of adjacent pixels across and down, and summed absolute
    differences from the picture before (0 for the first).

    A row's sum of squares is a whole number below 2^24 (for w <= 258), so float32 holds it exactly in whatever order BLAS
    adds.
    """
    count, height, width = gray.shape
    across, down, change = np.empty(count), np.empty(count), np.zeros(count)
    ones = np.ones(width, dtype=np.float32)

    def row_sums(one: np.ndarray, other: np.ndarray, *, squared: bool) -> np.ndarray:
        difference = cv2.absdiff(one, other).astype(np.float32)
        if squared:
            np.multiply(difference, difference, out=difference)
        return (difference @ ones[: difference.shape[1]]).astype(np.float64)

    for start in range(0, count, _BATCH):
        part = slice(start, start + _BATCH)
        rows = np.ascontiguousarray(gray[part]).reshape(-1, width)
        across[part] = row_sums(rows[:, 1:], rows[:, :-1], squared=True).reshape(-1, height).sum(axis=1)
        # The last row of an image and the first one of the next are not adjacent.
        below = np.append(row_sums(rows[1:], rows[:-1], squared=True), 0.0)
        down[part] = below.reshape(-1, height)[:, :-1].sum(axis=1)
        with_previous = np.ascontiguousarray(gray[max(start - 1, 0) : part.stop]).reshape(-1, width)
        if len(with_previous) > height:
            moved = row_sums(with_previous[height:], with_previous[:-height], squared=False)
            change[max(start, 1) : part.stop] = moved.reshape(-1, height).sum(axis=1)
    return across, down, change


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
    count = len(values)
    if values.shape[1] == 0 or count < 2:
        return np.zeros(count)
    reach = max(1, round(SPEED_WINDOW_S * fps / 2))
    padded = np.pad(values, ((reach, reach), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=0)
    return (windows.max(axis=-1) - windows.min(axis=-1)).max(axis=1) * fps / (2 * reach)


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
    arms: tuple[Arm, ...]

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


def tool_poses(episode: Episode) -> tuple[np.ndarray | None, tuple[Arm, ...]]:
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
