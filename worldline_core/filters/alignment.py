"""Time alignment and projection: do images, camera poses and states show the same instant, in the same place?

Lags are measured in two independent ways. Images: the lag at which tool speed and image change correlate best. Camera
poses: the shift at which a wrist camera is most rigidly fixed to its tool (exact where poses are recorded, even below
one frame). Projection: tools lie inside the image, and where one moves, the image changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

from worldline_core.calibration.calibration_doctor import lagged
from worldline_core.calibration.evidence import rms_hand_eye
from worldline_core.calibration.observation import tool_travel
from worldline_core.filters.filter_config import FilterConfig, ProjectionConfig, TimeAlignmentConfig
from worldline_core.filters.signals import Signals
from worldline_core.filters.verdict import Finding, Verdict
from worldline_core.geometry.cameras import MIN_DEPTH_M, inside_image, project_points


def lag_by_correlation(motion: np.ndarray, change: np.ndarray, max_lag: int) -> tuple[float, float, float]:
    """Lag of `change` after `motion` with the best normalised correlation.

    Args:
        motion, change: (n, s) non-negative signals of s streams, entry i for the step from frame i to i + 1.
        max_lag: frames searched to either side.

    Returns: (lag in frames, refined below a frame by a parabola; correlation there; correlation at lag 0).
    """
    scores = np.full(2 * max_lag + 1, -1.0)
    for index, lag in enumerate(range(-max_lag, max_lag + 1)):
        known = _correlations(*lagged(motion, change, lag))
        if len(known):
            scores[index] = float(np.mean(known))
    best = int(scores.argmax())
    refined = float(best - max_lag)
    if 0 < best < len(scores) - 1:
        refined += _parabola_peak(*scores[best - 1 : best + 2])
    return refined, float(scores[best]), float(scores[max_lag])


def _parabola_peak(left: float, middle: float, right: float) -> float:
    """Place of the maximum of the parabola through values at -1, 0 and 1; 0 where it has none."""
    curvature = left - 2 * middle + right
    return 0.5 * (left - right) / curvature if curvature < -1e-9 else 0.0


def _correlations(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Pearson's correlation of the columns of two (n, s) that vary in both; none for fewer than eight rows."""
    if len(a) < 8:
        return np.zeros(0)
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    spread_a, spread_b = np.sqrt((a**2).mean(axis=0)), np.sqrt((b**2).mean(axis=0))
    varies = (spread_a > 1e-9) & (spread_b > 1e-9)
    return (a * b).mean(axis=0)[varies] / (spread_a * spread_b)[varies]


