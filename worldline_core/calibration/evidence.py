"""Evidence for a reading of an episode: terms of a log-likelihood; 0 is as in a healthy recording, lower is worse.

Poses: rigid mounts, stated mounts, plausible places, kinematics against records. Pictures, in a fixed view: the projected
motion of the robot's points against optical flow and image change; in a wrist view: the flow of the scene that the
camera's own motion predicts (rotation exactly, translation up to one depth for each step); in any view: the speed of what
moves it against the amount of change. Grippers: does 1 mean open? Typical values are medians over healthy shipped recordings.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from worldline_core.calibration.observation import (
    CELL_PX,
    CLEAR_CHANGE,
    LONGEST_STEP_PX,
    Observation,
    Reading,
    cell_centres,
    predict_motion,
)
from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.geometry.cameras import MIN_DEPTH_M, inside_image, project_points
from worldline_core.geometry.transforms import hand_eye_residual, lengths, rigid_inverse, rotation_angle_deg

# Poses; standard deviations of healthy recordings, unless they are limits.
WORST_TERM, WORST_HAND_EYE_TERM, WORST_FACING_TERM = -40.0, -60.0, -15.0
HAND_EYE_M, HAND_EYE_DEG, HAND_EYE_SAMPLES = 0.002, 0.7, 20.0
MOUNT_M, MOUNT_DEG = 0.01, 3.0
KINEMATICS_M, KINEMATICS_DEG = 0.005, 2.0
PRINCIPAL_POINT = 0.03
"""From the image centre, in shares of the side."""
MAX_REACH_M, MAX_CAMERA_M, MAX_WRIST_CAMERA_M = 2.5, 5.0, 0.5
"""Tool from base, camera from base, wrist camera from its tool."""
FOLLOWS_COMMANDS_COST = 2.0
"""Camera poses may follow the commands rather than the states."""
FACING_DEG, FACING_SPREAD_DEG = 45.0, 10.0
"""Between a wrist camera's axis and the direction to its tool."""

# Pictures.
MIN_IMAGE_PAIRS = 8
"""Fewer pictures are no evidence."""
ARM_FLOW, ARM_CHANGE, WRIST_FLOW, WRIST_ENERGY = (0.92, 20.0), (0.74, 20.0), (0.55, 12.0), (0.8, 8.0)
"""A correlation that healthy recordings reach, and the number of independent samples behind it."""
TOOL_FLOW, TOOL_CHANGE = (0.96, 14.0), (0.5, 14.0)
"""The same where only tool poses are recorded."""
FINGERS, FINGER_LINKS = (0.75, 0.4), (0.5, 0.3)
"""Correlation that healthy recordings reach, and its standard deviation."""
FLOW_TURN_DEG, WORST_TURN_TERM = 8.0, -12.0
MIN_STEP_PX = 0.7
"""Smallest predicted motion of a cell that flow is compared with."""
FOLLOWS_CORRELATION, FOLLOWS_WELL = 0.5, 0.75
"""An angle between measured and predicted flow means nothing below the first, and has its full weight from the second on."""
FULL_CELLS = 600
"""Cells with a clear change for a still view's motion to have its full weight."""
INVERSE_DEPTHS_PER_M = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)
"""Scene before a wrist camera, tried one by one."""
MIN_TEXTURE, MIN_CHANGE = 4.0, 5.0
"""Grey levels: where flow can be measured, and where there is any."""
LARGEST_FLOW_ERROR_PX = 8.0
FROZEN_CHANGE, FROZEN_TRAVEL_M, FROZEN_WRIST_TRAVEL_M = 0.5, 0.1, 0.15
"""Grey levels in any cell, and travel of the arm meanwhile [m]: a video that shows the same picture on and on."""
# Grippers.
MIN_OPENING_RANGE = 0.12
"""Over the episode: a smaller one moves no finger visibly, and noise stays below."""
MIN_OPENING_STEP = 0.02
"""Per frame, of a gripper that moves."""
FULL_OPENING_STEPS = 16
"""Steps with a moving gripper for its signs to have their full weight."""
FINGER_REACH_M, FINGER_LENGTH_M = 0.06, 0.12
FULL_CHANGE = 20.0
"""Grey levels from which a cell has its full weight."""
MIN_FINGER_STEP_PX = 0.15
STOPPED_GAP, STOPPED_STEP = 0.1, 0.01
"""A stopped gripper: opening away from its command by more, and changing by less per frame."""
STOPPED_TERM, LARGEST_DEVIATIONS = -10.0, 4.0


