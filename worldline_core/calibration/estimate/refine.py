"""A still camera made exact: all episodes' motion maps together, from a start near the truth.

The equations are those of the doctor (`camera_errors.StillView`), which asks how a known camera would have to change. Here
the camera is changed and asked again, from blurred maps to sharp ones, until it rests (Levenberg and Marquardt).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from worldline_core.calibration.camera_errors import (
    LAG,
    LARGEST_STEP,
    PARAMETERS,
    Equations,
    StillView,
    moved_camera,
)
from worldline_core.data.episodes.episode import CameraTrack

FOCAL = LAG - 1
USUAL_FOCAL, FOCAL_PRIOR, LAG_PRIOR = 0.8, 0.4, 3.0
"""Focal length of usual cameras in widths of the picture (64 degrees; 95 % of them between 35 and 100), standard deviations of its
logarithm and of the lag [frames]."""
DAMPING, LARGEST_DAMPING = 1e-3, 1e3
TOLERATED = 0.3
"""Loss of log-likelihood in a step: the slopes leave out how the robot's outline covers the cells."""
SETTLED = 0.02
"""Squared step in standard deviations below which nothing changes."""


@dataclass(frozen=True, eq=False)
class FittedCamera:
    """A camera, the frames by which its pictures trail, and the equations there."""

    camera: CameraTrack
    lag: float
    equations: Equations

    @property
    def information(self) -> np.ndarray:
        """(8, 8)."""
        return self.equations.information

    @property
    def likelihood(self) -> float:
        return self.equations.likelihood

    @property
    def focal(self) -> float:
        """In widths of the picture."""
        return float(self.camera.K[0, 0] / self.camera.width)


def fit_still(
    views: Sequence[StillView], start: CameraTrack, lag: float, blurs: Sequence[float], rounds: int, shared: float
) -> FittedCamera:
    """The camera that explains all episodes best, from a start; `rounds` steps on maps of each blur at most.

    Args:
        shared: variance that more episodes do not reduce, in variances of one episode.
    """
    found = climb(lambda camera, lag, blur: equations_at(views, camera, lag, blur, shared), start, lag, blurs, rounds)
    return FittedCamera(*found)


def climb[C](
    equations: Callable[[C, float, float], Equations],
    start: C,
    lag: float,
    blurs: Sequence[float],
    rounds: int,
    moved: Callable[[C, np.ndarray], C] = moved_camera,
    largest: np.ndarray = LARGEST_STEP,
) -> tuple[C, float, Equations]:
    """The camera and lag of the largest likelihood near a start, and the equations there.

    Args:
        equations: those of a camera, a lag and a blur; the lag is the last parameter.
        moved, largest: a camera changed by the parameters, and their largest step.
    """
    camera, now = start, equations(start, lag, blurs[0])
    for number, blur in enumerate(blurs):
        now = equations(camera, lag, blur) if number else now
        damping = DAMPING
        for _ in range(rounds):
            scale = np.diag(np.maximum(np.diag(now.information), largest**-2.0))
            change = np.linalg.solve(now.information + damping * scale, now.gradient)
            change /= max(1.0, float(np.abs(change / largest).max()))
            tried, late = moved(camera, change), lag + float(change[-1])
            then = equations(tried, late, blur)
            if then.likelihood > now.likelihood - TOLERATED:
                gained = float(change @ now.information @ change)
                camera, lag, now, damping = tried, late, then, damping / 4
                if gained < SETTLED:
                    break
            elif damping > LARGEST_DAMPING:
                break
            else:
                damping = max(10 * damping, 0.03)
    return camera, lag, now


def equations_at(views: Sequence[StillView], camera: CameraTrack, lag: float, blur: float, shared: float) -> Equations:
    """Normal equations of all episodes at a camera, with the prior of focal length and lag."""
    return with_prior(summed_equations(views, camera, lag, blur), camera, lag, inflation(len(views), shared))


def summed_equations(views: Sequence[StillView], camera: CameraTrack, lag: float, blur: float) -> Equations:
    """Normal equations of all episodes at a camera."""
    theta = np.append(np.zeros(LAG), lag)
    return total([view.at(camera).equations(theta, blur) for view in views])


def total(found: Sequence[Equations]) -> Equations:
    """The sum of normal equations."""
    information = sum((each.information for each in found), np.zeros((PARAMETERS, PARAMETERS)))
    gradient = sum((each.gradient for each in found), np.zeros(PARAMETERS))
    return Equations(information, gradient, sum(each.likelihood for each in found))


def with_prior(found: Equations, camera: CameraTrack, lag: float, strength: float) -> Equations:
    """Equations, whose last parameters are focal length and lag, with the prior of both.

    Episodes share errors, so the information is too large by `inflation`: the prior is made as much stronger.
    """
    weight = np.zeros(len(found.gradient))
    weight[-2:] = strength / np.array([FOCAL_PRIOR, LAG_PRIOR]) ** 2
    value = np.zeros(len(weight))
    value[-2:] = np.log(camera.K[0, 0] / camera.width / USUAL_FOCAL), lag
    likelihood = found.likelihood - float(weight @ value**2) / 2
    return Equations(found.information + np.diag(weight), found.gradient - weight * value, likelihood)


def inflation(episodes: int, shared: float) -> float:
    """Variance of an estimate from episodes that share errors, in variances as if they shared none."""
    return 1 + episodes * shared
