"""What is measured of an episode before anything is assumed about its conventions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import cv2
import numpy as np

from worldline_core.data.episodes.episode import Episode
from worldline_core.errors import DataError
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import hand_eye_residual

GRAY_WIDTH = 96
CELL_PX = 4
STILL_CHANGE = 4.0
"""Changes below so many grey levels are compression or sensor noise."""
_STEPS_AT_ONCE = 64


@dataclass(frozen=True)
class Arm:
    """One arm; `T_tool_mount` is the place of its wrist camera in the tool frame where the embodiment states it."""

    name: str
    wrist_view: str
    T_tool_mount: np.ndarray | None


@dataclass(frozen=True)
class Motion:
    """Image motion of one view, in cells of CELL_PX pixels; entry i belongs to the step from image i to i + 1.

    Attributes:
        flow: (n - 1, r, c, 2) mean optical flow [px]. change: (n - 1, r, c) mean absolute change, of 255.
        texture: (n - 1, r, c) mean gradient: where there is none, flow is a guess.
    """

    flow: np.ndarray
    change: np.ndarray
    texture: np.ndarray
    agreements: dict[bytes, float] = field(default_factory=dict, repr=False)
    """Of wrist cameras that were compared with it already: most readings leave the camera as it is."""

    @cached_property
    def moves(self) -> bool:
        """Whether anything moves at all."""
        return bool((self.change.max(axis=(1, 2)) > STILL_CHANGE).sum() >= 4)

    @cached_property
    def mean_change(self) -> np.ndarray:
        """(n - 1,) mean change of the picture, of 255."""
        return self.change.mean(axis=(1, 2))


@dataclass(frozen=True)
class Observation:
    """One episode, its small grey images by view (n, h, GRAY_WIDTH), its arms and kinematics."""

    episode: Episode
    gray: Mapping[str, np.ndarray]
    arms: tuple[Arm, ...]
    kinematics: ArmKinematics | None
    _motion: dict[str, Motion] = field(default_factory=dict, repr=False)
    _stands: dict[str, bool] = field(default_factory=dict, repr=False)
    moved_arms: dict[tuple[int, bytes], tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = field(
        default_factory=dict, repr=False
    )
    """Of kinematics and joints that were read already: most readings leave both as they are."""

    def motion(self, view: str) -> Motion:
        """Flow and change of a view; computed once."""
        if view not in self._motion:
            self._motion[view] = _motion(self.gray[view])
        return self._motion[view]

    def stands_still(self, view: str) -> bool:
        """Whether the recording says that a camera does not move (2 cm, 2 degrees; at any unit of length)."""
        if view not in self._stands:
            poses = self.episode.cameras[view].T_base_camera
            _, metres, degrees = hand_eye_residual(np.eye(4)[None].repeat(len(poses), axis=0), poses)
            scale = max(1.0, float(np.linalg.norm(poses[0, :3, 3])))
            self._stands[view] = bool(metres.max() < 0.02 * scale and degrees.max() < 2.0)
        return self._stands[view]

    def with_exchanged_wrists(self) -> Observation | None:
        """The same with the videos of two wrist cameras exchanged; None where there are not two of one size."""
        views = [arm.wrist_view for arm in self.arms]
        if len(views) != 2 or not all(view in self.gray and view in self.episode.cameras for view in views):
            return None
        if self.gray[views[0]].shape != self.gray[views[1]].shape:
            return None
        gray = dict(self.gray) | {one: self.gray[two] for one, two in (views, views[::-1])}
        motion = {view: self.motion(view) for view in self.gray}
        motion |= {one: self.motion(two) for one, two in (views, views[::-1])}
        return replace(self, gray=gray, _motion=motion)

    @property
    def num_images(self) -> int:
        return min((len(images) for images in self.gray.values()), default=0)

    @cached_property
    def posture(self) -> dict[str, float]:
        """Joints outside the state as far as the episode notes them (waist, head)."""
        kinematics = self.kinematics
        return {} if kinematics is None else kinematics.embodiment.noted_posture(self.episode.conventions)


def observe(
    episode: Episode, frames: Mapping[str, Iterable[np.ndarray]], kinematics: ArmKinematics | None
) -> Observation:
    """Measure an episode.

    Args:
        frames: by view, uint8 (H, W, 3) RGB or (h, w) grey, gone through once; resized to GRAY_WIDTH.

    Raises: DataError when images have another shape or the kinematics belong to another number of arms.
    """
    gray = {view: small_gray(images) for view, images in frames.items()}
    return Observation(episode, gray, arms_of(episode, kinematics), kinematics)


def small_gray(images: Iterable[np.ndarray]) -> np.ndarray:
    """uint8 (n, h, GRAY_WIDTH) of RGB (H, W, 3) or grey (H, W) images, one after the other."""
    return np.stack([_small(image) for image in images])


def _small(image: np.ndarray) -> np.ndarray:
    if image.ndim not in (2, 3) or image.dtype != np.uint8 or (image.ndim == 3 and image.shape[2] != 3):
        raise DataError(
            "Images have a wrong shape", expected="uint8 (H, W, 3) or (H, W)", got=f"{image.dtype} {image.shape}"
        )
    gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if image.ndim == 2 and image.shape[1] == GRAY_WIDTH:
        return image
    height = max(2, round(image.shape[0] * GRAY_WIDTH / image.shape[1]))
    return cv2.resize(gray, (GRAY_WIDTH, height), interpolation=cv2.INTER_AREA)


def cell_centres(height: int, width: int) -> np.ndarray:
    """(r, c, 2) pixel coordinates of the cells' centres."""
    rows, columns = np.mgrid[: height // CELL_PX, : width // CELL_PX]
    return np.stack([columns, rows], axis=-1) * float(CELL_PX) + (CELL_PX - 1) / 2


def cell_means(values: np.ndarray) -> np.ndarray:
    """(n, h, w, ...) -> (n, r, c, ...): mean over CELL_PX squares; what is left over at the border is dropped."""
    n, height, width = values.shape[:3]
    r, c = height // CELL_PX, width // CELL_PX
    cut = np.ascontiguousarray(values[:, : r * CELL_PX, : c * CELL_PX], dtype=np.float32)
    # Rows of pixels first: whole rows are added, which is several times as fast as square by square.
    rows = cut.reshape(n, r, CELL_PX, -1).sum(axis=2)
    return rows.reshape(n, r, c, CELL_PX, *values.shape[3:]).sum(axis=3) / np.float32(CELL_PX**2)


def _motion(gray: np.ndarray) -> Motion:
    if len(gray) < 2:
        empty = np.zeros((0, gray.shape[1] // CELL_PX, gray.shape[2] // CELL_PX), dtype=np.float32)
        return Motion(np.zeros((*empty.shape, 2), dtype=np.float32), empty, empty)
    engine = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    engine.setFinestScale(1)
    parts: list[tuple[np.ndarray, ...]] = []
    # Cells alone are kept of an episode: flow of every pixel of some minutes would fill gigabytes.
    for begin in range(0, len(gray) - 1, _STEPS_AT_ONCE):
        part = gray[begin : begin + _STEPS_AT_ONCE + 1]
        value = part.astype(np.float32)
        flow = np.stack([engine.calc(a, b, None) for a, b in pairwise(part)])  # type: ignore[call-overload]
        across = np.abs(np.diff(value[:-1], axis=2, append=value[:-1, :, -1:]))
        down = np.abs(np.diff(value[:-1], axis=1, append=value[:-1, -1:]))
        change = np.abs(np.diff(value, axis=0))
        parts.append((cell_means(flow), cell_means(change), cell_means(np.maximum(across, down))))
    flow, change, texture = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Motion(flow, change, texture)


def arms_of(episode: Episode, kinematics: ArmKinematics | None) -> tuple[Arm, ...]:
    """The arms of the embodiment; without kinematics, those of the recorded tool poses under the usual names.

    Raises: DataError when the recording has another number of arms than the embodiment.
    """
    if kinematics is None:
        count = 0 if episode.T_base_ee is None else episode.T_base_ee.shape[1]
        names = {1: ("right",), 2: ("left", "right")}.get(count, tuple(f"arm_{i}" for i in range(count)))
        return tuple(Arm(name, f"{name}_wrist", None) for name in names)
    arms = []
    for arm in kinematics.embodiment.arms:
        mount, camera = None, arm.wrist_camera
        if camera is not None and camera.link == arm.end_effector_link:
            T_tool_link = np.linalg.inv(arm.T_link_tool.matrix())
            mount = T_tool_link @ np.asarray(camera.T_link_camera, dtype=np.float64)
        arms.append(Arm(arm.name, arm.camera_view, mount))
    if episode.T_base_ee is not None and episode.T_base_ee.shape[1] != len(arms):
        raise DataError(
            "Recorded tool poses and embodiment differ in the number of arms",
            where=f"episode {episode.episode_id}, embodiment {kinematics.embodiment.name}",
            expected=f"{len(arms)} arms",
            got=f"{episode.T_base_ee.shape[1]} tool poses per frame",
        )
    return tuple(arms)