def pose_terms(observation: Observation, reading: Reading) -> dict[str, float]:
    """Log-likelihood terms of the poses by name; a term of a view ends with the view's name."""
    terms = {"workspace": WORST_TERM * float((lengths(reading.tools[..., :3, 3]) > MAX_REACH_M).mean())}
    if observation.episode.state_kind == "joints":
        terms["joint range"] = _joint_range(observation, reading)
    if reading.kinematic_tools is not None:
        terms["kinematics"] = _kinematics(reading.kinematic_tools, reading.tools)
    for view, camera in reading.cameras.items():
        terms[f"intrinsics {view}"] = _intrinsics(camera)
        distance = float(np.median(np.linalg.norm(camera.T_base_camera[:, :3, 3], axis=1)))
        terms[f"camera place {view}"] = _quadratic(_beyond(distance, MAX_CAMERA_M))
        if view in observation.wrists:
            terms |= _wrist(observation, reading, camera)
        else:
            terms[f"in view {view}"] = -30.0 * max(0.0, 0.6 - in_view_share(reading, camera))
            # Pictures are taken the right way up: the image's down does not point upwards.
            up = float(np.median(camera.T_base_camera[:, 2, 1]))
            terms[f"upright {view}"] = -6.0 * float(np.clip((up - 0.2) / 0.3, 0.0, 1.0))
    return terms


def hand_eye(T_base_tool: np.ndarray, T_base_camera: np.ndarray) -> tuple[np.ndarray, float]:
    """Mean mount (4, 4) of a wrist camera on its tool, and the log-likelihood of the deviations from it."""
    mount, *deviations = hand_eye_residual(T_base_tool, T_base_camera)
    return mount, hand_eye_log_likelihood(*(float(np.sqrt((each**2).mean())) for each in deviations))


def hand_eye_log_likelihood(metres: float, degrees: float) -> float:
    """Log-likelihood of a hand-eye residual, heavy-tailed because frames of one recording are not independent."""
    value = (metres / HAND_EYE_M) ** 2 + (degrees / HAND_EYE_DEG) ** 2
    return max(WORST_HAND_EYE_TERM, -HAND_EYE_SAMPLES / 2 * float(np.log1p(value)))


def _quadratic(*ratios: float) -> float:
    return max(WORST_TERM, -0.5 * float(sum(ratio**2 for ratio in ratios)))


def _wrist(observation: Observation, reading: Reading, camera: CameraTrack) -> dict[str, float]:
    view, i = camera.view, observation.wrists[camera.view]
    mount, rigid = hand_eye(reading.tools[:, i], camera.T_base_camera)
    if reading.action_tools is not None:
        rigid = max(rigid, hand_eye(reading.action_tools[:, i], camera.T_base_camera)[1] - FOLLOWS_COMMANDS_COST)
    terms = {f"hand-eye {view}": rigid}
    if (stated := observation.arms[i].T_tool_mount) is not None:
        offset, turned = mount_offset(mount, stated)
        terms[f"mount {view}"] = _quadratic(offset / MOUNT_M, turned / MOUNT_DEG)
    # Wherever it is mounted, a wrist camera is near its tool and looks at it.
    tool = rigid_inverse(mount)[:3, 3]
    off_axis = float(np.degrees(np.arctan2(np.hypot(tool[0], tool[1]), tool[2])))
    aside = max(0.0, off_axis - FACING_DEG) / FACING_SPREAD_DEG
    far = _beyond(float(np.linalg.norm(tool)), MAX_WRIST_CAMERA_M)
    terms[f"faces its tool {view}"] = max(WORST_FACING_TERM, _quadratic(far, aside))
    return terms


def _beyond(distance: float, limit: float) -> float:
    """Deviations by which a distance is above a limit."""
    return max(0.0, np.log(max(distance, 1e-6) / limit)) / 0.2


def mount_offset(mount: np.ndarray, stated: np.ndarray) -> tuple[float, float]:
    """Distance and angle between two mounts (4, 4), [m] and [deg]."""
    angle = rotation_angle_deg(mount[:3, :3].T @ stated[:3, :3])
    return float(np.linalg.norm(mount[:3, 3] - stated[:3, 3])), float(angle)


def _intrinsics(camera: CameraTrack) -> float:
    u, v = principal_point_offset(camera.K, camera.width, camera.height)
    fields = fields_of_view_deg(camera.K, camera.width, camera.height)
    odd = max(0.0, (20.0 - min(fields)) / 3, (max(fields) - 140.0) / 5)
    return _quadratic(u / PRINCIPAL_POINT, v / PRINCIPAL_POINT, odd)


