"""What the pictures say about a reading: does the image move where, how and when the calibration predicts?

Three comparisons. In a view that stands still, the projected motion of the robot's points against optical flow and
against image change. In a wrist view, the flow of the scene that the camera's own motion predicts (rotation exactly,
translation up to one depth a step) against the measured one. In any view, the speed of what moves it against the
amount of change, over time.
"""

from __future__ import annotations

import numpy as np

from worldline_core.calibration.observation import Observation, cell_centres
from worldline_core.calibration.reading import Reading
from worldline_core.calibration.thresholds import (
    FOLLOWS_CORRELATION,
    INVERSE_DEPTHS_PER_M,
    LARGEST_FLOW_ERROR_PX,
    MIN_CHANGE,
    MIN_STEP_PX,
    MIN_TEXTURE,
    WORST_TURN_TERM,
    CalibrationDoctorConfig,
    Typical,
)
from worldline_core.geometry.transforms import rigid_inverse


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
    expected = expected * np.minimum(1.0, 20.0 / np.maximum(np.linalg.norm(expected, axis=-1, keepdims=True), 1e-9))
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
        error = np.minimum(np.linalg.norm(step - flow[cells], axis=-1), LARGEST_FLOW_ERROR_PX).sum(axis=1)
        best = step[error.argmin()]
        length = np.linalg.norm(best, axis=-1, keepdims=True)
        expected.append(best * np.minimum(1.0, 20.0 / np.maximum(length, 1e-9)))
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
