"""What poses alone say about a reading: rigid mounts, stated mounts, plausible places, kinematics against records."""

from __future__ import annotations

import numpy as np

from worldline_core.calibration.diagnosis import CalibrationDoctorConfig
from worldline_core.calibration.observation import Arm, Observation
from worldline_core.calibration.reading import Reading
from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.geometry.cameras import MIN_DEPTH_M, inside_image, project_points
from worldline_core.geometry.rotations import rotation_angle_deg
from worldline_core.geometry.transforms import hand_eye_residual, rigid_inverse

WORST_TERM, WORST_HAND_EYE_TERM, WORST_FACING_TERM = -40.0, -60.0, -15.0
FOLLOWS_COMMANDS_COST = 2.0
"""Of camera poses that follow the commands rather than the states."""
FACING_DEG, FACING_SPREAD_DEG = 45.0, 10.0
"""Between a wrist camera's axis and the direction to its tool."""


def pose_terms(observation: Observation, reading: Reading, config: CalibrationDoctorConfig) -> dict[str, float]:
    """Log-likelihood terms by name; a term of a view ends with the view's name. Images do not matter here."""
    terms = {"workspace": _workspace(reading, config)}
    if observation.episode.state_kind == "joints":
        terms["joint range"] = _joint_range(observation, reading)
    if reading.kinematic_tools is not None:
        terms["kinematics"] = _kinematics(reading.kinematic_tools, reading.tools, config)
    wrists = {arm.wrist_view: (i, arm) for i, arm in enumerate(observation.arms)}
    for view, camera in reading.cameras.items():
        terms[f"intrinsics {view}"] = _intrinsics(camera, config)
        terms[f"camera place {view}"] = _place(camera.T_base_camera, config)
        if view in wrists:
            i, arm = wrists[view]
            terms |= _wrist(reading, camera, i, arm, config)
        else:
            terms[f"in view {view}"] = _in_view(reading, camera)
            terms[f"upright {view}"] = _upright(camera)
    return terms


