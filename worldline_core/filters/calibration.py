"""Clocks, projection and calibration: do images, camera poses and states show the same instant, in the same place?

Lags are measured in two independent ways. Images: the lag at which tool speed and image change correlate best. Camera
poses: the shift at which a wrist camera is most rigidly fixed to its tool (exact where poses are recorded, even below
one frame). Projection: tools lie inside the image, and where one moves, the image changes. Calibration: K is plausible,
camera poses are rigid, wrist cameras are fixed to their arm, fixed cameras stay fixed.

The calibration doctor is a detector as well: no usual mistake explains the recording better than its own calibration
does. An explained mistake excludes the episode from Stage II: its evidence names the configuration line that repairs the
source, and nothing is repaired silently. A camera that is off by an estimate and an inverted gripper are warnings in the
evidence, and bar nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np

from worldline_core.calibration.calibration_doctor import diagnose, lagged
from worldline_core.calibration.diagnosis import MIN_MARGIN, Diagnosis, bad_terms
from worldline_core.calibration.evidence import (
    fields_of_view_deg,
    mount_offset,
    principal_point_offset,
)
from worldline_core.calibration.observation import tool_travel
from worldline_core.data.episodes.episode import Episode
from worldline_core.filters.filter_config import (
    CalibrationConfig,
    FilterConfig,
    FilterDoctorConfig,
    ProjectionConfig,
    TimeAlignmentConfig,
)
from worldline_core.filters.signals import Signals, known_kinematics
from worldline_core.filters.verdict import Finding, Numbers, Verdict, bad_frames, runs
from worldline_core.geometry.cameras import MIN_DEPTH_M, inside_image, project_points
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import hand_eye_residual, lengths, rigid_inverse


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
    """Checks that images neither lag nor lead the states.

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

    T_tool_base = rigid_inverse(T_base_tool)

    @cache
    def residual(lag: int) -> float:
        inverse, cameras = lagged(T_tool_base, T_base_camera, lag)
        place = (inverse @ cameras)[:, :3, 3]
        return float(np.sqrt((lengths(place - np.median(place, axis=0)) ** 2).mean()))

    coarse = max(1, max_lag // 6)
    tried = [*range(0, max_lag + 1, coarse), *range(-coarse, -max_lag - 1, -coarse)]
    around = min(tried, key=lambda lag: (residual(lag), abs(lag)))
    near = range(max(-max_lag, around - coarse), min(max_lag, around + coarse) + 1)
    best = min(near, key=lambda lag: (residual(lag), abs(lag)))
    return best, residual(best), residual(0)


def detect_pose_lag(
    T_base_tool: np.ndarray, T_base_camera: np.ndarray, fps: float, config: TimeAlignmentConfig
) -> Verdict:
    """Checks that recorded camera poses neither lag nor lead the states."""
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
    """Checks that tools project to where the picture shows motion.

    Two measures, of which one suffices. The ratio finds a small tool before a resting scene; where large arms and what
    they carry fill half of the picture it cannot be large, but the change near the tool still ranks high.

    Args:
        gray: uint8 (n, h, w) of a still camera.
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
    """Checks the projection in the primary view, where its camera is known."""
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


def detect_camera(
    K: np.ndarray, T_base_camera: np.ndarray, width: int, height: int, config: CalibrationConfig
) -> Verdict:
    """Checks that K and the poses (n, 4, 4) are plausible for a camera with this image size."""
    numbers: Numbers = {}
    sane = bool(np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0 and abs(np.linalg.det(K)) > 1e-9)
    if sane:
        for name, angle in zip(("horizontal", "vertical"), fields_of_view_deg(K, width, height), strict=True):
            numbers[f"{name}_fov_deg"] = angle
            sane &= config.min_field_of_view_deg <= angle <= config.max_field_of_view_deg
        offset = max(map(abs, principal_point_offset(K, width, height)))
        numbers["principal_point_offset"] = offset
        sane &= offset <= config.max_principal_point_offset
    rotation = T_base_camera[:, :3, :3]
    finite = bool(np.isfinite(T_base_camera).all())
    residual = float(np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max()) if finite else None
    proper = finite and bool((np.linalg.det(rotation) > 0).all())
    numbers |= {"rotation_residual": residual, "threshold_rotation_residual": config.max_rotation_residual}
    rigid = proper and residual is not None and residual <= config.max_rotation_residual
    return Verdict("calibration", sane and rigid, numbers)


def detect_hand_eye(
    T_base_tool: np.ndarray, T_base_camera: np.ndarray, T_tool_mount: np.ndarray | None, config: CalibrationConfig
) -> Verdict:
    """Checks that a wrist camera is rigidly fixed to its tool, at the mount that the embodiment states.

    Args:
        T_base_tool, T_base_camera: (n, 4, 4).
        T_tool_mount: (4, 4) the embodiment's mount relative to the tool, or None.
    """
    mount, metres_95, degrees_95 = _residual_95(T_base_tool, T_base_camera)
    passed = metres_95 <= config.max_hand_eye_m and degrees_95 <= config.max_hand_eye_deg
    numbers: Numbers = {
        "hand_eye_m": metres_95,
        "hand_eye_deg": degrees_95,
        "threshold_m": config.max_hand_eye_m,
        "threshold_deg": config.max_hand_eye_deg,
    }
    if T_tool_mount is not None:
        offset_m, offset_deg = mount_offset(mount, T_tool_mount)
        numbers |= {"mount_offset_m": offset_m, "mount_offset_deg": offset_deg}
        passed &= offset_m <= config.max_mount_offset_m and offset_deg <= config.max_mount_offset_deg
    return Verdict("calibration", passed, numbers)


def detect_fixed_camera(T_base_camera: np.ndarray, config: CalibrationConfig) -> Verdict:
    """Checks that a camera stays at one place in the base frame."""
    _, metres_95, degrees_95 = _residual_95(np.eye(4)[None].repeat(len(T_base_camera), axis=0), T_base_camera)
    return Verdict(
        "calibration",
        metres_95 <= config.max_hand_eye_m and degrees_95 <= config.max_hand_eye_deg,
        {"moved_m": metres_95, "turned_deg": degrees_95},
    )


def _residual_95(T_base_tool: np.ndarray, T_base_camera: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Mean mount, and the 95th percentiles of the deviations from it [m] and [deg]."""
    mount, metres, degrees = hand_eye_residual(T_base_tool, T_base_camera)
    return mount, float(np.percentile(metres, 95)), float(np.percentile(degrees, 95))


_UNEXPLAINED = "calibration_unexplained"
_MIN_FRAMES = 4
"""Fewer frames in a row are too little evidence."""


def detect_mistake(
    episode: Episode, gray: Mapping[str, np.ndarray], bad_frames: np.ndarray, config: FilterDoctorConfig
) -> Verdict:
    """Checks that the calibration is consistent; if not, gives the explanation and the line that repairs it.

    Args:
        gray: by view, uint8 (n, h, w).
        bad_frames: bool (n,), frames that other detectors dropped; the longest stretch without any is judged.
    """
    start, stop = max(runs(~bad_frames), key=lambda stretch: stretch[1] - stretch[0], default=(0, 0))
    step = max(1, round(episode.fps / config.rate_hz))
    if stop - start < _MIN_FRAMES * step:
        return Verdict(_UNEXPLAINED, True, {"verdict": "too_little_evidence"})
    start, stop = _liveliest(episode, start, stop, step * config.max_frames)
    if (start, stop, step) != (0, len(bad_frames), 1):
        episode = episode.cut(start, stop, step)
        gray = {view: images[start:stop:step] for view, images in gray.items()}
    diagnosis = diagnose(episode, gray, kinematics_of(episode), quick=True)
    reason = _UNEXPLAINED
    if diagnosis.verdict == "explained":
        lags = all(field.endswith("lag_frames") for field in diagnosis.best.departures)
        reason = "time_alignment" if lags else "calibration"
    elif diagnosis.verdict == "unexplained" and diagnosis.ranked[0].lag_at_edge:
        reason = "time_alignment"
    # A camera that is off is an estimate, and one episode's fingers are a weak sign of polarity: both warn.
    unsure = diagnosis.verdict == "off" or diagnosis.best.departures == ("gripper",)
    return Verdict(
        reason,
        unsure or diagnosis.verdict in ("consistent", "too_little_evidence"),
        _numbers(diagnosis, step) | {"first_frame": start, "every_frame": step},
    )


def _liveliest(episode: Episode, start: int, stop: int, length: int) -> tuple[int, int]:
    """The `length` consecutive frames of start..stop whose states change most; all of a shorter stretch."""
    if stop - start <= length:
        return start, stop
    change = np.abs(np.diff(episode.state[start:stop].astype(np.float64), axis=0)).sum(axis=1)
    until = np.concatenate([[0.0], np.cumsum(change)])
    first = start + int((until[length - 1 :] - until[: len(until) - length + 1]).argmax())
    return first, first + length


def _numbers(diagnosis: Diagnosis, step: int) -> Numbers:
    numbers: Numbers = {
        "verdict": diagnosis.verdict,
        "mistake": diagnosis.best.mistake,
        "score_as_recorded": diagnosis.as_recorded.score,
        "threshold_margin": MIN_MARGIN,
    }
    if diagnosis.verdict == "explained":
        # Lags were found in every step-th frame; the source counts its own.
        found = diagnosis.best.conventions
        lags = {field: step * getattr(found, field) for field in found.departures if "_lag_" in field}
        other = diagnosis.best.other
        lines = found.model_copy(update=lags).config_lines() if other is None else (": ".join(other),)
        numbers |= {"score_repaired": diagnosis.best.score, "config": "; ".join(lines)}
    for view, each in [(error.view, each) for error in diagnosis.camera_errors for each in error.kinds]:
        kind = f"{view} {each.kind}"
        numbers |= {f"{kind} [{each.unit}]": round(each.size, 3), f"{kind} unseen up to": round(each.bound, 3)}
    for view, why in diagnosis.not_judged.items():
        numbers[f"{view} not judged"] = why
    if diagnosis.best.departures == ("gripper",):
        numbers["warning"] = "polarity is judged over a source: worldline calibrate check, then the line `config`"
    if diagnosis.off:
        numbers |= {"off": "; ".join(map(str, diagnosis.off))}
    if diagnosis.verdict == "unexplained":
        bad = bad_terms(diagnosis.as_recorded)
        nearest = "; ".join(diagnosis.nearest)
        numbers |= {"bad": ", ".join(sorted(bad, key=lambda name: bad[name])), "nearest": nearest}
    return numbers


def kinematics_of(episode: Episode) -> ArmKinematics | None:
    """Kinematics of the embodiment; None where its description is missing or the recording has another layout."""
    kinematics = known_kinematics(episode.embodiment)
    if kinematics is None:
        return None
    embodiment, poses = kinematics.embodiment, episode.T_base_ee
    if poses is not None and poses.shape[1] != len(embodiment.arms):
        return None
    fits = episode.state_kind != "joints" or episode.state.shape[1] == embodiment.state_size
    return kinematics if fits else None


def find_calibration_faults(signals: Signals, config: FilterConfig, _: Sequence[Finding]) -> list[Finding]:
    """Checks each camera alone, then wrist cameras against their tools, then cameras that should not move."""
    tools = signals.calibrated_tools
    if tools is None:
        return []
    thresholds, frames = config.calibration, np.arange(len(tools))
    cameras = signals.episode.cameras
    findings: list[Finding] = []
    for view, camera in cameras.items():
        verdict = detect_camera(camera.K, camera.T_base_camera, camera.width, camera.height, thresholds)
        findings.append(Finding("camera", view, 2, verdict))
    for arm, camera in signals.wrist_cameras:
        poses = camera.poses(frames)
        if camera.moving and np.isfinite(poses).all():
            verdict = detect_hand_eye(tools[:, arm], poses, signals.arms[arm].T_tool_mount, thresholds)
            findings.append(Finding("hand_eye", camera.view, 2, verdict))
    wrists = {arm.wrist_view for arm in signals.arms}
    for view, camera in cameras.items():
        if view not in wrists and camera.moving and np.isfinite(camera.T_base_camera).all():
            verdict = detect_fixed_camera(camera.T_base_camera[: len(frames)], thresholds)
            findings.append(Finding("fixed_camera", view, 2, verdict))
    return findings


def find_mistake(signals: Signals, config: FilterConfig, found: Sequence[Finding]) -> list[Finding]:
    """Runs the doctor on an episode that Stage I keeps; for others the calibration does not matter."""
    if signals.calibrated_tools is None or any(f.stage == 1 and not f.verdict.passed for f in found):
        return []
    bad = bad_frames(found, len(signals.gray[signals.primary_view]))
    return [Finding("doctor", None, 2, detect_mistake(signals.episode, signals.gray, bad, config.doctor))]
