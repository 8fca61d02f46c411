"""What the pictures say about a reading: do they move where, how and when the calibration predicts?

In a view that stands still, the projected motion of the robot's points is compared with optical flow and with image
change. In a wrist view, the flow of the scene that the camera's own motion predicts (rotation exactly, translation up to
one depth per step) with the measured one. In any view, the speed of what moves it with the amount of change, over time.
At the end the grippers: does 1 mean open?
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from worldline_core.calibration.diagnosis import CalibrationDoctorConfig, Spread, Typical
from worldline_core.calibration.observation import CELL_PX, Motion, Observation, cell_centres
from worldline_core.calibration.reading import Reading, predict_motion
from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.geometry.cameras import project_points
from worldline_core.geometry.transforms import lengths, rigid_inverse

WORST_TURN_TERM = -12.0
MIN_STEP_PX = 0.7
"""Predicted motion of a cell that flow is compared with."""
FOLLOWS_CORRELATION = 0.5
"""Above it an angle between measured and predicted flow means something."""
INVERSE_DEPTHS_PER_M = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)
"""Of the scene before a wrist camera, tried one by one."""
MIN_TEXTURE, MIN_CHANGE = 4.0, 5.0
"""Grey levels: where flow can be measured, and where there is any."""
LARGEST_FLOW_ERROR_PX = 8.0

MIN_OPENING_RANGE = 0.12
"""Over the episode: a smaller one moves no finger visibly, and noise stays below."""
MIN_OPENING_STEP = 0.02
"""Per frame, of a gripper that moves."""
FULL_OPENING_STEPS = 16
"""Steps with a moving gripper from which its signs have their whole weight: a few may fall together with something else."""
FINGER_REACH_M, FINGER_LENGTH_M = 0.06, 0.12
FULL_CHANGE = 20.0
"""Grey levels from which a cell has its whole weight."""
MIN_FINGER_STEP_PX = 0.15
STOPPED_GAP, STOPPED_STEP = 0.1, 0.01
"""A stopped gripper: opening away from its command by more, and changing by less per frame."""
STOPPED_TERM, LARGEST_DEVIATIONS = -10.0, 4.0


def image_terms(
    observation: Observation, reading: Reading, config: CalibrationDoctorConfig, *, wrist_flow: bool = True
) -> dict[str, float]:
    """Log-likelihood terms by name; a term of a view ends with the view's name.

    Args:
        wrist_flow: whether to compute the most expensive term, the flow that wrist cameras should see.

    Which terms exist does not depend on the reading, so that readings can be compared.
    """
    terms = {}
    wrists = {arm.wrist_view: i for i, arm in enumerate(observation.arms)}
    for view in observable_views(observation, config):
        if view in wrists and wrist_flow:
            flow = wrist_flow_agreement(observation, reading, view)
            terms[f"wrist flow {view}"] = correlation_log_likelihood(flow, config.wrist_flow)
        elif view not in wrists:
            flow, change, turn_deg = still_view_agreement(observation, reading, view)
            terms[f"turn {view}"] = turn_log_likelihood(turn_deg, config)
            terms[f"flow {view}"] = correlation_log_likelihood(
                flow, config.arm_flow if reading.whole_arms else config.tool_flow
            )
            terms[f"change {view}"] = correlation_log_likelihood(
                change, config.arm_change if reading.whole_arms else config.tool_change
            )
        terms[f"energy {view}"] = correlation_log_likelihood(
            energy_correlation(observation, reading, view), config.wrist_energy
        )
    return terms


def observable_views(observation: Observation, config: CalibrationDoctorConfig) -> list[str]:
    """Calibrated views with enough pictures in which something moves; views that should stand still must do so."""
    wrists = {arm.wrist_view for arm in observation.arms}
    views = []
    for view in observation.episode.cameras:
        if view not in observation.gray or len(observation.gray[view]) <= config.min_image_pairs:
            continue
        if (view in wrists or observation.stands_still(view)) and observation.motion(view).moves:
            views.append(view)
    return views


def correlation_log_likelihood(correlation: float, typical: Typical) -> float:
    """Of a correlation, as of a Gaussian's residual, relative to a typical recording; below 0 nothing gets worse."""
    r = float(np.clip(correlation, 0.0, 0.995))
    return typical.samples / 2 * float(np.log(1 - typical.value**2) - np.log(1 - r**2))


