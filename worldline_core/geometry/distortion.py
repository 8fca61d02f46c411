"""Lens distortion as recordings state it: which model, its coefficients, and how far it can be inverted. NumPy only.

Models, both of OpenCV, on the plane at depth 1 (x = X / Z, y = Y / Z, r^2 = x^2 + y^2):
    radtan (`calib3d`, ROS plumb_bob and rational_polynomial): coefficients k1, k2, p1, p2 [, k3 [, k4, k5, k6]];
        x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2),
        y' likewise with p1 and p2 exchanged.
    fisheye (`cv::fisheye`, Kannala-Brandt, ROS equidistant): coefficients k1..k4 of the angle theta = atan r;
        x' = x / r * theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8), y' likewise. All zeros is the
        equidistant lens, not a pinhole.

Points and images are undistorted in `undistortion`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.polynomial import polynomial

from worldline_core.errors import CalibrationError

DistortionModel = Literal["radtan", "fisheye"]
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
    def radial(self) -> tuple[np.ndarray, np.ndarray]:
        """Numerator and denominator of the radial factor: polynomials, lowest first, in r^2 (fisheye: theta^2)."""
        if self.model == "fisheye":
            return np.array([1.0, *self.coefficients]), np.ones(1)
        k1, k2, _, _, k3, k4, k5, k6 = (*self.coefficients, 0.0, 0.0, 0.0, 0.0)[:8]
        return np.array([1.0, k1, k2, k3]), np.array([1.0, k4, k5, k6])

    @property
    def tangential(self) -> tuple[float, float]:
        """p1, p2; zeros for a fisheye."""
        return (self.coefficients[2], self.coefficients[3]) if self.model == "radtan" else (0.0, 0.0)

    @cached_property
    def turning_point(self) -> tuple[float, float]:
        """Up to where distances from the centre grow: the ray's r (fisheye: theta [rad]) and the distorted radius there.

        Beyond it two rays meet in one pixel. Infinite for a radtan lens that never turns; a fisheye ends at pi.
        """
        numerator, denominator = self.radial
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
        numerator, denominator = self.radial
        s = np.square(distance)
        with np.errstate(divide="ignore"):
            return distance * polynomial.polyval(s, numerator) / polynomial.polyval(s, denominator)

    def check_inside(self, K: np.ndarray, image_size: tuple[int, int], where: object) -> None:
        """Raises: CalibrationError when pixels of an image of (height, width) have no single ray under this model.

        Looks at the radial part, which decides in practice; `undistort_rays` checks each pixel it is asked for.
        """
        height, width = image_size
        corners = np.array([[u, v, 1.0] for u in (0.0, width - 1.0) for v in (0.0, height - 1.0)])
        farthest = float(np.hypot(*(np.linalg.inv(K) @ corners.T)[:2]).max())
        turn, radius = self.turning_point
        if farthest >= radius:
            raise CalibrationError(
                f"The {self.model} model folds back inside of the image: pixels near a corner have no single ray",
                where=where,
                expected=f"distorted radii that grow up to {farthest:.3f}, where the farthest corner is",
                got=f"they turn at {radius:.3f} ({'theta' if self.model == 'fisheye' else 'r'} = {turn:.3f}), "
                f"coefficients {list(self.coefficients)}",
                next_step="check model and order of the coefficients, and that K belongs to this image size",
            )


def distortion_from_ros(model: str, coefficients: Sequence[float], where: object) -> Distortion | None:
    """The lens that a ROS or Foxglove camera calibration states (`distortion_model`, `D`); None for a pinhole.

    An empty D with a radtan model is a pinhole. More than 8 radtan coefficients (thin prism, tilt) must be zero.

    Raises: CalibrationError for an unknown model or unusable coefficients.
    """
    values = [float(value) for value in coefficients]
    name = model.strip().lower()
    if not values and name in ("", "none", "plumb_bob", "radtan", "rational_polynomial"):
        return None
    if name not in _ROS_MODELS:
        raise CalibrationError(
            "Unknown distortion model",
            where=where,
            expected=" | ".join(_ROS_MODELS),
            got=f"{model!r} with D = {values}",
        )
    kind = _ROS_MODELS[name]
    if kind == "radtan" and 8 < len(values) <= _OPENCV_LONGEST and not any(values[8:]):
        values = values[:8]
    try:
        distortion = Distortion(kind, tuple(values))
    except CalibrationError as error:
        raise CalibrationError(
            error.what, where=where, expected=error.expected, got=error.got, next_step=error.next_step
        ) from error
    return None if kind == "radtan" and not any(values) else distortion


def _first_root(coefficients: np.ndarray) -> float:
    """Smallest positive real root of a polynomial that begins with 1 (lowest power first), or infinity."""
    # Roots of the reversed polynomial are the reciprocals, and its leading 1 keeps tiny last coefficients harmless.
    reciprocals = polynomial.polyroots(coefficients[::-1])
    real = reciprocals.real[np.abs(reciprocals.imag) < 1e-9 * np.maximum(1.0, np.abs(reciprocals))]
    return float(1 / real.max()) if len(real) and real.max() > 1e-9 else float("inf")
