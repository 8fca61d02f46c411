"""Undistortion of a camera's images: the pinhole that replaces the lens, and the pixel maps, made once per camera.

Models and formulas are in `distortion`. Points are (x, y) = (X / Z, Y / Z) in the camera frame, OpenCV axes; pixels are
K (x', y', 1). Points are worked on in torch, batched over leading axes and differentiable.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from worldline_core.errors import CalibrationError
from worldline_core.geometry.distortion import Distortion

_BISECTIONS = 60  # halves a bracket to float64 resolution
_NEWTON_STEPS = 8
_CONVERGED = 1e-9


def distort_points(points: Float[Tensor, "*b 2"], distortion: Distortion) -> Float[Tensor, "*b 2"]:
    """Where rays through these points arrive: (x, y) -> (x', y')."""
    if distortion.model == "radtan":
        return _radtan(points, distortion)[0]
    r = _norm(points)
    theta = torch.atan(r)
    return points * (_radius(theta, distortion) / r)[..., None]


def undistort_rays(points: Float[Tensor, "*b 2"], distortion: Distortion) -> Float[Tensor, "*b 3"]:
    """Unit rays in the camera frame that arrive at the distorted points; those of a fisheye may point backwards.

    Solved by bisection of the radial part and Newton steps; the last step carries the gradient (implicit function).

    Raises: CalibrationError for a point that no ray of the model reaches.
    """
    with torch.no_grad():
        distance = _radial_inverse(_norm(points), distortion)
    if distortion.model == "fisheye":
        theta = distance - (_radius(distance, distortion) - _norm(points)) / _radius_slope(distance, distortion)
        direction = points / _norm(points)[..., None]
        return torch.cat([direction * theta.sin()[..., None], theta.cos()[..., None]], dim=-1)
    with torch.no_grad():
        solution = points * (distance / _norm(points))[..., None]
        for _ in range(_NEWTON_STEPS):
            solution = _newton_step(solution, points, distortion)
        _check_solved(solution, points, distortion)
    plane = _newton_step(solution, points, distortion)
    return torch.nn.functional.normalize(torch.cat([plane, torch.ones_like(plane[..., :1])], dim=-1), dim=-1)


def _norm(points: Tensor) -> Tensor:
    """Distance from the centre, kept off zero where the direction is undefined."""
    return (points.square().sum(-1) + 1e-30).sqrt()


def _polynomial(coefficients: object, s: Tensor) -> Tensor:
    result = torch.zeros_like(s)
    for value in reversed([float(c) for c in coefficients]):  # type: ignore[attr-defined]
        result = result * s + value
    return result


def _derivative(coefficients: object) -> list[float]:
    return [power * float(c) for power, c in enumerate(coefficients)][1:]  # type: ignore[arg-type]


def _radius(distance: Tensor, distortion: Distortion) -> Tensor:
    numerator, denominator = distortion.radial
    s = distance.square()
    return distance * _polynomial(numerator, s) / _polynomial(denominator, s)


def _radius_slope(distance: Tensor, distortion: Distortion) -> Tensor:
    numerator, denominator = distortion.radial
    s = distance.square()
    n, d = _polynomial(numerator, s), _polynomial(denominator, s)
    n_slope, d_slope = _polynomial(_derivative(numerator), s), _polynomial(_derivative(denominator), s)
    return (n + 2 * s * n_slope) / d - 2 * s * n * d_slope / d.square()


def _radial_inverse(radius: Tensor, distortion: Distortion) -> Tensor:
    """The distance (r, or theta of a fisheye) with this distorted radius, by bisection where the radius grows."""
    turn, largest = distortion.turning_point
    # Tangential terms move a point by little, so a radtan pixel just past the turn is left to Newton and its check.
    if distortion.model == "fisheye" and not bool((radius < largest).all()):
        raise CalibrationError(
            "Pixel lies outside of what the lens model covers",
            expected=f"distorted radius below {largest:.4f}",
            got=f"{float(radius.max()):.4f}",
            next_step="check the coefficients and that K belongs to this image size",
        )
    low = torch.zeros_like(radius)
    if turn < float("inf"):
        high = torch.full_like(radius, turn)
    else:
        high = radius.clamp_min(1.0)
        while bool((_radius(high, distortion) < radius).any()):
            high = high * 2
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        below = _radius(middle, distortion) < radius
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    return (low + high) / 2


def _radtan(points: Tensor, distortion: Distortion) -> tuple[Tensor, Tensor]:
    """Distorted points and the symmetric (..., 2, 2) Jacobian of the map."""
    x, y = points.unbind(-1)
    numerator, denominator = distortion.radial
    p1, p2 = distortion.tangential
    s = x * x + y * y
    n, d = _polynomial(numerator, s), _polynomial(denominator, s)
    factor = n / d
    slope = _polynomial(_derivative(numerator), s) / d - n * _polynomial(_derivative(denominator), s) / d.square()
    distorted = torch.stack(
        [
            x * factor + 2 * p1 * x * y + p2 * (s + 2 * x * x),
            y * factor + p1 * (s + 2 * y * y) + 2 * p2 * x * y,
        ],
        dim=-1,
    )
    cross = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    xx = factor + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    yy = factor + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return distorted, torch.stack([torch.stack([xx, cross], dim=-1), torch.stack([cross, yy], dim=-1)], dim=-2)


def _newton_step(solution: Tensor, points: Tensor, distortion: Distortion) -> Tensor:
    arrived, jacobian = _radtan(solution, distortion)
    (xx, xy), (_, yy) = (row.unbind(-1) for row in jacobian.unbind(-2))
    missing = points - arrived
    determinant = xx * yy - xy * xy
    step_x = (yy * missing[..., 0] - xy * missing[..., 1]) / determinant
    step_y = (xx * missing[..., 1] - xy * missing[..., 0]) / determinant
    return solution + torch.stack([step_x, step_y], dim=-1)


def _check_solved(solution: Tensor, points: Tensor, distortion: Distortion) -> None:
    arrived, jacobian = _radtan(solution, distortion)
    error = (arrived - points).norm(dim=-1)
    solved = (error <= _CONVERGED * (1 + _norm(points))) & (torch.linalg.det(jacobian) > 0)
    if not bool(solved.all()):
        first = int(torch.nonzero(~solved.reshape(-1))[0, 0])
        raise CalibrationError(
            "Pixel has no single ray under the lens model",
            expected="an invertible model there",
            got=f"{int((~solved).sum())} of {solved.numel()} points, first {points.reshape(-1, 2)[first].tolist()}",
            next_step="check the coefficients and that K belongs to this image size",
        )


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
