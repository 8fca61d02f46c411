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
    """A camera, the frames by which its pictures trail, and the information (8, 8) and log-likelihood there."""

    camera: CameraTrack
    lag: float
    information: np.ndarray
    likelihood: float

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
    return climb(lambda camera, lag, blur: equations_at(views, camera, lag, blur, shared), start, lag, blurs, rounds)


def climb(
    equations: Callable[[CameraTrack, float, float], Equations],
    start: CameraTrack,
    lag: float,
    blurs: Sequence[float],
    rounds: int,
) -> FittedCamera:
    """The camera and lag of the largest likelihood near a start; `equations` are those of a camera, a lag and a blur."""
    camera, now = start, equations(start, lag, blurs[0])
    for number, blur in enumerate(blurs):
        now = equations(camera, lag, blur) if number else now
        damping = DAMPING
        for _ in range(rounds):
            scale = np.diag(np.maximum(np.diag(now.information), LARGEST_STEP**-2.0))
            change = np.linalg.solve(now.information + damping * scale, now.gradient)
            change /= max(1.0, float(np.abs(change / LARGEST_STEP).max()))
            tried, late = moved_camera(camera, change), lag + float(change[LAG])
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
    return FittedCamera(camera, lag, now.information, now.likelihood)


def equations_at(views: Sequence[StillView], camera: CameraTrack, lag: float, blur: float, shared: float) -> Equations:
    """Normal equations of all episodes at a camera, with the prior of focal length and lag.

    Episodes share errors, so the information is too large by `inflation`: the prior is made as much stronger.
    """
    theta = np.zeros(PARAMETERS)
    theta[LAG] = lag
    found = [view.at(camera).equations(theta, blur) for view in views]
    information = sum((each.information for each in found), np.zeros((PARAMETERS, PARAMETERS)))
    gradient = sum((each.gradient for each in found), np.zeros(PARAMETERS))
    likelihood = sum(each.likelihood for each in found)
    focal = float(np.log(camera.K[0, 0] / camera.width / USUAL_FOCAL))
    for index, value, deviation in ((FOCAL, focal, FOCAL_PRIOR), (LAG, lag, LAG_PRIOR)):
        weight = inflation(len(views), shared) / deviation**2
        information[index, index] += weight
        gradient[index] -= weight * value
        likelihood -= weight * value**2 / 2
    return Equations(information, gradient, likelihood)


def inflation(episodes: int, shared: float) -> float:
    """Variance of an estimate from episodes that share errors, in variances as if they shared none."""
    return 1 + episodes * shared
