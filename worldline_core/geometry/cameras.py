"""Pinhole cameras.

Camera frame: OpenCV (x right, y down, z forward), metres. `T_base_camera` maps camera points to base.
Pixels: the *centre* of the top left pixel is (0, 0), so the image covers -0.5 <= u < width - 0.5, likewise v. Under
this convention a resize by s maps u to (u + 0.5) s - 0.5, and K follows it exactly (`image_transforms`): to resize
and then project is to project and then resize. Distorted lenses are undistorted on ingest (`undistortion`).

Camera poses that say their convention: the only way to make one is to name what the recorded matrices map and mean.

Axes: `opencv` is x right, y down, z forward; `opengl` (also Blender, MuJoCo, USD) is x right, y up, z backward.

Changes of an image's pixel grid, and what they do to pixels and to K: resize, crop, pad, and what is made of them.

A pixel's *centre* lies at whole numbers (the convention of `cameras`), so every change is an affine map of pixels,
u' = s u + t, and the camera matrix follows it exactly: K' = A K. To transform an image and then project is to project
and then transform. NumPy and OpenCV only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NoReturn

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from worldline_core.errors import CalibrationError, ConfigError, DataError
from worldline_core.geometry.se3 import invert, transform_points
from worldline_core.geometry.transforms import RotationRepair, repair_rotations, rigid_inverse

CameraAxes = Literal["opencv", "opengl"]
_OPENCV_FROM: dict[str, np.ndarray] = {"opencv": np.eye(4), "opengl": np.diag([1.0, -1.0, -1.0, 1.0])}


@dataclass(frozen=True, init=False, eq=False)
class CameraPose:
    """Where a camera is: what a bare (N, 4, 4) array does not say. Made by `from_camera_to_base`, `from_base_to_camera`.

    Attributes:
        T_base_camera: (N, 4, 4) float64, N = 1 for a fixed camera; maps camera points (OpenCV axes, metres) to base.
        repair: rotations that were not orthonormal and were given the nearest rotation, counted.
    """

    T_base_camera: np.ndarray
    repair: RotationRepair

    def __init__(self) -> None:
        raise TypeError("Say what the matrices map: CameraPose.from_camera_to_base or CameraPose.from_base_to_camera")

    @classmethod
    def from_camera_to_base(cls, T_base_camera: np.ndarray, *, axes: CameraAxes, where: object) -> CameraPose:
        """From matrices (N or 1, 4, 4) or (4, 4) that map camera points to base (the camera's pose).

        Raises: CalibrationError when one is not rigid, beyond what `repair_rotations` mends.
        """
        poses, repair = _rigid(T_base_camera, where)
        return cls._of(poses @ _OPENCV_FROM[axes] if axes != "opencv" else poses, repair)

    @classmethod
    def from_base_to_camera(cls, T_camera_base: np.ndarray, *, axes: CameraAxes, where: object) -> CameraPose:
        """From matrices (N or 1, 4, 4) or (4, 4) that map base points to camera (OpenCV's rvec and tvec, COLMAP).

        Raises: CalibrationError when one is not rigid, beyond what `repair_rotations` mends.
        """
        poses, repair = _rigid(T_camera_base, where)
        return cls._of(rigid_inverse(poses) @ _OPENCV_FROM[axes], repair)

    @classmethod
    def _of(cls, T_base_camera: np.ndarray, repair: RotationRepair) -> CameraPose:
        pose = object.__new__(cls)
        object.__setattr__(pose, "T_base_camera", T_base_camera)
        object.__setattr__(pose, "repair", repair)
        return pose

    def __len__(self) -> int:
        return len(self.T_base_camera)

    def __array__(self, *_: object, **__: object) -> NoReturn:
        raise TypeError("A CameraPose is no array: use its T_base_camera (camera to base, OpenCV axes)")


def _rigid(matrices: np.ndarray, where: object) -> tuple[np.ndarray, RotationRepair]:
    poses = np.asarray(matrices, dtype=np.float64)
    poses = poses[None] if poses.ndim == 2 else poses
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) == 0:
        raise CalibrationError(
            "Camera poses have a wrong shape", where=where, expected="(N or 1, 4, 4) or (4, 4)", got=np.shape(matrices)
        )
    return repair_rotations(poses, where)


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
        """What the image covers of the window, zeros elsewhere."""
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
    """A chain of resizes, crops and pads, begun with `of` and built by its own methods; sizes are (height, width).

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
                next_step="use a smaller window, or pad first",
            )
        return self if size == self.image_size else self._then(Window(top, left, size))

    def pad(self, top: int, bottom: int, left: int, right: int) -> ImageTransform:
        """Then add empty rows and columns.

        Raises: ConfigError for a negative number of them.
        """
        if min(top, bottom, left, right) < 0:
            raise ConfigError("Padding is negative", expected="at least 0 each", got=(top, bottom, left, right))
        height, width = self.image_size
        size = (height + top + bottom, width + left + right)
        return self if size == self.image_size else self._then(Window(-top, -left, size))

    def letterbox(self, image_size: tuple[int, int]) -> ImageTransform:
        """Then fit whole into the size, the rest evenly padded; the aspect ratio changes by rounding to pixels only."""
        wanted = _whole(image_size)
        scale = min(wanted[0] / self.image_size[0], wanted[1] / self.image_size[1])
        height, width = (min(max(round(n * scale), 1), limit) for n, limit in zip(self.image_size, wanted, strict=True))
        below, beside = wanted[0] - height, wanted[1] - width
        inner = self.resize((height, width))
        return inner.pad(below // 2, below - below // 2, beside // 2, beside - beside // 2)

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
        """Where pixels (..., 2) of the source image lie in the result."""
        affine = self.affine
        return uv * np.diagonal(affine)[:2] + affine[:2, 2]

    def frames(self, frames: np.ndarray) -> np.ndarray:
        """uint8 (N, H, W, 3) transformed; padding is black.

        Raises: DataError for images of another size than the transform is for.
        """
        return self._apply(frames, lambda frame: frame)

    def masks(self, masks: np.ndarray) -> np.ndarray:
        """bool (N, H, W) transformed: True where at least half of a pixel's area was; padding is False.

        Raises: DataError for masks of another size than the transform is for.
        """
        if all(isinstance(step, Window) for step in self.steps):
            return self._apply(masks, lambda mask: mask)
        return self._apply(masks, lambda mask: mask.astype(np.float32)) >= 0.5

    def _apply(self, images: np.ndarray, prepare: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
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
            result = prepare(image)
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


MIN_DEPTH_M = 0.01
"""A point nearer to the camera plane than this counts as behind the camera."""


def project(
    points_base: Float[Tensor, "*#b 3"], K: Float[Tensor, "*#b 3 3"], T_base_camera: Float[Tensor, "*#b 4 4"]
) -> tuple[Float[Tensor, "*#b 2"], Float[Tensor, "*#b"]]:
    """Pixels uv and depth [m] of base points; leading axes broadcast.

    A point on or behind the camera plane has a meaningless uv (finite, never NaN); look at its depth.
    """
    in_camera = transform_points(invert(T_base_camera), points_base)
    depth = in_camera[..., 2]
    divisor = torch.where(depth.abs() < 1e-9, torch.full_like(depth, 1e-9), depth)
    uv = (K[..., :2, :] @ (in_camera / divisor[..., None])[..., None])[..., 0]
    return uv, depth


def unproject(
    uv: Float[Tensor, "*#b 2"],
    depth: Float[Tensor, "*#b"],
    K: Float[Tensor, "*#b 3 3"],
    T_base_camera: Float[Tensor, "*#b 4 4"],
) -> Float[Tensor, "*#b 3"]:
    """Base points at these pixels and depths: the inverse of `project`."""
    homogeneous = torch.cat([uv, torch.ones_like(uv[..., :1])], dim=-1)
    ray = torch.linalg.solve(K, homogeneous[..., None].to(K.dtype))[..., 0]
    return transform_points(T_base_camera, ray * depth[..., None])


def inside_image(uv: Float[Tensor, "*b 2"], image_size: tuple[int, int]) -> Bool[Tensor, "*b"]:
    """Whether uv falls on a pixel of an image of (height, width)."""
    height, width = image_size
    u, v = uv.unbind(-1)
    return (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)


def transform_intrinsics(K: Float[Tensor, "*b 3 3"], transform: ImageTransform) -> Float[Tensor, "*b 3 3"]:
    """K after the image is resized, cropped, padded or letterboxed."""
    return torch.as_tensor(transform.affine, dtype=K.dtype, device=K.device) @ K


def valid_intrinsics(K: Float[Tensor, "*b 3 3"]) -> Bool[Tensor, "*b"]:
    """Finite, invertible, last row 0 0 1, positive focal lengths."""
    last_row = torch.tensor([0.0, 0.0, 1.0], dtype=K.dtype, device=K.device)
    finite = torch.isfinite(K).all(-1).all(-1)
    upper = (K[..., 0, 0] > 1e-6) & (K[..., 1, 1] > 1e-6) & (K[..., 1, 0].abs() < 1e-6)
    return finite & upper & ((K[..., 2, :] - last_row).abs() <= 1e-6).all(-1)


def check_intrinsics(K: Float[Tensor, "*b 3 3"], where: object) -> None:
    """Raises: CalibrationError when a camera matrix is singular or no pinhole camera."""
    good = valid_intrinsics(K)
    if not bool(good.all()):
        bad = K.reshape(-1, 3, 3)[~good.reshape(-1)]
        raise CalibrationError(
            "Camera matrix is singular or not that of a pinhole camera",
            where=where,
            expected="[[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0, all finite",
            got=bad[0].tolist(),
            next_step="check the order of the values (row major) and their units (pixels)",
        )