def _largest_lag(count: int, fps: float, config: TimeAlignmentConfig) -> int:
    """Frames searched to either side; at most a third of the recording is given up."""
    return max(1, min(round(config.search_s * fps), count // 3))


def detect_image_lag(motion: np.ndarray, change: np.ndarray, fps: float, config: TimeAlignmentConfig) -> Verdict:
    """Whether images lag or lead the states.

    Args:
        motion: (n, s) speed of what moves view s's image, entry i for the step to frame i + 1.
        change: (n, s) mean absolute image change of view s.
    """
    lag, best, at_zero = lag_by_correlation(motion, change, _largest_lag(len(motion), fps, config))
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

    The search is coarse first, then fine around the best: the residual falls towards it over many frames.

    Returns: (lag in frames, hand-eye residual [m] there, residual at 0), residuals as root mean squares.
    """

    @cache
    def residual(lag: int) -> float:
        return rms_hand_eye(*lagged(T_base_tool, T_base_camera, lag))[1]

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
    lag, best, at_zero = pose_lag(T_base_tool, T_base_camera, _largest_lag(len(T_base_tool), fps, config))
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


def local_change(
    gray: np.ndarray, uv: np.ndarray, inside: np.ndarray, radius_px: float, min_step_px: float
) -> np.ndarray:
    """Change near a projected point against that of the whole image, for frames in which the point moves.

    Args:
        gray: uint8 (n, h, w). uv: (n, 2). inside: bool (n,).

    Returns: (m, 2), m <= n - 1: the ratio of the mean changes, and the mean rank of the near change, 0 least .. 1 most,
        0.5 by chance.
    """
    value = gray.astype(np.float32)
    height, width = gray.shape[1:]
    rows, columns = np.mgrid[:height, :width]
    found: list[tuple[float, float]] = []
    for i in range(1, len(gray)):
        if not (inside[i] and inside[i - 1]) or np.linalg.norm(uv[i] - uv[i - 1]) < min_step_px:
            continue
        change = np.abs(value[i] - value[i - 1])
        near = np.zeros((height, width), dtype=bool)
        for u, v in uv[i - 1 : i + 1]:
            near |= (columns - u) ** 2 + (rows - v) ** 2 <= radius_px**2
        ordered = np.sort(change, axis=None)
        below, until = (np.searchsorted(ordered, change[near], side) for side in ("left", "right"))
        rank = float((below + until).mean()) / (2 * ordered.size)
        found.append((float(change[near].mean()) / max(float(change.mean()), 0.05), rank))
    return np.asarray(found).reshape(-1, 2)


def detect_projection(gray: np.ndarray, uv: np.ndarray, inside: np.ndarray, config: ProjectionConfig) -> Verdict:
    """Whether tools project where the picture shows motion.

    Two measures, of which one suffices. The ratio finds a small tool before a resting scene; where large arms and what
    they carry fill half of the picture it cannot be large, but the change near the tool still ranks high.

    Args:
        gray: uint8 (n, h, w) of a view that stands still.
        uv: (n, a, 2) projected tools. inside: bool (n, a).
    """
    width = gray.shape[2]
    share = float(inside.any(axis=1).mean())
    changes = [
        local_change(gray, uv[:, arm], inside[:, arm], config.radius * width, config.min_step * width)
        for arm in range(uv.shape[1])
    ]
    pooled = np.concatenate(changes) if changes else np.zeros((0, 2))
    judged = len(pooled) >= config.min_moving_frames
    contrast, rank = (float(middle) for middle in np.median(pooled, axis=0)) if judged else (None, None)
    moves = contrast is None or rank is None or contrast >= config.min_contrast or rank >= config.min_rank
    return Verdict(
        "projection",
        share >= config.min_inside_share and moves,
        {
            "inside_share": share,
            "motion_contrast": contrast,
            "motion_rank": rank,
            "moving_frames": len(pooled),
            "threshold_inside_share": config.min_inside_share,
            "threshold_contrast": config.min_contrast,
            "threshold_rank": config.min_rank,
        },
    )


def find_lags(signals: Signals, config: FilterConfig, _: Sequence[Finding]) -> list[Finding]:
    """Lags of the images of all views against the tools, and of the poses of each moving wrist camera."""
    tools = signals.calibrated_tools
    if tools is None:
        return []
    fps, thresholds = signals.episode.fps, config.time_alignment
    findings: list[Finding] = []
    if signals.arms:
        motion = tool_travel(tools)
        streams = [motion[:, list(signals.arms_in(view))].max(axis=1) for view in signals.pictures]
        changes = [pictures.change[1:] for pictures in signals.pictures.values()]
        verdict = detect_image_lag(np.stack(streams, axis=1), np.stack(changes, axis=1), fps, thresholds)
        findings.append(Finding("image_lag", None, 2, verdict))
    for arm, camera in signals.wrist_cameras:
        if camera.moving and np.isfinite(camera.T_base_camera).all():
            verdict = detect_pose_lag(tools[:, arm], camera.poses(np.arange(len(tools))), fps, thresholds)
            findings.append(Finding("pose_lag", camera.view, 2, verdict))
    return findings


def find_projection(signals: Signals, config: FilterConfig, _: Sequence[Finding]) -> list[Finding]:
    """In the episode's primary view, where its camera is known."""
    view = signals.episode.primary_view
    camera = signals.episode.cameras.get(view)
    tools = signals.calibrated_tools
    if tools is None or camera is None or view not in signals.gray or not np.isfinite(camera.K).all():
        return []
    gray = signals.gray[view]
    camera = camera.resized(gray.shape[2], gray.shape[1])
    poses = camera.poses(np.arange(len(gray)))
    uvs, insides = [], []
    for arm in range(tools.shape[1]):
        uv, depth = project_points(tools[:, arm, :3, 3], camera.K, poses)
        uvs.append(uv)
        insides.append((depth > MIN_DEPTH_M) & inside_image(uv, (camera.height, camera.width)))
    verdict = detect_projection(gray, np.stack(uvs, axis=1), np.stack(insides, axis=1), config.projection)
    return [Finding("projection", view, 2, verdict)]
