"""Numbers about the views of a recording as it was written, and remarks on what they mean."""

from __future__ import annotations

import numpy as np

from worldline_core.calibration.diagnosis import ViewMeasures
from worldline_core.calibration.gripper_evidence import finger_flow, stopped_share
from worldline_core.calibration.hypotheses import camera_lag_scores
from worldline_core.calibration.image_evidence import (
    energy_correlation,
    observable_views,
    still_view_agreement,
    wrist_flow_agreement,
)
from worldline_core.calibration.observation import Observation
from worldline_core.calibration.pose_evidence import in_view_share, mount_offset, principal_point_offset, rms_hand_eye
from worldline_core.calibration.reading import Reading
from worldline_core.calibration.thresholds import COMMANDS_FIT_RATIO, NOTICEABLE_M, CalibrationDoctorConfig
from worldline_core.data.episodes.episode import CameraTrack


def view_measures(
    observation: Observation, recorded: Reading, config: CalibrationDoctorConfig
) -> tuple[ViewMeasures, ...]:
    """One entry a calibrated view."""
    seen = observable_views(observation, config)
    return tuple(
        _measure(observation, recorded, camera, camera.view in seen, config) for camera in recorded.cameras.values()
    )


def _measure(
    observation: Observation, recorded: Reading, camera: CameraTrack, seen: bool, config: CalibrationDoctorConfig
) -> ViewMeasures:
    view = camera.view
    values: dict[str, float | None] = {
        "principal_point_offset": max(abs(offset) for offset in principal_point_offset(camera)),
        "in_view_share": in_view_share(recorded, camera),
        "image_lag_frames": image_lag(observation, recorded, view, config) if seen else None,
    }
    own = [i for i, arm in enumerate(observation.arms) if arm.wrist_view == view]
    if not own:
        if seen:
            flow, change, turn_deg = still_view_agreement(observation, recorded, view)
            values |= {"flow_agreement": flow, "motion_overlap": change, "flow_turn_deg": turn_deg}
        return ViewMeasures(view, **values)
    i = own[0]
    poses = camera.poses(np.arange(len(recorded.tools)))
    mount, values["hand_eye_m"], values["hand_eye_deg"] = rms_hand_eye(recorded.tools[:, i], poses)
    if recorded.action_tools is not None:
        _, values["hand_eye_action_m"], values["hand_eye_action_deg"] = rms_hand_eye(recorded.action_tools[:, i], poses)
    stated = observation.arms[i].T_tool_mount
    if stated is not None:
        values["mount_offset_m"], values["mount_offset_deg"] = mount_offset(mount, stated)
    values["camera_lag_frames"] = refined_peak(camera_lag_scores(observation, recorded, recorded.tools, config, view))
    if seen:
        values["flow_agreement"] = wrist_flow_agreement(observation, recorded, view)
    values["finger_flow"] = finger_flow(observation, recorded, i, config)
    return ViewMeasures(view, **values)


def refined_peak(scores: dict[int, float]) -> float | None:
    """Place of the largest score, between whole numbers by a parabola; None where all are alike."""
    if len(scores) < 3 or max(scores.values()) - min(scores.values()) < 1.0:
        return None
    best = max(scores, key=lambda lag: (scores[lag], -abs(lag)))
    if best - 1 not in scores or best + 1 not in scores:
        return float(best)
    left, middle, right = scores[best - 1], scores[best], scores[best + 1]
    curvature = left - 2 * middle + right
    return float(best) if curvature > -1e-9 else float(best + 0.5 * (left - right) / curvature)


def image_lag(observation: Observation, recorded: Reading, view: str, config: CalibrationDoctorConfig) -> float | None:
    """Shift at which the picture's change follows the motion best; None where no shift does."""
    largest = min(config.max_lag_frames, observation.num_images // 3)
    scores: dict[int, float] = {}
    wrist = any(arm.wrist_view == view for arm in observation.arms)
    for lag in range(-largest, largest + 1):
        shifted = recorded.with_image_lag(lag)
        energy = energy_correlation(observation, shifted, view)
        scores[lag] = energy if wrist else energy + still_view_agreement(observation, shifted, view)[0]
    if not scores or max(scores.values()) < 0.5:
        return None
    return refined_peak({lag: 100 * score for lag, score in scores.items()})


def notes_on(
    observation: Observation,
    recorded: Reading,
    measures: tuple[ViewMeasures, ...],
    config: CalibrationDoctorConfig,
) -> tuple[str, ...]:
    """What a person should know besides the verdict."""
    notes = []
    for m in measures:
        if m.hand_eye_m is None or m.hand_eye_action_m is None:
            continue
        if m.hand_eye_m > NOTICEABLE_M and m.hand_eye_m > COMMANDS_FIT_RATIO * m.hand_eye_action_m:
            notes.append(
                f"{m.view}: the camera poses follow the commands ({1e3 * m.hand_eye_action_m:.1f} mm), "
                f"not the states ({1e3 * m.hand_eye_m:.1f} mm)"
            )
    for view in recorded.cameras:
        count = len(observation.gray.get(view, ()))
        if count <= config.min_image_pairs:
            notes.append(f"{view}: {count} pictures, too few to compare motion with; judged by poses alone")
    if recorded.gripper is None:
        notes.append("gripper: the state names no gripper columns, polarity is not judged")
    for i, arm in enumerate(observation.arms if recorded.gripper is not None else ()):
        if finger_flow(observation, recorded, i, config) is None and stopped_share(recorded, i) is None:
            notes.append(f"gripper {arm.name}: does not move enough to be seen, polarity is not judged")
    return tuple(notes)