def turn_log_likelihood(turn_deg: float, config: CalibrationDoctorConfig) -> float:
    """Of the angle by which measured flow is turned against the predicted."""
    return max(WORST_TURN_TERM, -0.5 * (turn_deg / config.flow_turn_deg) ** 2)


def still_view_agreement(observation: Observation, reading: Reading, view: str) -> tuple[float, float, float]:
    """How a view that stands still agrees with the robot's predicted motion.

    Returns:
        Correlation of predicted with measured flow where motion is predicted; correlation of predicted with measured
        change; angle [deg] by which the flow is turned as a whole, 0 where it does not follow at all. All 0 where the
        reading predicts no motion in the picture.
    """
    states, images = reading.steps(observation.num_images)
    motion, predicted = observation.motion(view), reading.predicted(view)
    step, vector = predicted.step[states], predicted.vector[states]
    flow, change = motion.flow[images], motion.change[images]
    moving = step > MIN_STEP_PX
    if moving.sum() < 20:
        return 0.0, 0.0, 0.0
    measured, expected = flow[moving], vector[moving]
    # One outlier of a hundred pixels must not outweigh a thousand cells.
    expected = expected * np.minimum(1.0, 20.0 / np.maximum(lengths(expected)[:, None], 1e-9))
    agreement = cosine(measured, expected)
    across = cosine(measured, np.stack([-expected[:, 1], expected[:, 0]], axis=-1))
    follows = np.hypot(agreement, across) > FOLLOWS_CORRELATION
    turn_deg = float(np.degrees(np.arctan2(across, agreement))) if follows else 0.0
    x, y = np.log1p(np.minimum(step, 20.0)).ravel(), np.log1p(change).ravel()
    if x.std() < 1e-9 or y.std() < 1e-9:
        return agreement, 0.0, turn_deg
    return agreement, float(np.corrcoef(x, y)[0, 1]), turn_deg


def cosine(a: np.ndarray, b: np.ndarray) -> float:
    """Of two arrays as one vector each; 0 where one vanishes."""
    norm = float(np.sqrt((a**2).sum() * (b**2).sum()))
    return float((a * b).sum()) / norm if norm > 1e-9 else 0.0


def wrist_flow_agreement(observation: Observation, reading: Reading, view: str) -> float:
    """Correlation of the flow that the camera's motion predicts with the measured one, on cells that show a change."""
    camera, motion = reading.cameras[view], observation.motion(view)
    states, images = reading.steps(observation.num_images)
    if not camera.moving:
        return 0.0
    key = b"".join((camera.T_base_camera.tobytes(), camera.K.tobytes(), repr((states, images)).encode()))
    if key not in motion.agreements:
        motion.agreements[key] = _wrist_flow_agreement(camera, motion, states, images)
    return motion.agreements[key]