def principal_point_offset(K: np.ndarray, width: int, height: int) -> tuple[float, float]:
    """Offset from the image centre along u and v, in shares of the image side."""
    return float((K[0, 2] - (width - 1) / 2) / width), float((K[1, 2] - (height - 1) / 2) / height)


def fields_of_view_deg(K: np.ndarray, width: int, height: int) -> tuple[float, float]:
    """Horizontal and vertical field of view."""
    horizontal, vertical = (np.degrees(2 * np.arctan2(n, 2 * f)) for n, f in ((width, K[0, 0]), (height, K[1, 1])))
    return float(horizontal), float(vertical)


def in_view_share(reading: Reading, camera: CameraTrack) -> float:
    """Share of frames with some arm's tool in the picture, in front of the camera."""
    places = np.moveaxis(reading.tools[..., :3, 3], 1, 0)
    seen = [project_points(arm, camera.K, camera.T_base_camera) for arm in places]
    inside = [(depth > MIN_DEPTH_M) & inside_image(uv, (camera.height, camera.width)) for uv, depth in seen]
    return float(np.any(inside, axis=0).mean())


def _joint_range(observation: Observation, reading: Reading) -> float:
    """Low for joints beyond the robot's limits, or beyond two turns where no limits are known."""
    state, kinematics = reading.episode.state.astype(np.float64), observation.kinematics
    outside = np.abs(state) > 4 * np.pi
    if kinematics is not None:
        outside = kinematics.embodiment.outside_limits(state, tolerance_rad=0.1)
    return WORST_TERM * float(outside.any(axis=1).mean())


def _kinematics(by_joints: np.ndarray, recorded: np.ndarray) -> float:
    """Median distance over frames of recorded tool poses from those of the joints, for the worst arm."""
    apart = rigid_inverse(by_joints) @ recorded
    metres = np.median(np.linalg.norm(apart[..., :3, 3], axis=-1), axis=0).max()
    degrees = np.median(rotation_angle_deg(apart[..., :3, :3]), axis=0).max()
    return _quadratic(float(metres) / KINEMATICS_M, float(degrees) / KINEMATICS_DEG)


def image_terms(observation: Observation, reading: Reading, *, wrist_flow: bool = True) -> dict[str, float]:
    """Log-likelihood terms of the pictures by name; a term of a view ends with the view's name.

    The set of terms does not depend on the reading. `wrist_flow` is the most expensive term.
    """
    terms = {}
    for view in observable_views(observation):
        if view in observation.wrists and wrist_flow:
            flow = wrist_flow_agreement(observation, reading, view)
            terms[f"wrist flow {view}"] = correlation_log_likelihood(flow, WRIST_FLOW)
        elif view not in observation.wrists:
            flow, change, turn_deg = still_view_agreement(observation, reading, view)
            typical = (ARM_FLOW, ARM_CHANGE) if reading.shape != "hands" else (TOOL_FLOW, TOOL_CHANGE)
            clear = int((observation.motion(view).change > CLEAR_CHANGE).sum())
            weight = min(1.0, clear / FULL_CELLS)  # the same for all readings
            terms[f"turn {view}"] = weight * turn_log_likelihood(turn_deg)
            terms[f"flow {view}"] = weight * correlation_log_likelihood(flow, typical[0])
            terms[f"change {view}"] = weight * correlation_log_likelihood(change, typical[1])
        speed, changes = speed_and_change(observation, reading, view)
        energy = correlation(speed, changes.mean(axis=(1, 2))) if len(speed) >= 8 else 0.0
        terms[f"energy {view}"] = correlation_log_likelihood(energy, WRIST_ENERGY)
    return terms


def unseen(observation: Observation, view: str) -> str | None:
    """The reason why a calibrated view's pictures say nothing of motion; None where they do. A view of no hand must stand still."""
    count = len(observation.gray.get(view, ()))
    if count <= MIN_IMAGE_PAIRS:
        return f"{count} pictures are too few to compare motion with"
    if view not in observation.wrists and view not in observation.still_views:
        return "its camera moves, and no hand carries it"
    return None if observation.motion(view).moves else "its pictures do not change"


def observable_views(observation: Observation) -> list[str]:
    """Calibrated views whose pictures show motion."""
    return [view for view in observation.episode.cameras if unseen(observation, view) is None]


