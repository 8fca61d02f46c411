from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from worldline_core.filters.base_motion import BaseMotionConfig, background_flow, detect_base_motion
from worldline_core.filters.calibration import (
    CalibrationConfig,
    detect_camera,
    detect_fixed_camera,
    detect_hand_eye,
)
from worldline_core.filters.corrupted import CorruptedConfig, detect_corrupted, neighbour_correlation
from worldline_core.filters.projection import (
    ProjectionConfig,
    detect_projection,
)
from worldline_core.filters.reset import ResetConfig, detect_reset
from worldline_core.filters.static import StaticConfig, detect_static
from worldline_core.filters.time_alignment import (
    TimeAlignmentConfig,
    detect_image_lag,
    detect_pose_lag,
    lag_by_correlation,
)
from worldline_core.filters.verdict import runs
from worldline_core.geometry.rigid import hand_eye_residual, inside_image, mean_pose, project_points, rigid_inverse

FPS = 8.0


def swing(num_frames: int = 33) -> np.ndarray:
    """Joint positions (n, 3) of a smooth motion that begins and ends slowly."""
    time = np.arange(num_frames) / FPS
    return np.stack([0.6 * (1 - np.cos(time)), 0.4 * np.sin(1.3 * time), 0.2 * np.sin(0.7 * time) ** 2], axis=1)


