"""Lens distortion: the models that recordings state, and the pinhole image that replaces the distorted one.

Models, both of OpenCV, on the plane at depth 1 (x = X / Z, y = Y / Z, r^2 = x^2 + y^2):
    radtan (`calib3d`, ROS plumb_bob and rational_polynomial): coefficients k1, k2, p1, p2 [, k3 [, k4, k5, k6]].
    fisheye (`cv::fisheye`, Kannala-Brandt, ROS equidistant): coefficients k1..k4 of the angle theta = atan r; all zeros is
        the equidistant lens, not a pinhole.

OpenCV's inverses are not used: the one of radtan need not converge, the one of fisheye ends at a distorted radius of 90 degrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import cv2
import numpy as np
from numpy.polynomial import polynomial

from worldline_core.errors import CalibrationError

DistortionModel = Literal["radtan", "fisheye"]
MAX_HALF_ANGLE_DEG = 65.0
"""The pinhole image ends at this angle from the axis to each side: a wider one is mostly stretched border."""
_COUNTS: dict[str, tuple[int, ...]] = {"radtan": (4, 5, 8), "fisheye": (4,)}
_ROS_MODELS: dict[str, DistortionModel] = {
    "plumb_bob": "radtan",
    "radtan": "radtan",
    "rational_polynomial": "radtan",
    "equidistant": "fisheye",
    "kannala_brandt": "fisheye",
    "fisheye": "fisheye",
}
_OPENCV_LONGEST = 14  # rational, thin prism, tilt
_BISECTIONS = 60  # halves a bracket to float64 resolution
_NEWTON_STEPS = 8
_CONVERGED = 1e-9


@dataclass(frozen=True)
class Distortion:
    """A lens.

    Attributes:
        coefficients: dimensionless, in OpenCV's order.

    Raises: CalibrationError for an unknown model, a wrong number of coefficients, or one that is not finite.
    """

    model: DistortionModel
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in _COUNTS:
            raise CalibrationError("Unknown distortion model", expected=" | ".join(_COUNTS), got=self.model)
        if len(self.coefficients) not in _COUNTS[self.model] or not np.isfinite(self.coefficients).all():
            raise CalibrationError(
                f"Coefficients of a {self.model} lens are incomplete or not finite",
                expected=" or ".join(map(str, _COUNTS[self.model])) + " finite numbers",
                got=f"{len(self.coefficients)}: {list(self.coefficients)}",
                next_step="check which camera model the numbers belong to",
            )

    @cached_property
    def _radial(self) -> tuple[np.ndarray, np.ndarray]:
        """Numerator and denominator of the radial factor: polynomials, lowest first, in r^2 (fisheye: theta^2)."""
        if self.model == "fisheye":
            return np.array([1.0, *self.coefficients]), np.ones(1)
        k1, k2, _, _, k3, k4, k5, k6 = (*self.coefficients, 0.0, 0.0, 0.0, 0.0)[:8]
        return np.array([1.0, k1, k2, k3]), np.array([1.0, k4, k5, k6])

    @cached_property
    def turning_point(self) -> tuple[float, float]:
        """The ray's r (fisheye: theta [rad]) up to which the distorted radius grows, and that radius; beyond, two rays meet in one
        pixel. Infinite for a radtan lens that never turns; a fisheye ends at pi.
        """
        numerator, denominator = self._radial
        # d/dr of r N(s) / D(s) with s = r^2 is ((N + 2 s N') D - 2 s N D') / D^2, and 1 at the centre.
        s = np.array([0.0, 2.0])
        grown = polynomial.polyadd(numerator, polynomial.polymul(s, polynomial.polyder(numerator)))
        slope = polynomial.polysub(
            polynomial.polymul(grown, denominator),
            polynomial.polymul(s, polynomial.polymul(numerator, polynomial.polyder(denominator))),
        )
        turn = np.sqrt(min(_first_root(slope), _first_root(denominator)))
        if self.model == "fisheye":
            turn = min(turn, np.pi)
        return float(turn), float(self.radius(turn)) if np.isfinite(turn) else float("inf")

    def radius(self, distance: float | np.ndarray) -> np.ndarray:
        """Distorted radius of rays at r (fisheye: theta), without the tangential terms."""
        numerator, denominator = self._radial
        s = np.square(distance)
        with np.errstate(divide="ignore"):
            return distance * polynomial.polyval(s, numerator) / polynomial.polyval(s, denominator)

    def check_inside(self, K: np.ndarray, image_size: tuple[int, int]) -> None:
        """Raises: CalibrationError when pixels of an image of (height, width) have no single ray under the radial part."""
        height, width = image_size
        corners = np.array([[u, v, 1.0] for u in (0.0, width - 1.0) for v in (0.0, height - 1.0)])
        farthest = float(np.hypot(*(np.linalg.inv(K) @ corners.T)[:2]).max())
        turn, radius = self.turning_point
        if farthest >= radius:
            raise CalibrationError(
                f"The {self.model} model folds back inside of the image: pixels near a corner have no single ray",
                expected=f"distorted radii that grow up to {farthest:.3f}, where the farthest corner is",
                got=f"they turn at {radius:.3f} ({'theta' if self.model == 'fisheye' else 'r'} = {turn:.3f}), "
                f"coefficients {list(self.coefficients)}",
                next_step="check model and order of the coefficients, and that K belongs to this image size",
            )


def _first_root(coefficients: np.ndarray) -> float:
    """Smallest positive real root of a polynomial that begins with 1 (lowest power first), or infinity."""
    # Roots of the reversed polynomial are the reciprocals, and its leading 1 keeps tiny last coefficients harmless.
    reciprocals = polynomial.polyroots(coefficients[::-1])
    real = reciprocals.real[np.abs(reciprocals.imag) < 1e-9 * np.maximum(1.0, np.abs(reciprocals))]
    return float(1 / real.max()) if len(real) and real.max() > 1e-9 else float("inf")


def distortion_from_ros(model: str, coefficients: Sequence[float]) -> Distortion | None:
    """The lens that a ROS or Foxglove camera calibration states (`distortion_model`, `D`); None for a pinhole.

    An empty D with a radtan model is a pinhole, and so are zeros under any name but a fisheye's. More than 8 radtan coefficients (thin prism, tilt) must be zero.

    Raises: CalibrationError for an unknown model or unusable coefficients.
    """
    values = [float(value) for value in coefficients]
    name = model.strip().lower()
    if not values and name in ("", "none", "plumb_bob", "radtan", "rational_polynomial"):
        return None
    if values and not any(values) and not is_fisheye(model):
        return None
    if name not in _ROS_MODELS:
        raise CalibrationError(
            "Unknown distortion model", expected=" | ".join(_ROS_MODELS), got=f"{model!r} with D = {values}"
        )
    kind = _ROS_MODELS[name]
    if kind == "radtan" and 8 < len(values) <= _OPENCV_LONGEST and not any(values[8:]):
        values = values[:8]
    return Distortion(kind, tuple(values))


def is_fisheye(model: str) -> bool:
    """True if a ROS `distortion_model` is a fisheye's, for which zeros are no pinhole."""
    return _ROS_MODELS.get(model.strip().lower()) == "fisheye"