def not_judged(observation: Observation) -> dict[str, str]:
    """By calibrated view, why its pictures say nothing about its camera."""
    found = {}
    for view, camera in observation.episode.cameras.items():
        fixed = view in observation.wrists and not camera.moving
        if why := unseen(observation, view) or ("its camera has one pose, though its hand moves" if fixed else None):
            found[view] = why
    return found


def frozen_views(observation: Observation, reading: Reading) -> list[str]:
    """Views whose pictures stay the same through several steps in which what they show travels far."""
    found = []
    for view in observation.episode.cameras:
        if len(observation.gray.get(view, ())) > MIN_IMAGE_PAIRS:
            speed, change = speed_and_change(observation, reading, view)
            travel = longest = 0.0
            for still, step in zip(change.max(axis=(1, 2)) < FROZEN_CHANGE, speed, strict=True):
                travel = travel + step if still else 0.0
                longest = max(longest, travel)
            if longest > (FROZEN_WRIST_TRAVEL_M if view in observation.wrists else FROZEN_TRAVEL_M):
                found.append(view)
    return found


def speed_and_change(observation: Observation, reading: Reading, view: str) -> tuple[np.ndarray, np.ndarray]:
    """Speed (s,) of the arm that moves a view, its own or the fastest, and change of the view's cells (s, r, c), at every step."""
    states, images = reading.steps(observation.num_images, view)
    own = observation.wrists.get(view)
    speed = reading.tool_speed.max(axis=1) if own is None else reading.tool_speed[:, own]
    return speed[states], observation.motion(view).change[images]


def correlation_log_likelihood(correlation: float, typical: tuple[float, float]) -> float:
    """Log-likelihood of a Gaussian residual with this correlation, relative to a typical recording; flat below 0."""
    r, (value, samples) = float(np.clip(correlation, 0.0, 0.995)), typical
    return samples / 2 * float(np.log(1 - value**2) - np.log(1 - r**2))


def turn_log_likelihood(turn_deg: float) -> float:
    """Log-likelihood of an angle between measured and predicted flow."""
    return max(WORST_TURN_TERM, -0.5 * (turn_deg / FLOW_TURN_DEG) ** 2)


def still_view_agreement(observation: Observation, reading: Reading, view: str) -> tuple[float, float, float]:
    """Agreement of a fixed view with the robot's predicted motion; all 0 without predicted motion in the picture.

    Returns: correlations of predicted with measured flow and change; angle [deg] by which the flow is turned as a whole,
        smaller where it hardly follows, and 0 where it does not.
    """
    motion = observation.motion(view)
    states, images = reading.steps(observation.num_images, view)
    predicted = reading.predicted(view)[states]
    length = lengths(predicted)
    moving = length > MIN_STEP_PX
    if moving.sum() < 20:
        return 0.0, 0.0, 0.0
    measured, expected = motion.flow[images][moving], shortened(predicted[moving])
    agreement = cosine(measured, expected)
    across = cosine(measured, np.stack([-expected[:, 1], expected[:, 0]], axis=-1))
    follows = (np.hypot(agreement, across) - FOLLOWS_CORRELATION) / (FOLLOWS_WELL - FOLLOWS_CORRELATION)
    turn_deg = float(np.degrees(np.arctan2(across, agreement)) * np.sqrt(np.clip(follows, 0.0, 1.0)))
    speed = np.log1p(np.minimum(length, LONGEST_STEP_PX))
    return agreement, correlation(speed.ravel(), np.log1p(motion.change[images]).ravel()), turn_deg


def shortened(steps: np.ndarray) -> np.ndarray:
    """Steps (..., 2) [px] of at most LONGEST_STEP_PX."""
    return steps * np.minimum(1.0, LONGEST_STEP_PX / np.maximum(lengths(steps)[..., None], 1e-9))


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's correlation of two series; 0 where one does not vary."""
    return float(np.corrcoef(a, b)[0, 1]) if min(np.std(a), np.std(b)) > 1e-9 else 0.0


def cosine(a: np.ndarray, b: np.ndarray) -> float:
    """Cosine of the angle between two arrays taken as vectors; 0 where one vanishes."""
    norm = float(np.sqrt((a**2).sum() * (b**2).sum()))
    return float((a * b).sum()) / norm if norm > 1e-9 else 0.0


