"""Time alignment: do images, camera poses and states show the same instant?

Two independent measurements. Images: the lag at which tool speed and image change correlate best. Camera poses: the shift
at which a wrist camera is most rigidly fixed to its tool (exact where poses are recorded, even below one frame).

Projection: the tool lies in the picture, and where it is said to move, the picture changes.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.filters.verdict import Verdict
from worldline_core.geometry.transforms import hand_eye_residual


class TimeAlignmentConfig(StrictModel):
    """Lags in seconds; positive means that the images come after the states."""

    max_lag_s: float = Field(default=0.19, gt=0, description="a larger lag condemns")
    search_s: float = Field(default=0.8, gt=0)
    min_correlation: float = Field(default=0.75, gt=0, lt=1, description="at the best lag; less proves nothing")
    min_gain: float = Field(default=0.12, ge=0, description="of the correlation at the best lag over that at lag 0")
    max_pose_lag_s: float = Field(
        default=0.1, gt=0, description="larger shift between camera poses and states condemns"
    )
    min_pose_gain_m: float = Field(
        default=0.004, ge=0, description="smaller gains of the hand-eye residual prove no shift"
    )
    max_rigid_residual_m: float = Field(
        default=0.012, gt=0, description="hand-eye residual at the best shift, to trust it"
    )


def lag_by_correlation(motion: np.ndarray, change: np.ndarray, max_lag: int) -> tuple[float, float, float]:
    """Lag of `change` after `motion` with the best normalised correlation.

    Args:
        motion, change: (n, s) non-negative signals of s streams, entry i for the step from frame i to i + 1.
        max_lag: frames searched to either side.

    Returns: (lag in frames, refined below a frame by a parabola; correlation there; correlation at lag 0).
    """
    best, scores = 0, np.full(2 * max_lag + 1, -1.0)
    for index, lag in enumerate(range(-max_lag, max_lag + 1)):
        a = motion[max(0, -lag) : len(motion) - max(0, lag)]
        b = change[max(0, lag) : len(change) - max(0, -lag)]
        known = _correlations(a, b)
        if len(known):
            scores[index] = float(np.mean(known))
    best = int(scores.argmax())
    refined = float(best - max_lag)
    if 0 < best < len(scores) - 1:
        left, middle, right = scores[best - 1 : best + 2]
        curvature = left - 2 * middle + right
        if curvature < -1e-9:
            refined += 0.5 * (left - right) / curvature
    return refined, float(scores[best]), float(scores[max_lag])


def _correlations(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Pearson's of the columns of (n, s) and (n, s) that vary in both; none from fewer than eight rows."""
    if len(a) < 8:
        return np.zeros(0)
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    spread_a, spread_b = np.sqrt((a**2).mean(axis=0)), np.sqrt((b**2).mean(axis=0))
    varies = (spread_a > 1e-9) & (spread_b > 1e-9)
    return (a * b).mean(axis=0)[varies] / (spread_a * spread_b)[varies]


