"""What a recording as written measures to: numbers per view, and the usual mistakes to try with what they suggest.

Most mistakes have one fixed value; a lag, an image size or a tool offset is estimated first.
"""

from __future__ import annotations

import numpy as np

from worldline_core.calibration.diagnosis import CalibrationDoctorConfig, ViewMeasures
from worldline_core.calibration.image_evidence import (
    energy_correlation,
    finger_flow,
    observable_views,
    still_view_agreement,
    stopped_share,
    wrist_flow_agreement,
)
from worldline_core.calibration.observation import Observation
from worldline_core.calibration.pose_evidence import (
    hand_eye_log_likelihood,
    in_view_share,
    mount_offset,
    principal_point_offset,
    rms_hand_eye,
)
from worldline_core.calibration.reading import Reading
from worldline_core.data.episodes.conventions import RecordedConventions, applicable
from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.geometry.transforms import rigid_inverse

INTRINSICS_SNAP, SAME_INTRINSICS_SIZE = 0.02, 0.1
"""Relative distance within which a usual image size is taken; log distance within which the size is as recorded."""
MIN_TOOL_OFFSET_M, MAX_TOOL_OFFSET_M = 0.01, 0.5
COMMANDS_FIT_RATIO, NOTICEABLE_M = 3.0, 0.001
"""Camera poses follow the commands when their residual against the states is larger by this ratio, and noticeable."""
_COMMON_SIZES = (
    (1080, 1920), (1200, 1920), (720, 1280), (800, 1280), (960, 1280), (768, 1024), (600, 960), (600, 800), (540, 960),
    (480, 848), (480, 640), (400, 640), (384, 640), (360, 640), (384, 512), (270, 480), (240, 424), (240, 320),
    (192, 320), (180, 320), (256, 256), (224, 224), (128, 128), (120, 160), (128, 192), (96, 128), (64, 96),
)  # fmt: skip


def conventions_to_try(
    observation: Observation, recorded: Reading, config: CalibrationDoctorConfig
) -> list[RecordedConventions]:
    """One mistake each, without image lags (see `image_lags`), most of them with a fixed value."""
    fixed = [
        RecordedConventions(extrinsics="base_to_camera"),
        RecordedConventions(camera_axes="opengl"),
        RecordedConventions(extrinsics_unit="mm"),
        RecordedConventions(pose_unit="mm"),
        RecordedConventions(quaternion="wxyz"),
        RecordedConventions(euler="moving_xyz"),
        RecordedConventions(angle_unit="deg"),
        RecordedConventions(arms="exchanged"),
        RecordedConventions(gripper="inverted"),
    ]
    episode = observation.episode
    found = [c for c in fixed if applicable(episode, c.departures[0]) and _possible(observation, c)]
    found += [RecordedConventions(intrinsics_size=size) for size in intrinsics_sizes(episode.cameras)]
    found += [RecordedConventions(camera_lag_frames=lag) for lag in camera_lags(observation, recorded, config)]
    offset = tool_offset(observation, recorded)
    if offset is not None:
        found.append(RecordedConventions(tool_offset_z_m=round(offset, 4)))
    return found


def _possible(observation: Observation, conventions: RecordedConventions) -> bool:
    kinematics = observation.kinematics
    if conventions.arms == "exchanged" and kinematics is not None:
        sizes = {len(arm.joints) for arm in kinematics.embodiment.arms}
        return len(sizes) == 1 or observation.episode.state_kind != "joints"
    return True


