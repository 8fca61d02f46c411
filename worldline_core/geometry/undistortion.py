"""Undistortion of a camera's images: the pinhole that replaces the lens, and the pixel maps, made once a camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch

from worldline_core.errors import CalibrationError
from worldline_core.geometry.distortion import Distortion
from worldline_core.geometry.distortion_points import distort_points, undistort_rays

MAX_HALF_ANGLE_DEG = 65.0
"""The pinhole image ends at this angle from the axis to each side: a wider one is mostly stretched border."""


@dataclass(frozen=True, eq=False)
class Undistortion:
    """From a lens to a pinhole at the same image size.

    Attributes:
        K: (3, 3) of the undistorted image, pixels.
        map_u, map_v: float32 (H, W): where each undistorted pixel is found in the distorted image.
    """

    K: np.ndarray
    map_u: np.ndarray
    map_v: np.ndarray

    @property
    def image_size(self) -> tuple[int, int]:
        """(height, width), of the distorted and the undistorted image."""
        return self.map_u.shape[0], self.map_u.shape[1]

    def frames(self, frames: np.ndarray) -> np.ndarray:
        """uint8 (N, H, W, 3) undistorted, linear between pixels."""
        return np.stack([cv2.remap(frame, self.map_u, self.map_v, cv2.INTER_LINEAR) for frame in frames])

    def masks(self, masks: np.ndarray) -> np.ndarray:
        """bool (N, H, W) undistorted: True where the mask covers at least half."""
        values = [cv2.remap(m.astype(np.float32), self.map_u, self.map_v, cv2.INTER_LINEAR) for m in masks]
        return np.stack(values) >= 0.5


def undistortion(distortion: Distortion, K: np.ndarray, image_size: tuple[int, int], where: object) -> Undistortion:
    """Maps and camera matrix for images of (height, width); the same lens is worked out once.

    The new image shows the largest upright rectangle of the view that the recorded pixels fill (OpenCV's alpha = 0), at
    most `MAX_HALF_ANGLE_DEG` to each side, so no pixel of it is invented.

    Raises: CalibrationError when the model cannot be inverted inside of the image.
    """
    distortion.check_inside(K, image_size, where)
    return _undistortion(distortion, tuple(float(v) for v in K.reshape(-1)), image_size)


def undistorted_intrinsics(distortion: Distortion, K: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
    """(3, 3) of the pinhole whose outer pixel centres lie on the largest rectangle inside of the recorded view.

    Raises: CalibrationError when a border pixel has no single ray.
    """
    height, width = image_size
    across, down = np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)
    limit = float(np.tan(np.radians(MAX_HALF_ANGLE_DEG)))

    def border(u: np.ndarray, v: np.ndarray, axis: int) -> np.ndarray:
        """x (axis 0) or y (axis 1) at depth 1 of these pixels; past 90 degrees it is infinite."""
        plane = np.linalg.inv(K) @ np.stack([u, v, np.ones_like(u)])
        rays = undistort_rays(torch.from_numpy(plane[:2].T.copy()), distortion).numpy()
        in_front = rays[:, 2] > 1e-6
        return np.where(in_front, rays[:, axis] / np.where(in_front, rays[:, 2], 1.0), np.inf * np.sign(rays[:, axis]))

    left = max(border(np.zeros_like(down), down, 0).max(), -limit)
    right = min(border(np.full_like(down, width - 1), down, 0).min(), limit)
    top = max(border(across, np.zeros_like(across), 1).max(), -limit)
    bottom = min(border(across, np.full_like(across, height - 1), 1).min(), limit)
    if not (left < right and top < bottom):
        raise CalibrationError(
            "The lens leaves no upright view of the scene",
            expected="borders left < right and top < bottom at depth 1",
            got=f"left {left:.3f}, right {right:.3f}, top {top:.3f}, bottom {bottom:.3f}",
            next_step="check the coefficients, and that K belongs to this image size",
        )
    fx, fy = (width - 1) / (right - left), (height - 1) / (bottom - top)
    return np.array([[fx, 0.0, -left * fx], [0.0, fy, -top * fy], [0.0, 0.0, 1.0]])


@lru_cache(maxsize=64)
def _undistortion(distortion: Distortion, K_flat: tuple[float, ...], image_size: tuple[int, int]) -> Undistortion:
    K = np.array(K_flat).reshape(3, 3)
    new_K = undistorted_intrinsics(distortion, K, image_size)
    height, width = image_size
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    plane = np.stack([(u - new_K[0, 2]) / new_K[0, 0], (v - new_K[1, 2]) / new_K[1, 1]], axis=-1)
    distorted = distort_points(torch.from_numpy(plane), distortion).numpy()
    pixels = distorted @ K[:2, :2].T + K[:2, 2]
    return Undistortion(new_K, pixels[..., 0].astype(np.float32), pixels[..., 1].astype(np.float32))