def detect_image_lag(motion: np.ndarray, change: np.ndarray, fps: float, config: TimeAlignmentConfig) -> Verdict:
    """Whether images lag or lead the states.

    Args:
        motion: (n, s) speed of what moves view s's image, entry i for the step to frame i + 1.
        change: (n, s) mean absolute image change of view s.
    """
    max_lag = max(1, min(round(config.search_s * fps), len(motion) // 3))
    lag, best, at_zero = lag_by_correlation(motion, change, max_lag)
    significant = best >= config.min_correlation and best - at_zero >= config.min_gain
    return Verdict(
        "time_alignment",
        not (significant and abs(lag) / fps > config.max_lag_s),
        {
            "image_lag_s": lag / fps,
            "correlation": best,
            "correlation_at_zero": at_zero,
            "threshold_lag_s": config.max_lag_s,
        },
    )


def pose_lag(T_base_tool: np.ndarray, T_base_camera: np.ndarray, max_lag: int) -> tuple[int, float, float]:
    """Shift of a wrist camera's poses after its tool's that makes the pair most rigid.

    A shift is looked for coarsely first, then around the best: the residual falls towards it over many frames.

    Returns: (lag in frames, hand-eye residual [m] there, residual at 0), residuals as root mean squares.
    """
    residuals: dict[int, float] = {}

    def residual(lag: int) -> float:
        if lag not in residuals:
            tool = T_base_tool[max(0, -lag) : len(T_base_tool) - max(0, lag)]
            camera = T_base_camera[max(0, lag) : len(T_base_camera) - max(0, -lag)]
            _, metres, _ = hand_eye_residual(tool, camera)
            residuals[lag] = float(np.sqrt((metres**2).mean()))
        return residuals[lag]

    coarse = max(1, max_lag // 6)
    tried = [*range(0, max_lag + 1, coarse), *range(-coarse, -max_lag - 1, -coarse)]
    around = min(tried, key=lambda lag: (residual(lag), abs(lag)))
    near = range(max(-max_lag, around - coarse), min(max_lag, around + coarse) + 1)
    best = min(near, key=lambda lag: (residual(lag), abs(lag)))
    return best, residual(best), residual(0)


def detect_pose_lag(
    T_base_tool: np.ndarray, T_base_camera: np.ndarray, fps: float, config: TimeAlignmentConfig
) -> Verdict:
    """Whether recorded camera poses lag or lead the states."""
    max_lag = max(1, min(round(config.search_s * fps), len(T_base_tool) // 3))
    lag, best, at_zero = pose_lag(T_base_tool, T_base_camera, max_lag)
    # Where no shift makes the pair rigid, the calibration is wrong and says nothing about clocks.
    significant = at_zero - best >= config.min_pose_gain_m and best <= config.max_rigid_residual_m
    return Verdict(
        "time_alignment",
        not (significant and abs(lag) / fps > config.max_pose_lag_s),
        {
            "pose_lag_s": lag / fps,
            "residual_m": best,
            "residual_at_zero_m": at_zero,
            "threshold_lag_s": config.max_pose_lag_s,
        },
    )


class ProjectionConfig(StrictModel):
    """Lengths in shares of the image width, so that they hold at any resolution."""

    min_inside_share: float = Field(
        default=0.5, gt=0, le=1, description="frames in which some arm's tool is in the task-facing view"
    )
    radius: float = Field(default=0.07, gt=0, description="disc around the tool in which change is looked for")
    min_step: float = Field(default=0.012, gt=0, description="projected motion a frame that must be visible")
    min_moving_frames: int = Field(default=5, ge=1, description="fewer prove nothing")
    min_contrast: float = Field(
        default=1.6, gt=0, description="change near the tool over change in the whole picture (median)"
    )


def local_contrast(
    gray: np.ndarray, uv: np.ndarray, inside: np.ndarray, radius_px: float, min_step_px: float
) -> np.ndarray:
    """Change near a projected point relative to the change of the whole image, for frames in which the point moves.

    Args:
        gray: uint8 (n, h, w). uv: (n, 2). inside: bool (n,).

    Returns: (m,) ratios, m <= n - 1.
    """
    value = gray.astype(np.float32)
    height, width = gray.shape[1:]
    rows, columns = np.mgrid[:height, :width]
    ratios = []
    for i in range(1, len(gray)):
        if not (inside[i] and inside[i - 1]) or np.linalg.norm(uv[i] - uv[i - 1]) < min_step_px:
            continue
        change = np.abs(value[i] - value[i - 1])
        near = np.zeros((height, width), dtype=bool)
        for u, v in uv[i - 1 : i + 1]:
            near |= (columns - u) ** 2 + (rows - v) ** 2 <= radius_px**2
        ratios.append(change[near].mean() / max(float(change.mean()), 0.05))
    return np.asarray(ratios)


def detect_projection(gray: np.ndarray, uv: np.ndarray, inside: np.ndarray, config: ProjectionConfig) -> Verdict:
    """Whether tools project where the picture shows motion.

    Args:
        gray: uint8 (n, h, w) of a view that stands still.
        uv: (n, a, 2) projected tools. inside: bool (n, a).
    """
    width = gray.shape[2]
    share = float(inside.any(axis=1).mean())
    ratios = [
        local_contrast(gray, uv[:, arm], inside[:, arm], config.radius * width, config.min_step * width)
        for arm in range(uv.shape[1])
    ]
    pooled = np.concatenate(ratios) if ratios else np.zeros(0)
    contrast = float(np.median(pooled)) if len(pooled) >= config.min_moving_frames else None
    return Verdict(
        "projection",
        share >= config.min_inside_share and (contrast is None or contrast >= config.min_contrast),
        {
            "inside_share": share,
            "motion_contrast": contrast,
            "moving_frames": len(pooled),
            "threshold_inside_share": config.min_inside_share,
            "threshold_contrast": config.min_contrast,
        },
    )
