"""Does 1 mean open? Three signs: fingers move away from the tool's axis while the opening grows; they move as the
finger joints' kinematics says; a gripper that is stopped by an object rests more open than commanded, never more closed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from worldline_core.calibration.image_evidence import cosine
from worldline_core.calibration.observation import CELL_PX, Observation, cell_centres
from worldline_core.calibration.reading import Reading, predict_motion
from worldline_core.calibration.thresholds import (
    FINGER_LENGTH_M,
    FINGER_REACH_M,
    FULL_CHANGE,
    LARGEST_DEVIATIONS,
    MIN_FINGER_STEP_PX,
    MIN_OPENING_RANGE,
    MIN_OPENING_STEP,
    STOPPED_GAP,
    STOPPED_STEP,
    STOPPED_TERM,
    CalibrationDoctorConfig,
    Spread,
)
from worldline_core.geometry.cameras import project_points
from worldline_core.geometry.transforms import rigid_inverse


def gripper_terms(observation: Observation, reading: Reading, config: CalibrationDoctorConfig) -> dict[str, float]:
    """Log-likelihood terms by name; none where no gripper moves."""
    terms = {}
    for i, arm in enumerate(observation.arms):
        for name, found, typical in _signs(observation, reading, i, config):
            terms[f"{name} {arm.wrist_view}"] = _log_likelihood(found, typical)
        stopped = stopped_share(reading, i)
        if stopped is not None:
            terms[f"stopped gripper {arm.name}"] = STOPPED_TERM * (1 - stopped)
    return terms


def inversion_gain(observation: Observation, reading: Reading, config: CalibrationDoctorConfig) -> float:
    """By how much the terms would rise, about, if 1 meant closed: each sign changes its sign."""
    gain = 0.0
    for i in range(len(observation.arms)):
        for _, found, typical in _signs(observation, reading, i, config):
            gain += _log_likelihood(-found, typical) - _log_likelihood(found, typical)
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
    near = np.median(np.linalg.norm(reading.points - tool[:, None], axis=-1), axis=0) < FINGER_LENGTH_M
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
    distance = np.linalg.norm(away, axis=-1)
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