def wrist_flow_agreement(observation: Observation, reading: Reading, view: str) -> float:
    """Correlation of measured flow with the one that the camera's motion predicts, on cells that show a change."""
    camera, motion = reading.cameras[view], observation.motion(view)
    if not camera.moving:
        return 0.0
    states, images = reading.steps(observation.num_images, view)
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
        expected.append(shortened(step[error.argmin()]))
        measured.append(flow[cells])
    if sum(len(cells) for cells in measured) < 50:
        return 0.0
    return cosine(np.concatenate(measured), np.concatenate(expected))


def gripper_terms(observation: Observation, reading: Reading) -> dict[str, float]:
    """Log-likelihood terms of the grippers by name; none where none moves."""
    terms: dict[str, float] = {}
    if reading.gripper is None:
        return terms
    for i, arm in enumerate(observation.arms):
        view, opening = arm.wrist_view, reading.gripper[:, i]
        seen = view in reading.cameras and len(observation.gray.get(view, ())) > MIN_IMAGE_PAIRS
        if seen and np.ptp(opening) >= MIN_OPENING_RANGE:
            # A few moving steps may coincide with something else; the weight is the same for all readings.
            steps = np.diff(opening)
            weight = min(1.0, float((np.abs(steps) > MIN_OPENING_STEP).sum()) / FULL_OPENING_STEPS)
            flow, links = finger_flow(observation, reading, i, steps), finger_agreement(observation, reading, i)
            for name, found, (typical, spread) in (("fingers", flow, FINGERS), ("finger links", links, FINGER_LINKS)):
                if found is not None:
                    deviations = min(((found - typical) / spread) ** 2, LARGEST_DEVIATIONS**2)
                    terms[f"{name} {view}"] = -0.5 * weight * deviations
        if (stopped := stopped_share(reading, i)) is not None:
            terms[f"stopped gripper {arm.name}"] = STOPPED_TERM * (1 - stopped)
    return terms


def finger_agreement(observation: Observation, reading: Reading, arm: int) -> float | None:
    """Correlation (-1..1) of measured flow in the wrist view with that of the finger links by kinematics, None if unknown."""
    view, kinematics = observation.arms[arm].wrist_view, observation.kinematics
    if kinematics is None or not kinematics.embodiment.arms[arm].gripper.finger_joints or reading.shape == "hands":
        return None
    states, images = reading.steps(observation.num_images, view)
    name, camera, flow = f"fingers {arm}", reading.cameras[view], observation.motion(view).flow[images]
    if name not in reading.predictions:
        tool, (points, radii) = reading.tools[:, arm, :3, 3], reading.capsules
        near = np.median(lengths(points - tool[:, None]), axis=0) < FINGER_LENGTH_M
        T_camera_base = rigid_inverse(camera.T_base_camera)
        points = points[:, near] @ np.swapaxes(T_camera_base[:, :3, :3], 1, 2) + T_camera_base[:, None, :3, 3]
        fixed = replace(camera, T_base_camera=np.eye(4)[None])
        reading.predictions[name] = predict_motion(points, radii[near], fixed)
    predicted = reading.predictions[name][states]
    moving = lengths(predicted) > MIN_FINGER_STEP_PX
    if moving.sum() < 10:
        return 0.0  # whether there is a term must not depend on the reading
    return cosine(flow[moving], predicted[moving])


def finger_flow(observation: Observation, reading: Reading, arm: int, opening: np.ndarray) -> float | None:
    """Correlation (-1..1) of the flow away from the projected tool point, near it, with the steps (n - 1,) of the opening."""
    view, kinematics = observation.arms[arm].wrist_view, observation.kinematics
    if kinematics is not None and len(kinematics.embodiment.arms[arm].gripper.finger_joints) == 1:
        return None  # one jaw moves, so flow is not away from the middle
    states, images = reading.steps(observation.num_images, view)
    motion, camera = observation.motion(view), reading.cameras[view]
    uv, depth = project_points(reading.tools[:, arm, :3, 3], camera.K, camera.T_base_camera)
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
    """Share of frames with a gripper more open than its command, among those in which it rests away from it.

    An object stops a closing gripper, never an opening one.
    """
    if reading.gripper is None or reading.gripper_command is None:
        return None
    opening, command = reading.gripper[:, arm], reading.gripper_command[:, arm]
    gap = opening - command
    still = np.maximum(np.abs(np.gradient(opening)), np.abs(np.gradient(command))) < STOPPED_STEP
    rests = still & (np.abs(gap) > STOPPED_GAP)
    return float((gap[rests] > 0).mean()) if rests.sum() >= 4 else None
