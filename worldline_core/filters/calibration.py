"""Calibration: K is plausible, camera poses are rigid, wrist cameras are fixed to their arm, fixed cameras stay fixed.

The calibration doctor is a detector as well: no usual mistake explains the recording better than its own calibration
does. An explained mistake also excludes the episode from Stage II: its evidence names the configuration line that repairs
the source, and nothing is repaired silently.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from worldline_core.calibration.calibration_doctor import diagnose
from worldline_core.calibration.diagnosis import Diagnosis, bad_terms
from worldline_core.calibration.evidence import fields_of_view_deg, mount_offset, principal_point_offset
from worldline_core.data.episodes.episode import Episode
from worldline_core.filters.filter_config import CalibrationConfig, FilterConfig, FilterDoctorConfig
from worldline_core.filters.signals import Signals, known_kinematics
from worldline_core.filters.verdict import Finding, Numbers, Verdict, bad_frames, runs
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import hand_eye_residual


def detect_camera(
    K: np.ndarray, T_base_camera: np.ndarray, width: int, height: int, config: CalibrationConfig
) -> Verdict:
    """Whether K and the poses (n, 4, 4) are plausible for a camera with this image size."""
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
    """Whether a wrist camera is rigidly fixed to its tool, and where the embodiment says.

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
    """Whether a camera that should stand still in the base frame does."""
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
    """Whether the recording's calibration is consistent; if not, the explanation and the line that repairs it.

    Args:
        gray: by view, uint8 (n, h, w).
        bad_frames: bool (n,), frames that other detectors dropped; the longest stretch without any is judged.
    """
    stretches = runs(~bad_frames)
    if not stretches:
        return Verdict(_UNEXPLAINED, True, {"verdict": "too_little_evidence"})
    start, stop = max(stretches, key=lambda stretch: stretch[1] - stretch[0])
    step = max(1, round(episode.fps / config.rate_hz))
    if stop - start < _MIN_FRAMES * step:
        return Verdict(_UNEXPLAINED, True, {"verdict": "too_little_evidence"})
    start, stop = _liveliest(episode, start, stop, step * config.max_frames)
    if (start, stop, step) != (0, len(bad_frames), 1):
        episode = episode.cut(start, stop, step)
        gray = {view: images[start:stop:step] for view, images in gray.items()}
    diagnosis = diagnose(episode, gray, kinematics_of(episode), config)
    reason = _UNEXPLAINED
    if diagnosis.verdict == "explained":
        lags = all(field.endswith("lag_frames") for field in diagnosis.best.departures)
        reason = "time_alignment" if lags else "calibration"
    elif diagnosis.verdict == "off":
        reason = "time_alignment" if all(error.kind == "lag" for error in diagnosis.off) else "calibration"
    return Verdict(
        reason,
        diagnosis.verdict in ("consistent", "too_little_evidence"),
        _numbers(diagnosis, config, step) | {"first_frame": start, "every_frame": step},
    )


def _liveliest(episode: Episode, start: int, stop: int, length: int) -> tuple[int, int]:
    """Of frames start..stop the `length` consecutive ones whose states change most; all of a shorter stretch."""
    if stop - start <= length:
        return start, stop
    change = np.abs(np.diff(episode.state[start:stop].astype(np.float64), axis=0)).sum(axis=1)
    until = np.concatenate([[0.0], np.cumsum(change)])
    first = start + int((until[length - 1 :] - until[: len(until) - length + 1]).argmax())
    return first, first + length


def _numbers(diagnosis: Diagnosis, config: FilterDoctorConfig, step: int) -> Numbers:
    numbers: Numbers = {
        "verdict": diagnosis.verdict,
        "mistake": diagnosis.best.mistake,
        "score_as_recorded": diagnosis.as_recorded.score,
        "threshold_margin": config.min_margin,
    }
    if diagnosis.verdict == "explained":
        # Lags were found in every step-th frame; the source counts its own.
        found = diagnosis.best.conventions
        lags = {field: step * getattr(found, field) for field in found.departures if "_lag_" in field}
        other = diagnosis.best.other
        lines = found.model_copy(update=lags).config_lines() if other is None else (": ".join(other),)
        numbers |= {"score_repaired": diagnosis.best.score, "config": "; ".join(lines)}
    for error in diagnosis.camera_errors:
        kind = f"{error.view} {error.kind}"
        numbers |= {f"{kind} [{error.unit}]": round(error.size, 3), f"{kind} unseen up to": round(error.bound, 3)}
    if diagnosis.off:
        numbers |= {"off": "; ".join(map(str, diagnosis.off))}
    if diagnosis.verdict == "unexplained":
        bad = bad_terms(diagnosis.as_recorded, config)
        nearest = "; ".join(diagnosis.nearest)
        numbers |= {"bad": ", ".join(sorted(bad, key=lambda name: bad[name])), "nearest": nearest}
    return numbers


def kinematics_of(episode: Episode) -> ArmKinematics | None:
    """Of the episode's embodiment; None where it or its description is not known, or the recording has another layout."""
    kinematics = known_kinematics(episode.embodiment)
    if kinematics is None:
        return None
    embodiment, poses = kinematics.embodiment, episode.T_base_ee
    if poses is not None and poses.shape[1] != len(embodiment.arms):
        return None
    fits = episode.state_kind != "joints" or episode.state.shape[1] == embodiment.state_size
    return kinematics if fits else None


def find_calibration_faults(signals: Signals, config: FilterConfig, _: Sequence[Finding]) -> list[Finding]:
    """Of each camera alone, then of wrist cameras against their tools, then of cameras that should stand still."""
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
    """Of an episode that Stage I keeps; of any other the calibration does not matter."""
    if signals.calibrated_tools is None or any(f.stage == 1 and not f.verdict.passed for f in found):
        return []
    bad = bad_frames(found, len(signals.gray[signals.primary_view]))
    return [Finding("doctor", None, 2, detect_mistake(signals.episode, signals.gray, bad, config.doctor))]