def _wrist_flow_agreement(camera: CameraTrack, motion: Motion, states: slice, images: slice) -> float:
    poses = camera.T_base_camera
    T_next_this = (rigid_inverse(poses[1:]) @ poses[:-1])[states]
    keep = (motion.texture[images] > MIN_TEXTURE) & (motion.change[images] > MIN_CHANGE)
    centres, inverse_depths = cell_centres(camera.height, camera.width), np.array(INVERSE_DEPTHS_PER_M)
    rays = np.concatenate([centres, np.ones((*centres.shape[:2], 1))], axis=-1) @ np.linalg.inv(camera.K).T
    measured, expected = [], []
    for T, flow, cells in zip(T_next_this, motion.flow[images], keep, strict=True):
        if cells.sum() < 3:
            continue
        turned = rays[cells] @ T[:3, :3].T
        moved = (turned[None] + inverse_depths[:, None, None] * T[:3, 3]) @ camera.K.T
        ahead = moved[..., 2:] > 0.1
        step = np.where(ahead, moved[..., :2] / np.where(ahead, moved[..., 2:], 1.0) - centres[cells], 0.0)
        error = np.minimum(lengths(step - flow[cells]), LARGEST_FLOW_ERROR_PX).sum(axis=1)
        best = step[error.argmin()]
        expected.append(best * np.minimum(1.0, 20.0 / np.maximum(lengths(best)[:, None], 1e-9)))
        measured.append(flow[cells])
    if sum(len(cells) for cells in measured) < 50:
        return 0.0
    return cosine(np.concatenate(measured), np.concatenate(expected))


def energy_correlation(observation: Observation, reading: Reading, view: str) -> float:
    """Correlation over time of the speed of what moves a view (its own arm, or the fastest) with its mean change."""
    states, images = reading.steps(observation.num_images)
    own = [i for i, arm in enumerate(observation.arms) if arm.wrist_view == view]
    speed = reading.tool_speed[:, own or slice(None)].max(axis=1)[states]
    return correlation(speed, observation.motion(view).mean_change[images])


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's, 0 where one does not vary."""
    if len(a) < 8 or a.std() < 1e-9 or b.std() < 1e-9:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])


def gripper_terms(observation: Observation, reading: Reading, config: CalibrationDoctorConfig) -> dict[str, float]:
    """Log-likelihood terms by name; none where no gripper moves."""
    terms = {}
    for i, arm in enumerate(observation.arms):
        for name, found, typical in _signs(observation, reading, i, config):
            terms[f"{name} {arm.wrist_view}"] = _weight(reading, i) * _log_likelihood(found, typical)
        stopped = stopped_share(reading, i)
        if stopped is not None:
            terms[f"stopped gripper {arm.name}"] = STOPPED_TERM * (1 - stopped)
    return terms


def inversion_gain(observation: Observation, reading: Reading, config: CalibrationDoctorConfig) -> float:
    """By how much the terms would rise, about, if 1 meant closed: each sign changes its sign."""
    gain = 0.0
    for i in range(len(observation.arms)):
        for _, found, typical in _signs(observation, reading, i, config):
            gain += _weight(reading, i) * (_log_likelihood(-found, typical) - _log_likelihood(found, typical))
        stopped = stopped_share(reading, i)
        gain += 0.0 if stopped is None else STOPPED_TERM * (2 * stopped - 1)
    return gain


def _signs(
    observation: Observation, reading: Reading, arm: int, config: CalibrationDoctorConfig
) -> list[tuple[str, float, Spread]]:
    """(name, correlation, what is typical) of what the pictures show of the fingers."""
    away, along = finger_flow(observation, reading, arm, config), finger_agreement(observation, reading, arm, config)
    return [
        (name, found, typical)
        for name, found, typical in (("fingers", away, config.fingers), ("finger links", along, config.finger_links))
        if found is not None
    ]


def _weight(reading: Reading, arm: int) -> float:
    """Share of the whole weight that the signs of a gripper deserve that moves in few steps; the same for all readings."""
    if reading.gripper is None:
        return 0.0
    moving = np.abs(np.diff(reading.gripper[:, arm])) > MIN_OPENING_STEP
    return min(1.0, float(moving.sum()) / FULL_OPENING_STEPS)


def _log_likelihood(correlation: float, typical: Spread) -> float:
    return -0.5 * min(((correlation - typical.value) / typical.spread) ** 2, LARGEST_DEVIATIONS**2)