def image_lags(observation: Observation, config: CalibrationDoctorConfig) -> list[int]:
    """Lags to try; at most a third of the pictures is given up."""
    largest = min(config.max_lag_frames, observation.num_images // 3)
    return [lag for size in range(1, largest + 1) for lag in (size, -size)]


def camera_lags(observation: Observation, recorded: Reading, config: CalibrationDoctorConfig) -> list[int]:
    """The lag at which moving wrist cameras are most rigid, and its neighbours; empty where none moves.

    Cameras may follow the states or the commands, so both are asked.
    """
    lags: list[int] = []
    for tools in (recorded.tools, recorded.action_tools):
        scores = {} if tools is None else camera_lag_scores(observation, recorded, tools, config)
        if scores:
            best = max(scores, key=lambda lag: (scores[lag], -abs(lag)))
            lags += [lag for lag in (best, best - 1, best + 1) if lag in scores]
    return [lag for lag in dict.fromkeys(lags) if lag != 0]


def camera_lag_scores(
    observation: Observation,
    recorded: Reading,
    tools: np.ndarray,
    config: CalibrationDoctorConfig,
    view: str | None = None,
) -> dict[int, float]:
    """Log-likelihood of the hand-eye residuals at each shift of the camera poses after the tools' (n, a, 4, 4)."""
    largest = min(config.max_lag_frames, len(tools) // 3)
    scores: dict[int, float] = {}
    for i, arm in enumerate(observation.arms):
        camera = recorded.cameras.get(arm.wrist_view)
        if camera is None or not camera.moving or view not in (None, arm.wrist_view):
            continue
        for lag in range(-largest, largest + 1):
            _, metres, degrees = rms_hand_eye(*lagged(tools[:, i], camera.T_base_camera, lag))
            scores[lag] = scores.get(lag, 0.0) + hand_eye_log_likelihood(metres, degrees, config)
    return scores


def intrinsics_sizes(cameras: dict[str, CameraTrack]) -> list[tuple[int, int]]:
    """Image sizes (height, width) that would put a camera's principal point into the middle, where it is elsewhere."""
    sizes: list[tuple[int, int]] = []
    for camera in cameras.values():
        K = camera.K
        height, width = 2 * K[1, 2] + 1, 2 * K[0, 2] + 1
        same = abs(np.log(max(height, 1.0) / camera.height)) + abs(np.log(max(width, 1.0) / camera.width))
        if not np.isfinite(K).all() or min(height, width) < 8 or same < SAME_INTRINSICS_SIZE:
            continue
        common = [s for s in _COMMON_SIZES if max(abs(s[0] / height - 1), abs(s[1] / width - 1)) < INTRINSICS_SNAP]
        size = min(common, key=lambda s: abs(s[0] / height - 1) + abs(s[1] / width - 1), default=None)
        size = size or (round(height), round(width))
        if size not in sizes:
            sizes.append(size)
    return sizes


def tool_offset(observation: Observation, recorded: Reading) -> float | None:
    """How far the fingertips lie beyond the recorded tool poses along +z [m].

    From the joints' kinematics where the recording has both, else from wrist cameras whose mount is stated; None where
    neither is known, where no poses are recorded (the tool is then the embodiment's, and moves with its stated mount),
    or where the offset is within what mounts scatter.
    """
    offsets: list[float] = []
    if observation.episode.T_base_ee is None:
        return None
    if recorded.kinematic_tools is not None:
        apart = rigid_inverse(recorded.tools) @ recorded.kinematic_tools
        offsets = [float(np.median(apart[:, i, 2, 3])) for i in range(apart.shape[1])]
    else:
        for i, arm in enumerate(observation.arms):
            camera = recorded.cameras.get(arm.wrist_view)
            if arm.T_tool_mount is None or camera is None:
                continue
            mount, _, _ = rms_hand_eye(recorded.tools[:, i], camera.poses(np.arange(len(recorded.tools))))
            offsets.append(float(mount[2, 3] - arm.T_tool_mount[2, 3]))
    if not offsets:
        return None
    offset = float(np.median(offsets))
    return offset if MIN_TOOL_OFFSET_M <= abs(offset) <= MAX_TOOL_OFFSET_M else None


def view_measures(
    observation: Observation, recorded: Reading, config: CalibrationDoctorConfig
) -> tuple[ViewMeasures, ...]:
    """One entry per calibrated view."""
    seen = observable_views(observation, config)
    return tuple(
        _measure(observation, recorded, camera, camera.view in seen, config) for camera in recorded.cameras.values()
    )


def _measure(
    observation: Observation, recorded: Reading, camera: CameraTrack, seen: bool, config: CalibrationDoctorConfig
) -> ViewMeasures:
    view = camera.view
    values: dict[str, float | None] = {
        "principal_point_offset": max(map(abs, principal_point_offset(camera.K, camera.width, camera.height))),
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


def lagged(first: np.ndarray, second: np.ndarray, lag: int) -> tuple[np.ndarray, np.ndarray]:
    """The entries of two series that belong together where the second trails the first by `lag` frames."""
    return first[max(0, -lag) : len(first) - max(0, lag)], second[max(0, lag) : len(second) - max(0, -lag)]


def parabola_peak(left: float, middle: float, right: float) -> float:
    """Where the parabola through values at -1, 0 and 1 is highest; 0 where it has no peak."""
    curvature = left - 2 * middle + right
    return 0.5 * (left - right) / curvature if curvature < -1e-9 else 0.0


def refined_peak(scores: dict[int, float]) -> float | None:
    """Place of the largest score, between whole numbers by a parabola; None where all are alike."""
    if len(scores) < 3 or max(scores.values()) - min(scores.values()) < 1.0:
        return None
    best = max(scores, key=lambda lag: (scores[lag], -abs(lag)))
    if best - 1 not in scores or best + 1 not in scores:
        return float(best)
    return best + parabola_peak(scores[best - 1], scores[best], scores[best + 1])


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
    observation: Observation, recorded: Reading, measures: tuple[ViewMeasures, ...], config: CalibrationDoctorConfig
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