def distort_points(points: np.ndarray, distortion: Distortion) -> np.ndarray:
    """Distorts points (n, 2) of the plane at depth 1, (x, y) -> (x', y'), by OpenCV."""
    if distortion.model == "fisheye":
        return cv2.fisheye.distortPoints(points[None], np.eye(3), np.array(distortion.coefficients))[0]
    return _radtan(points, distortion)[0]


def _radtan(points: np.ndarray, distortion: Distortion) -> tuple[np.ndarray, np.ndarray]:
    """Distorted points (n, 2) and the Jacobians (n, 2, 2) of the map."""
    in_front = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    arrived, slopes = cv2.projectPoints(
        in_front, np.zeros(3), np.zeros(3), np.eye(3), np.array(distortion.coefficients)
    )
    return arrived[:, 0], slopes[:, 3:5].reshape(-1, 2, 2)  # by the first two entries of tvec, at depth 1


def undistort_rays(points: np.ndarray, distortion: Distortion) -> np.ndarray:
    """Unit rays (n, 3) in the camera frame that arrive at distorted points (n, 2); a fisheye's may point backwards.

    Raises: CalibrationError for a point that no ray of the model reaches.
    """
    radius = np.maximum(np.linalg.norm(points, axis=1), 1e-15)
    distance = _radial_inverse(radius, distortion)
    direction = points / radius[:, None]
    if distortion.model == "fisheye":
        return np.concatenate([direction * np.sin(distance)[:, None], np.cos(distance)[:, None]], axis=1)
    plane = direction * distance[:, None]
    for _ in range(_NEWTON_STEPS):
        arrived, slopes = _radtan(plane, distortion)
        (dx, dy), (xx, xy, _, yy) = (points - arrived).T, slopes.reshape(-1, 4).T
        # The Jacobian is symmetric. Where it is singular the point becomes NaN, and counts as unsolved below.
        with np.errstate(divide="ignore", invalid="ignore"):
            plane = plane + (np.stack([yy * dx - xy * dy, xx * dy - xy * dx]) / (xx * yy - xy * xy)).T
    arrived, slopes = _radtan(plane, distortion)
    unsolved = ~((np.linalg.norm(arrived - points, axis=1) <= _CONVERGED * (1 + radius)) & (np.linalg.det(slopes) > 0))
    if unsolved.any():
        raise CalibrationError(
            "Pixel has no single ray under the lens model",
            expected="an invertible model there",
            got=f"{int(unsolved.sum())} of {len(points)} points, first {points[unsolved][0].tolist()}",
            next_step="check the coefficients and that K belongs to this image size",
        )
    rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _radial_inverse(radius: np.ndarray, distortion: Distortion) -> np.ndarray:
    """The distances (r, or theta of a fisheye) with these distorted radii, by bisection where the radius grows."""
    turn, largest = distortion.turning_point
    # Tangential terms move a point by little, so a radtan pixel just past the turn is left to Newton and its check.
    if distortion.model == "fisheye" and not (radius < largest).all():
        raise CalibrationError(
            "Pixel is outside of what the lens model covers",
            expected=f"distorted radius below {largest:.4f}",
            got=f"{float(radius.max()):.4f}",
            next_step="check the coefficients and that K belongs to this image size",
        )
    low, high = np.zeros_like(radius), np.minimum(np.maximum(radius, 1.0), turn)
    while not np.isfinite(turn) and (distortion.radius(high) < radius).any():
        high = high * 2
    high = np.full_like(radius, turn) if np.isfinite(turn) else high
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        below = distortion.radius(middle) < radius
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return (low + high) / 2