def arm_poses(num_frames: int = 33) -> np.ndarray:
    time = np.arange(num_frames) / FPS
    poses = np.tile(np.eye(4), (num_frames, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler(
        "xyz", np.stack([0.4 * np.sin(time), 0.3 * time, 0.2 * time**2 / 4], 1)
    ).as_matrix()
    poses[:, :3, 3] = np.stack([0.4 + 0.15 * np.sin(time), 0.2 * np.cos(0.8 * time), 0.3 + 0.05 * np.sin(2 * time)], 1)
    return poses


MOUNT = np.eye(4)
MOUNT[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.4, 0.2]).as_matrix()
MOUNT[:3, 3] = [0.05, 0.0, -0.1]


def scene(
    num_frames: int = 33, height: int = 64, width: int = 96, *, drift: float = 0.0, centres: np.ndarray | None = None
) -> np.ndarray:
    """uint8 (n, h, w): a textured table, drifting by `drift` px a frame, with a bright disc at centres (n, 2)."""
    rng = np.random.default_rng(0)
    coarse = rng.uniform(60, 180, (height // 8 + 2, (width + int(drift * num_frames)) // 8 + 3))
    big = np.kron(coarse, np.ones((8, 8)))
    rows, columns = np.mgrid[:height, :width]
    frames = []
    for i in range(num_frames):
        shift = drift * i
        left, share = int(shift), shift - int(shift)
        picture = (1 - share) * big[:height, left : left + width] + share * big[:height, left + 1 : left + 1 + width]
        if centres is not None:
            u, v = centres[i]
            picture = np.where((columns - u) ** 2 + (rows - v) ** 2 < 25, 250, picture)
        frames.append(picture)
    return np.stack(frames).astype(np.uint8)


def change_of(gray: np.ndarray) -> np.ndarray:
    return np.concatenate([[0.0], np.abs(np.diff(gray.astype(float), axis=0)).mean(axis=(1, 2))])


def test_runs() -> None:
    assert runs(np.array([1, 1, 0, 1, 0, 0, 1], bool)) == [(0, 2), (3, 4), (6, 7)]
    assert runs(np.zeros(3, bool)) == []


def test_static_stretches_are_found_and_short_pauses_left() -> None:
    config = StaticConfig()
    joint_speed = np.full(40, 0.5)
    change = np.full(40, 3.0)
    gripper = np.zeros(40)
    assert not detect_static(joint_speed, gripper, change, FPS, config).bad_frames.any()  # type: ignore[union-attr]
    joint_speed[:16] = change[:16] = 0
    joint_speed[30:34] = change[30:34] = 0
    verdict = detect_static(joint_speed, gripper, change, FPS, config)
    assert verdict.bad_frames is not None
    assert np.flatnonzero(verdict.bad_frames).tolist() == list(range(16))
    assert verdict.passed
    gripper[:16] = 1.0  # a closing gripper is no rest
    assert not detect_static(joint_speed, gripper, change, FPS, config).bad_frames.any()  # type: ignore[union-attr]
    still = detect_static(np.zeros(40), np.zeros(40), np.zeros(40), FPS, config)
    assert not still.passed
    assert still.numbers["static_share"] == 1.0
    moving_object = detect_static(np.zeros(40), np.zeros(40), np.full(40, 2.0), FPS, config)
    assert not moving_object.bad_frames.any()  # type: ignore[union-attr]


def test_a_jump_home_is_a_reset_and_a_quick_motion_is_not() -> None:
    config = ResetConfig()
    joints = swing()
    assert not detect_reset(joints, config).bad_frames.any()  # type: ignore[union-attr]
    doubled = np.concatenate([joints, joints[:16]])
    verdict = detect_reset(doubled, config)
    assert verdict.bad_frames is not None
    assert np.flatnonzero(verdict.bad_frames)[0] == 33
    assert verdict.numbers["reset_frame"] == 33
    there_and_back = np.concatenate([joints, joints[::-1]])
    assert not detect_reset(there_and_back, config).bad_frames.any()  # type: ignore[union-attr]
    away = np.concatenate([joints, joints + 1.5])  # a jump, but not home
    assert not detect_reset(away, config).bad_frames.any()  # type: ignore[union-attr]


@pytest.mark.parametrize("defect", ["blank", "noise", "frozen"])
def test_corrupted_frames(defect: str) -> None:
    config = CorruptedConfig()
    centres = np.stack([20 + 1.5 * np.arange(33), np.full(33, 30.0)], axis=1)
    gray = scene(centres=centres)
    travel = np.full(33, 0.02)
    healthy = detect_corrupted(gray, change_of(gray), travel, config)
    assert healthy.passed
    assert not healthy.bad_frames.any()  # type: ignore[union-attr]
    assert neighbour_correlation(gray).min() > 0.7
    bad = gray.copy()
    if defect == "blank":
        bad[10:14] = 7
    elif defect == "noise":
        bad[10:14] = np.random.default_rng(1).integers(0, 255, bad[10:14].shape)
    else:
        bad[10:14] = bad[9]
    verdict = detect_corrupted(bad, change_of(bad), travel, config)
    assert verdict.bad_frames is not None
    assert np.flatnonzero(verdict.bad_frames).tolist() == [10, 11, 12, 13]
    assert verdict.passed
    if defect == "frozen":
        resting = detect_corrupted(bad, change_of(bad), np.zeros(33), config)
        assert not resting.bad_frames.any()  # type: ignore[union-attr]
        wrist = detect_corrupted(bad, change_of(bad), travel, config, wrist=True)
        assert not wrist.bad_frames.any()  # type: ignore[union-attr]


def test_mostly_corrupted_condemns() -> None:
    gray = scene()
    gray[8:] = 0
    verdict = detect_corrupted(gray, change_of(gray), np.zeros(33), CorruptedConfig())
    assert not verdict.passed
    assert verdict.numbers["blank_frames"] == 25


def test_a_driving_base_moves_every_edge_an_arm_does_not() -> None:
    config = BaseMotionConfig()
    centres = np.stack([10 + 2.0 * np.arange(33), 30 + 8 * np.sin(np.arange(33))], axis=1)
    arm = background_flow(scene(centres=centres), config.quantile, config.min_gradient)
    assert detect_base_motion(arm, config).passed
    for drift in (1.0, 2.5):
        driving = background_flow(scene(drift=drift, centres=centres), config.quantile, config.min_gradient)
        verdict = detect_base_motion(driving, config)
        assert not verdict.passed
        assert verdict.numbers["moving_share"] > 0.9  # type: ignore[operator]
    assert detect_base_motion(background_flow(np.full((5, 8, 8), 9, np.uint8), 0.2, 8.0), config).passed


def test_wrist_cameras_are_rigidly_mounted_or_condemned() -> None:
    config = CalibrationConfig()
    tool = arm_poses()
    camera = tool @ MOUNT
    found, metres, degrees = hand_eye_residual(tool, camera)
    assert np.abs(found - MOUNT).max() < 1e-9
    assert metres.max() < 1e-9
    assert degrees.max() < 1e-4
    assert detect_hand_eye(tool, camera, MOUNT, config).passed
    inverted = detect_hand_eye(tool, rigid_inverse(camera), MOUNT, config)
    assert not inverted.passed
    assert inverted.numbers["hand_eye_m"] > 0.05  # type: ignore[operator]
    other_mount = MOUNT.copy()
    other_mount[:3, 3] += [0.0, 0.2, 0.0]
    assert not detect_hand_eye(tool, camera, other_mount, config).passed
    jitter = camera.copy()
    jitter[:, :3, 3] += np.random.default_rng(0).normal(scale=0.004, size=(33, 3))
    assert detect_hand_eye(tool, jitter, None, config).passed  # millimetres are what real recordings have


def test_camera_values() -> None:
    config = CalibrationConfig()
    K = np.array([[80.0, 0, 47.5], [0, 80.0, 31.5], [0, 0, 1]])
    poses = np.eye(4)[None]
    assert detect_camera(K, poses, 96, 64, config).passed
    larger = np.diag([640 / 96, 480 / 64, 1.0]) @ K
    assert not detect_camera(larger, poses, 96, 64, config).passed
    for bad in (np.zeros((3, 3)), np.full((3, 3), np.nan), np.diag([80.0, -80.0, 1.0])):
        assert not detect_camera(bad, poses, 96, 64, config).passed
    mirrored = np.diag([1.0, 1.0, -1.0, 1.0])[None]
    assert not detect_camera(K, mirrored, 96, 64, config).passed
    scaled = np.diag([1.01, 1.01, 1.01, 1.0])[None]
    assert not detect_camera(K, scaled, 96, 64, config).passed
    assert detect_fixed_camera(np.eye(4)[None].repeat(9, 0), config).passed
    assert not detect_fixed_camera(arm_poses(), config).passed


def test_mean_pose_ignores_a_few_outliers_in_position() -> None:
    poses = MOUNT[None].repeat(21, 0)
    poses[0, :3, 3] += 5
    assert np.abs(mean_pose(poses) - MOUNT).max() < 1e-9


@pytest.mark.parametrize("lag", [-4, -2, 0, 3, 5])
def test_the_lag_of_the_images_is_measured(lag: int) -> None:
    rng = np.random.default_rng(lag + 10)
    signal = np.abs(np.convolve(rng.normal(size=80), np.ones(4) / 4, mode="same"))
    motion = signal[20:60, None]
    change = signal[20 - lag : 60 - lag, None] * 30 + rng.uniform(0, 0.5, (40, 1))
    measured, best, _ = lag_by_correlation(motion, change, 6)
    assert abs(measured - lag) < 0.5
    assert best > 0.9
    verdict = detect_image_lag(motion, change, FPS, TimeAlignmentConfig())
    assert verdict.passed == (abs(lag) <= 1)


def test_images_without_relation_to_the_motion_prove_no_lag() -> None:
    rng = np.random.default_rng(5)
    verdict = detect_image_lag(rng.uniform(size=(32, 2)), rng.uniform(size=(32, 2)), FPS, TimeAlignmentConfig())
    assert verdict.passed
    assert detect_image_lag(np.zeros((32, 1)), rng.uniform(size=(32, 1)), FPS, TimeAlignmentConfig()).passed


def test_camera_poses_that_lag_are_found_and_wrong_ones_are_not_called_late() -> None:
    config = TimeAlignmentConfig()
    tool = arm_poses(60)
    camera = tool @ MOUNT
    assert detect_pose_lag(tool, camera, FPS, config).passed
    late = detect_pose_lag(tool[4:44], camera[:40], FPS, config)
    assert not late.passed
    assert late.numbers["pose_lag_s"] == pytest.approx(0.5)
    assert detect_pose_lag(tool, rigid_inverse(camera), FPS, config).passed


def view_from_above() -> tuple[np.ndarray, np.ndarray]:
    K = np.array([[80.0, 0, 47.5], [0, 80.0, 31.5], [0, 0, 1]])
    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0])  # looks down -z of the base
    T[:3, 3] = [0.4, 0.0, 1.2]
    return K, T[None].repeat(33, 0)


def test_points_project_as_by_hand() -> None:
    K, T = view_from_above()
    uv, depth = project_points(np.array([[0.4, 0.0, 0.2], [0.5, 0.1, 0.2], [0.4, 0.0, 1.5]]), K, T[:3])
    assert np.allclose(depth, [1.0, 1.0, -0.3])
    assert np.allclose(uv[:2], [[47.5, 31.5], [55.5, 23.5]])
    assert inside_image(uv, depth, 96, 64).tolist() == [True, True, False]


def test_motion_must_be_where_the_tool_is_projected() -> None:
    config = ProjectionConfig()
    K, T = view_from_above()
    tool = np.stack([0.1 + 0.018 * np.arange(33), 0.15 * np.sin(np.arange(33) / 3), np.full(33, 0.3)], axis=1)
    uv, depth = project_points(tool, K, T)
    gray = scene(centres=uv)
    inside = inside_image(uv, depth, 96, 64)
    right = detect_projection(gray, uv[:, None], inside[:, None], config)
    assert right.passed
    assert right.numbers["motion_contrast"] > 3  # type: ignore[operator]
    shifted = uv + np.array([0.0, 25.0])
    wrong = detect_projection(gray, shifted[:, None], inside_image(shifted, depth, 96, 64)[:, None], config)
    assert not wrong.passed
    outside = detect_projection(gray, uv[:, None] + 500, np.zeros((33, 1), bool), config)
    assert not outside.passed
    assert outside.numbers["inside_share"] == 0.0
    resting = np.repeat(uv[:1], 33, 0)
    unproven = detect_projection(scene(centres=resting), resting[:, None], inside[:1].repeat(33)[:, None], config)
    assert unproven.passed
    assert unproven.numbers["motion_contrast"] is None
