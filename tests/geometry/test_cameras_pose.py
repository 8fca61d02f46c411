"""Camera poses that say their convention, and rotations that are repaired or refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from worldline_core.errors import CalibrationError
from worldline_core.geometry.cameras import CameraPose, project_points
from worldline_core.geometry.tensor_transforms import is_rigid
from worldline_core.geometry.transforms import MAX_ROTATION_DEVIATION, mean_pose, repair_rotations, rotation_deviation

K = np.array([[322.0, 0.0, 318.2], [0.0, 430.0, 241.7], [0.0, 0.0, 1.0]])


def poses(count: int = 5, seed: int = 0) -> np.ndarray:
    result = np.tile(np.eye(4), (count, 1, 1))
    result[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    result[:, :3, 3] = np.random.default_rng(seed).normal(size=(count, 3))
    return result


def off_by(deviation: float, rotation: np.ndarray) -> np.ndarray:
    """A shear of the rotation with max |R R^T - I| equal to `deviation`, to first order."""
    return (np.eye(3) + deviation * np.array([[0, 1.0, 0], [0, 0, 0], [0, 0, 0]])) @ rotation


def test_all_four_conventions_of_one_camera_project_alike() -> None:
    T_base_camera = poses(1)
    gl = T_base_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
    made = [
        CameraPose.of(T_base_camera, extrinsics="camera_to_base", axes="opencv", where="head"),
        CameraPose.of(gl, extrinsics="camera_to_base", axes="opengl", where="head"),
        CameraPose.of(np.linalg.inv(T_base_camera), extrinsics="base_to_camera", axes="opencv", where="head"),
        CameraPose.of(np.linalg.inv(gl)[0], extrinsics="base_to_camera", axes="opengl", where="head"),
    ]
    points = np.random.default_rng(1).normal(size=(20, 3))
    # OpenCV's own extrinsics (rvec, tvec) map base to camera.
    T_camera_base = np.linalg.inv(T_base_camera[0])
    rvec, _ = cv2.Rodrigues(T_camera_base[:3, :3])
    expected, _ = cv2.projectPoints(points, rvec, T_camera_base[:3, 3], K, None)
    for pose in made:
        np.testing.assert_allclose(pose.T_base_camera, T_base_camera, atol=1e-12)
        uv, _ = project_points(points, K, pose.T_base_camera)
        np.testing.assert_allclose(uv, expected[:, 0], rtol=1e-8, atol=1e-7)


@pytest.mark.parametrize("deviation", [2e-6, 1e-4, 0.99e-3])
def test_a_rotation_within_the_threshold_is_repaired_and_counted(deviation: float) -> None:
    recorded = poses()
    true = recorded.copy()
    recorded[[1, 3], :3, :3] = off_by(deviation, recorded[[1, 3], :3, :3])
    for extrinsics, expected in (("camera_to_base", true), ("base_to_camera", np.linalg.inv(true))):
        pose = CameraPose.of(recorded, extrinsics=extrinsics, axes="opencv", where="episode 4, view head")
        assert pose.repair.count == 2
        assert pose.repair.largest == pytest.approx(deviation, rel=1e-2)
        assert rotation_deviation(pose.T_base_camera[:, :3, :3]).max() < 1e-14
        # The nearest rotation is not further from the true one than the recorded matrix was.
        np.testing.assert_allclose(pose.T_base_camera[:, :3, :3], expected[:, :3, :3], atol=deviation)


def test_what_is_exact_or_rounded_stays_the_same_array() -> None:
    for recorded in (poses(), poses().astype(np.float32).astype(np.float64)):
        repaired, repair = repair_rotations(recorded, "head")
        assert repaired is recorded
        assert repair.count == 0


@pytest.mark.parametrize("kind", ["beyond", "mirrored", "scaled", "nan", "last_row", "infinite_place"])
def test_what_is_beyond_repair_is_refused(kind: str) -> None:
    recorded = poses()
    if kind == "beyond":
        recorded[2, :3, :3] = off_by(1.02 * MAX_ROTATION_DEVIATION, recorded[2, :3, :3])
    elif kind == "mirrored":
        recorded[2, :3, 0] *= -1
    elif kind == "scaled":
        recorded[2, :3, :3] *= 1.01
    elif kind == "nan":
        recorded[2, 0, 0] = np.nan
    elif kind == "infinite_place":
        recorded[2, 0, 3] = np.inf
    else:
        recorded[2, 3, 0] = 0.1
    assert not bool(is_rigid(torch.from_numpy(recorded[2])))
    with pytest.raises(CalibrationError, match=r"Not a rigid transform[\s\S]*episode 4, frame 2[\s\S]*1 of 5"):
        CameraPose.of(recorded, extrinsics="camera_to_base", axes="opencv", where="episode 4")
    with pytest.raises(CalibrationError, match=r"wrong shape[\s\S]*\(3, 4\)"):
        CameraPose.of(np.eye(4)[:3], extrinsics="camera_to_base", axes="opencv", where="head")


def test_the_mean_pose_is_that_of_scipy() -> None:
    turns = Rotation.from_rotvec(0.2 * np.random.default_rng(3).normal(size=(30, 3)))
    scattered = poses(1)[:, :3, :3] @ turns.as_matrix()
    many = np.tile(np.eye(4), (30, 1, 1))
    many[:, :3, :3] = scattered
    np.testing.assert_allclose(mean_pose(many)[:3, :3], Rotation.from_matrix(scattered).mean().as_matrix(), atol=1e-12)