def rms_hand_eye(T_base_tool: np.ndarray, T_base_camera: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Mean mount (4, 4), and root mean square deviation from it, [m] and [deg]."""
    mount, metres, degrees = hand_eye_residual(T_base_tool, T_base_camera)
    return mount, float(np.sqrt((metres**2).mean())), float(np.sqrt((degrees**2).mean()))


def hand_eye_log_likelihood(metres: float, degrees: float, config: CalibrationDoctorConfig) -> float:
    """Log-likelihood of a hand-eye residual, with a heavy tail: frames of one recording are not independent."""
    value = (metres / config.hand_eye_m) ** 2 + (degrees / config.hand_eye_deg) ** 2
    return max(WORST_HAND_EYE_TERM, -config.samples / 2 * float(np.log1p(value)))


def _quadratic(*ratios: float) -> float:
    return max(WORST_TERM, -0.5 * float(sum(ratio**2 for ratio in ratios)))


def _wrist(
    reading: Reading, camera: CameraTrack, i: int, arm: Arm, config: CalibrationDoctorConfig
) -> dict[str, float]:
    view = camera.view
    poses = camera.poses(np.arange(len(reading.tools)))
    mount, metres, degrees = rms_hand_eye(reading.tools[:, i], poses)
    residual_term = hand_eye_log_likelihood(metres, degrees, config)
    if reading.action_tools is not None:
        _, by_action_m, by_action_deg = rms_hand_eye(reading.action_tools[:, i], poses)
        followed = hand_eye_log_likelihood(by_action_m, by_action_deg, config) - FOLLOWS_COMMANDS_COST
        residual_term = max(residual_term, followed)
    terms = {f"hand-eye {view}": residual_term}
    if arm.T_tool_mount is not None:
        offset, turned = mount_offset(mount, arm.T_tool_mount)
        terms[f"mount {view}"] = _quadratic(offset / config.mount_m, turned / config.mount_deg)
    # Whatever the mount: a wrist camera is near its tool and looks at it.
    tool = rigid_inverse(mount)[:3, 3]
    distance = float(np.linalg.norm(tool))
    off_axis = float(np.degrees(np.arctan2(np.hypot(tool[0], tool[1]), tool[2])))
    far = max(0.0, np.log(max(distance, 1e-6) / config.max_wrist_camera_m)) / 0.2
    aside = max(0.0, off_axis - FACING_DEG) / FACING_SPREAD_DEG
    terms[f"faces its tool {view}"] = max(WORST_FACING_TERM, _quadratic(far, aside))
    return terms


def mount_offset(mount: np.ndarray, stated: np.ndarray) -> tuple[float, float]:
    """Between two mounts (4, 4): [m] and [deg]."""
    return (
        float(np.linalg.norm(mount[:3, 3] - stated[:3, 3])),
        float(rotation_angle_deg(mount[:3, :3].T @ stated[:3, :3])),
    )


def _intrinsics(camera: CameraTrack, config: CalibrationDoctorConfig) -> float:
    u, v = principal_point_offset(camera.K, camera.width, camera.height)
    fields = fields_of_view_deg(camera.K, camera.width, camera.height)
    odd = max(0.0, (20.0 - min(fields)) / 3, (max(fields) - 140.0) / 5)
    return _quadratic(u / config.principal_point, v / config.principal_point, odd)


def principal_point_offset(K: np.ndarray, width: int, height: int) -> tuple[float, float]:
    """From the image centre along u and v, in shares of the image side."""
    return float((K[0, 2] - (width - 1) / 2) / width), float((K[1, 2] - (height - 1) / 2) / height)


def fields_of_view_deg(K: np.ndarray, width: int, height: int) -> tuple[float, float]:
    """Horizontal and vertical field of view."""
    return (
        float(np.degrees(2 * np.arctan2(width, 2 * K[0, 0]))),
        float(np.degrees(2 * np.arctan2(height, 2 * K[1, 1]))),
    )


def _place(T_base_camera: np.ndarray, config: CalibrationDoctorConfig) -> float:
    distance = float(np.median(np.linalg.norm(T_base_camera[:, :3, 3], axis=1)))
    return _quadratic(max(0.0, np.log(max(distance, 1e-6) / config.max_camera_m)) / 0.2)


def in_view_share(reading: Reading, camera: CameraTrack) -> float:
    """Share of frames with some arm's tool in the picture, in front of the camera."""
    poses = camera.poses(np.arange(len(reading.tools)))
    inside = np.zeros(len(reading.tools), dtype=bool)
    for i in range(reading.tools.shape[1]):
        uv, depth = project_points(reading.tools[:, i, :3, 3], camera.K, poses)
        inside |= (depth > MIN_DEPTH_M) & inside_image(uv, (camera.height, camera.width))
    return float(inside.mean())


def _in_view(reading: Reading, camera: CameraTrack) -> float:
    return -30.0 * max(0.0, 0.6 - in_view_share(reading, camera))


def _upright(camera: CameraTrack) -> float:
    """Pictures are taken the right way up: the image's down is not the base's up."""
    up = float(np.median(camera.T_base_camera[:, 2, 1]))
    return -6.0 * float(np.clip((up - 0.2) / 0.3, 0.0, 1.0))


def _workspace(reading: Reading, config: CalibrationDoctorConfig) -> float:
    distance = np.linalg.norm(reading.tools[..., :3, 3], axis=-1)
    return WORST_TERM * float((distance > config.max_reach_m).mean())


def _joint_range(observation: Observation, reading: Reading) -> float:
    """Joint positions beyond the robot's limits, or beyond two turns where no limits are known."""
    state = reading.episode.state.astype(np.float64)
    if observation.kinematics is not None:
        outside = observation.kinematics.embodiment.outside_limits(state, tolerance_rad=0.1)
    else:
        outside = np.abs(state) > 4 * np.pi
    return WORST_TERM * float(np.clip(outside.any(axis=1).mean(), 0.0, 1.0))


def _kinematics(by_joints: np.ndarray, recorded: np.ndarray, config: CalibrationDoctorConfig) -> float:
    """Recorded tool poses against those that the joints give: median distance over frames, the worst arm."""
    apart = rigid_inverse(by_joints) @ recorded
    metres = np.median(np.linalg.norm(apart[..., :3, 3], axis=-1), axis=0).max()
    degrees = np.median(rotation_angle_deg(apart[..., :3, :3]), axis=0).max()
    return _quadratic(float(metres) / config.kinematics_m, float(degrees) / config.kinematics_deg)
