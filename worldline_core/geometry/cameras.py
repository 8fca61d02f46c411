"""Pinhole cameras, and what becomes of K when an image is resized, cropped or padded.

Camera frame: OpenCV (x right, y down, z forward), metres. `T_base_camera` maps camera points to base.
Pixels: the *centre* of the top left pixel is (0, 0), so the image covers -0.5 <= u < width - 0.5, likewise v. Every
change of the pixel grid is an affine map of pixels, u' = s u + t, and the camera matrix follows it exactly, K' = A K.
Distorted lenses are undistorted when recordings are read (`lens`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
import numpy.typing as npt

from worldline_core.errors import CalibrationError, ConfigError, DataError
from worldline_core.geometry.transforms import RotationRepair, repair_rotations, rigid_inverse

if TYPE_CHECKING:
    from torch import Tensor

MIN_DEPTH_M = 0.01
"""A point nearer to the camera plane than this counts as behind the camera."""


def project_points(points: np.ndarray, K: np.ndarray, T_base_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) and depth (n,) [m] of base points (n, 3) in cameras (n or 1, 4, 4) with one K (3, 3).

    A point on or behind the camera plane has a meaningless pixel (finite, never NaN); look at its depth. End-effectors
    of action maps are projected with gradients, by `actions.action_tracks`.
    """
    T_camera_base = rigid_inverse(T_base_camera)
    in_camera = (T_camera_base[:, :3, :3] @ points[:, :, None])[:, :, 0] + T_camera_base[:, :3, 3]
    depth = in_camera[:, 2]
    divisor = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    return ((in_camera / divisor[:, None]) @ K.T)[:, :2], depth


def inside_image[Array: (np.ndarray, Tensor)](uv: Array, image_size: tuple[int, int]) -> Array:
    """Bool (...): whether uv (..., 2) falls on a pixel of an image of (height, width)."""
    height, width = image_size
    u, v = uv[..., 0], uv[..., 1]
    return (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)


CameraAxes = Literal["opencv", "opengl"]
"""`opencv` is x right, y down, z forward; `opengl` (also Blender, MuJoCo, USD) is x right, y up, z backward."""
OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
Extrinsics = Literal["camera_to_base", "base_to_camera"]
Fit = Literal["stretch", "letterbox", "crop"]


@dataclass(frozen=True, eq=False)
class CameraPose:
    """Pose of a camera, made by `of` from matrices that state their convention.

    Attributes:
        T_base_camera: (N, 4, 4) float64, N = 1 for a fixed camera; maps camera points (OpenCV axes, metres) to base.
        repair: rotations that were not orthonormal and were given the nearest rotation, counted.
    """

    T_base_camera: np.ndarray
    repair: RotationRepair

    @classmethod
    def of(cls, matrices: np.ndarray, *, extrinsics: Extrinsics, axes: CameraAxes, where: object) -> CameraPose:
        """Pose from matrices (N or 1, 4, 4) or (4, 4), which map camera points to base or (OpenCV's rvec and tvec) base to camera.

        Raises: CalibrationError when one is not rigid, beyond what `repair_rotations` mends.
        """
        poses = np.asarray(matrices, dtype=np.float64)
        poses = poses[None] if poses.ndim == 2 else poses
        if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) == 0:
            raise CalibrationError(
                "Camera poses have a wrong shape",
                where=where,
                expected="(N or 1, 4, 4) or (4, 4)",
                got=np.shape(matrices),
            )
        poses, repair = repair_rotations(poses, where)
        if extrinsics == "base_to_camera":
            poses = rigid_inverse(poses)
        return cls(poses if axes == "opencv" else poses @ OPENGL_AXES, repair)


@dataclass(frozen=True)
class Resize:
    """To (height, width) pixels; the aspect ratio may change."""

    from_size: tuple[int, int]
    to_size: tuple[int, int]

    @property
    def affine(self) -> np.ndarray:
        """(3, 3): u' = (u + 1/2) s - 1/2."""
        sv, su = (to / size for to, size in zip(self.to_size, self.from_size, strict=True))
        return np.array([[su, 0.0, (su - 1) / 2], [0.0, sv, (sv - 1) / 2], [0.0, 0.0, 1.0]])

    def apply(self, image: np.ndarray) -> np.ndarray:
        """Area averages when shrinking, linear when enlarging."""
        height, width = self.to_size
        shrinking = height <= self.from_size[0] and width <= self.from_size[1]
        return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR)


@dataclass(frozen=True)
class Window:
    """The window of `to_size` whose first pixel is (row `top`, column `left`): a crop inside, padding outside."""

    top: int
    left: int
    to_size: tuple[int, int]

    @property
    def affine(self) -> np.ndarray:
        """(3, 3): u' = u - left."""
        return np.array([[1.0, 0.0, -self.left], [0.0, 1.0, -self.top], [0.0, 0.0, 1.0]])

    def apply(self, image: np.ndarray) -> np.ndarray:
        """Returns the part of the image inside the window, zeros elsewhere."""
        height, width = self.to_size
        result = np.zeros((height, width, *image.shape[2:]), dtype=image.dtype)
        rows = slice(max(self.top, 0), min(self.top + height, image.shape[0]))
        columns = slice(max(self.left, 0), min(self.left + width, image.shape[1]))
        if rows.start < rows.stop and columns.start < columns.stop:
            target = result[rows.start - self.top : rows.stop - self.top]
            target[:, columns.start - self.left : columns.stop - self.left] = image[rows, columns]
        return result