def finger_agreement(
    observation: Observation, reading: Reading, arm: int, config: CalibrationDoctorConfig
) -> float | None:
    """Correlation (-1..1) of measured flow with the flow of the finger links by kinematics, in the wrist view.

    None where the gripper does not move, or the finger joints are not known.
    """
    view = observation.arms[arm].wrist_view
    kinematics = observation.kinematics
    if kinematics is None or not kinematics.embodiment.arms[arm].gripper.finger_joints or not reading.whole_arms:
        return None
    if not _moves(observation, reading, arm, config):
        return None
    camera, tool = reading.cameras[view], reading.tools[:, arm, :3, 3]
    near = np.median(lengths(reading.points - tool[:, None]), axis=0) < FINGER_LENGTH_M
    T_camera_base = rigid_inverse(camera.poses(np.arange(len(tool))))
    points = reading.points[:, near] @ np.swapaxes(T_camera_base[:, :3, :3], 1, 2) + T_camera_base[:, None, :3, 3]
    fixed = replace(camera, T_base_camera=np.eye(4)[None])
    predicted = predict_motion(points, reading.radii[near], fixed)
    states, images = reading.steps(observation.num_images)
    moving = predicted.step[states] > MIN_FINGER_STEP_PX
    if moving.sum() < 10:
        return 0.0  # whether there is a term must not depend on the reading
    return cosine(observation.motion(view).flow[images][moving], predicted.vector[states][moving])


def _moves(observation: Observation, reading: Reading, arm: int, config: CalibrationDoctorConfig) -> bool:
    """Whether a gripper moves before its own camera."""
    view = observation.arms[arm].wrist_view
    if reading.gripper is None or view not in observation.gray or view not in reading.cameras:
        return False
    return (
        bool(np.ptp(reading.gripper[:, arm]) >= MIN_OPENING_RANGE)
        and len(observation.gray[view]) > config.min_image_pairs
    )


def finger_flow(observation: Observation, reading: Reading, arm: int, config: CalibrationDoctorConfig) -> float | None:
    """Correlation (-1..1) of the flow away from the projected tool point, near it, with the growth of the opening."""
    view = observation.arms[arm].wrist_view
    if reading.gripper is None or not _moves(observation, reading, arm, config):
        return None
    opening = np.diff(reading.gripper[:, arm])
    states, images = reading.steps(observation.num_images)
    motion, camera = observation.motion(view), reading.cameras[view]
    poses = camera.poses(np.arange(len(reading.tools)))
    uv, depth = project_points(reading.tools[:, arm, :3, 3], camera.K, poses)
    point, near = np.median(uv, axis=0), float(np.median(depth))
    if near < 0.01 or not np.isfinite(point).all():
        return 0.0
    away = cell_centres(camera.height, camera.width) - point
    distance = lengths(away)
    close = (distance < camera.K[0, 0] * FINGER_REACH_M / near) & (distance > CELL_PX / 4)
    if close.sum() < 4:
        return 0.0
    outward = (motion.flow[images] * (away / np.maximum(distance, 1.0)[..., None])).sum(-1)
    weight = close * np.minimum(motion.change[images], FULL_CHANGE) / FULL_CHANGE
    spread, growth = (outward * weight).sum(axis=(1, 2)), opening[states]
    moves = np.abs(growth) > MIN_OPENING_STEP
    # Over all steps, flow that comes without a moving finger counts against; over the others it does not.
    return (cosine(spread, growth) + cosine(spread[moves], growth[moves])) / 2


def stopped_share(reading: Reading, arm: int) -> float | None:
    """Of the frames in which a gripper rests away from its command: share in which it is the more open of the two."""
    if reading.gripper is None or reading.gripper_command is None:
        return None
    opening, command = reading.gripper[:, arm], reading.gripper_command[:, arm]
    gap = opening - command
    rests = (
        (np.abs(np.gradient(opening)) < STOPPED_STEP)
        & (np.abs(gap) > STOPPED_GAP)
        & (np.abs(np.gradient(command)) < STOPPED_STEP)
    )
    return float((gap[rests] > 0).mean()) if rests.sum() >= 4 else None