@dataclass(frozen=True, eq=False)
class Undistortion:
    """Maps from a lens to a pinhole at the same image size.

    Attributes:
        K: (3, 3) of the undistorted image, pixels.
        map_u, map_v: float32 (H, W): where each undistorted pixel is in the distorted image.
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


def undistortion(distortion: Distortion, K: np.ndarray, image_size: tuple[int, int]) -> Undistortion:
    """Maps and camera matrix for images of (height, width); the same lens is worked out once.

    The new image shows the largest upright rectangle of the view that the recorded pixels fill (OpenCV's alpha = 0), at
    most `MAX_HALF_ANGLE_DEG` to each side, so no pixel of it is invented.

    Raises: CalibrationError when the model cannot be inverted inside of the image.
    """
    distortion.check_inside(K, image_size)
    return _undistortion(distortion, tuple(float(v) for v in K.reshape(-1)), image_size)


@lru_cache(maxsize=64)
def _undistortion(distortion: Distortion, K_flat: tuple[float, ...], image_size: tuple[int, int]) -> Undistortion:
    K = np.array(K_flat).reshape(3, 3)
    new_K = undistorted_intrinsics(distortion, K, image_size)
    height, width = image_size
    v, u = np.mgrid[0:height, 0:width].reshape(2, -1).astype(np.float64)
    plane = np.stack([(u - new_K[0, 2]) / new_K[0, 0], (v - new_K[1, 2]) / new_K[1, 1]], axis=-1)
    # Not cv2.initUndistortRectifyMap, which forgets the skew of K.
    pixels = distort_points(plane, distortion) @ K[:2, :2].T + K[:2, 2]
    map_u, map_v = pixels.T.reshape(2, height, width).astype(np.float32)
    return Undistortion(new_K, map_u, map_v)


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
        rays = undistort_rays(plane[:2].T, distortion)
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