@dataclass(frozen=True)
class ImageTransform:
    """A chain of resizes, crops and letterboxes, begun with `of` and built by its own methods; sizes are (height, width).

    >>> ImageTransform.of((480, 640)).letterbox((256, 256)).image_size
    (256, 256)
    """

    source_size: tuple[int, int]
    steps: tuple[Resize | Window, ...] = ()

    @classmethod
    def of(cls, image_size: tuple[int, int]) -> ImageTransform:
        """The transform that leaves images of this size as they are.

        Raises: ConfigError for a size without pixels.
        """
        height, width = _whole(image_size)
        return cls((height, width))

    @property
    def image_size(self) -> tuple[int, int]:
        """(height, width) after the last step."""
        return self.steps[-1].to_size if self.steps else self.source_size

    @property
    def affine(self) -> np.ndarray:
        """(3, 3) float64: maps homogeneous pixels of the source image to those of the result."""
        result = np.eye(3)
        for step in self.steps:
            result = step.affine @ result
        return result

    def fitted(self, image_size: tuple[int, int] | None, fit: Fit = "stretch") -> ImageTransform:
        """Then bring to a size: stretched, whole with black bars, or filled and cut at the sides. None changes nothing."""
        if image_size is None:
            return self
        match fit:
            case "stretch":
                return self.resize(image_size)
            case "letterbox":
                return self.letterbox(image_size)
            case "crop":
                return self.centre_crop(image_size)

    def resize(self, image_size: tuple[int, int]) -> ImageTransform:
        """Then resize; the aspect ratio may change."""
        size = _whole(image_size)
        return self if size == self.image_size else self._then(Resize(self.image_size, size))

    def crop(self, top: int, left: int, image_size: tuple[int, int]) -> ImageTransform:
        """Then keep the window that begins at (top, left).

        Raises: ConfigError when it leaves the image.
        """
        size = _whole(image_size)
        if min(top, left) < 0 or top + size[0] > self.image_size[0] or left + size[1] > self.image_size[1]:
            raise ConfigError(
                "Crop leaves the image",
                expected=f"a window inside {self.image_size}",
                got=f"{size} at row {top}, column {left}",
                next_step="use a smaller window",
            )
        return self if size == self.image_size else self._then(Window(top, left, size))

    def letterbox(self, image_size: tuple[int, int]) -> ImageTransform:
        """Then fit whole into the size, the rest evenly padded; the aspect ratio changes by rounding to pixels only."""
        wanted = _whole(image_size)
        scale = min(wanted[0] / self.image_size[0], wanted[1] / self.image_size[1])
        height, width = (min(max(round(n * scale), 1), limit) for n, limit in zip(self.image_size, wanted, strict=True))
        inner, above, beside = self.resize((height, width)), (wanted[0] - height) // 2, (wanted[1] - width) // 2
        return inner if inner.image_size == wanted else inner._then(Window(-above, -beside, wanted))

    def centre_crop(self, image_size: tuple[int, int]) -> ImageTransform:
        """Then fill the size: resized until both sides reach, the rest cut away evenly."""
        wanted = _whole(image_size)
        scale = max(wanted[0] / self.image_size[0], wanted[1] / self.image_size[1])
        height, width = (max(round(n * scale), limit) for n, limit in zip(self.image_size, wanted, strict=True))
        return self.resize((height, width)).crop((height - wanted[0]) // 2, (width - wanted[1]) // 2, wanted)

    def intrinsics(self, K: np.ndarray) -> np.ndarray:
        """K (..., 3, 3) of the transformed image."""
        return self.affine @ K

    def pixels(self, uv: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of the source image in the coordinates of the result."""
        affine = self.affine
        return uv * np.diagonal(affine)[:2] + affine[:2, 2]

    def frames(self, frames: np.ndarray) -> np.ndarray:
        """uint8 (N, H, W, 3) transformed; padding is black.

        Raises: DataError for images of another size than the transform is for.
        """
        return self._apply(frames, frames.dtype)

    def masks(self, masks: np.ndarray) -> np.ndarray:
        """bool (N, H, W) transformed: True where at least half of a pixel's area was; padding is False.

        Raises: DataError for masks of another size than the transform is for.
        """
        return self._apply(masks, np.float32) >= 0.5

    def labels(self, labels: np.ndarray) -> np.ndarray:
        """uint8 (N, H, W) transformed: the label that at least half of a pixel's area had, else 0.

        Raises: DataError for labels of another size than the transform is for.
        """
        transformed = np.zeros((len(labels), *self.image_size), np.uint8)
        for label in np.unique(labels[labels > 0]):
            transformed[self.masks(labels == label)] = label
        return transformed

    def _apply(self, images: np.ndarray, dtype: npt.DTypeLike) -> np.ndarray:
        if tuple(images.shape[1:3]) != self.source_size:
            raise DataError(
                "Images have another size than the transform is for",
                expected=self.source_size,
                got=tuple(images.shape[1:3]),
            )
        if not self.steps:
            return images
        transformed = []
        for image in images:
            result = image.astype(dtype, copy=False)
            for step in self.steps:
                result = step.apply(result)
            transformed.append(result)
        return np.stack(transformed)

    def _then(self, step: Resize | Window) -> ImageTransform:
        return replace(self, steps=(*self.steps, step))


def _whole(image_size: tuple[int, int]) -> tuple[int, int]:
    height, width = image_size
    if height < 1 or width < 1 or int(height) != height or int(width) != width:
        raise ConfigError("Image size has no pixels", expected="whole height and width of at least 1", got=image_size)
    return int(height), int(width)
