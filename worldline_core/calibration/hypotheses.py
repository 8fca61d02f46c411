"""The usual mistakes as conventions to try, with their free numbers (a lag, a size, an offset) estimated first."""

from __future__ import annotations

import numpy as np

from worldline_core.calibration.observation import Observation
from worldline_core.calibration.pose_evidence import hand_eye_log_likelihood, rms_hand_eye
from worldline_core.calibration.reading import Reading
from worldline_core.calibration.thresholds import (
    INTRINSICS_SNAP,
    MAX_TOOL_OFFSET_M,
    MIN_TOOL_OFFSET_M,
    SAME_INTRINSICS_SIZE,
    CalibrationDoctorConfig,
)
from worldline_core.data.episodes.conventions import RecordedConventions, applicable
from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.geometry.transforms import rigid_inverse

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
            a, b = tools[max(0, -lag) : len(tools) - max(0, lag), i], camera.T_base_camera
            _, metres, degrees = rms_hand_eye(a, b[max(0, lag) : len(b) - max(0, -lag)])
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
