from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from worldline_core.data.rotations import (
    pose_from_quaternion_xyzw,
    pose_from_roll_pitch_yaw,
    quaternion_wxyz,
    rotation_from_quaternion_wxyz,
)
from worldline_core.errors import DataError


def test_conventions_agree_with_scipy() -> None:
    rng = np.random.default_rng(0)
    angles, position = rng.uniform(-3, 3, (50, 3)), rng.normal(size=(50, 3))
    poses = pose_from_roll_pitch_yaw(position, angles)
    assert np.abs(poses[:, :3, :3] - Rotation.from_euler("xyz", angles).as_matrix()).max() < 1e-12
    assert np.array_equal(poses[:, :3, 3], position)
    quaternions = rng.normal(size=(50, 4))
    poses = pose_from_quaternion_xyzw(position, quaternions)
    assert np.abs(poses[:, :3, :3] - Rotation.from_quat(quaternions).as_matrix()).max() < 1e-12


def test_quaternions_invert_even_at_half_turns() -> None:
    rotations = Rotation.random(200, random_state=1).as_matrix()
    half_turns = Rotation.from_rotvec(np.pi * np.eye(3)).as_matrix()
    for rotation in (rotations, half_turns, np.eye(3)[None]):
        assert np.abs(rotation_from_quaternion_wxyz(quaternion_wxyz(rotation)) - rotation).max() < 1e-12


def test_a_quaternion_without_direction_is_refused() -> None:
    with pytest.raises(DataError, match="no direction"):
        rotation_from_quaternion_wxyz(np.zeros((2, 4)))
