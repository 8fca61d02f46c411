"""Properties that hold for every pose, camera and point, of the NumPy functions and of their torch counterparts."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from worldline_core.actions.action_tracks import project_tools
from worldline_core.errors import CalibrationError
from worldline_core.geometry.cameras import project_points
from worldline_core.geometry.tensor_transforms import invert, is_rigid, rot6d_from_rotation, transform_points
from worldline_core.geometry.transforms import (
    euler_fixed_xyz_from_rotation,
    lengths,
    pose_from_quaternion_wxyz,
    quaternion_wxyz_from_rotation,
    quaternion_xyzw_from_rotation,
    rigid_inverse,
    rotation_about_axis,
    rotation_angle,
    rotation_angle_deg,
    rotation_from_euler_fixed_xyz,
    rotation_from_euler_moving_xyz,
    rotation_from_quaternion_wxyz,
    rotation_from_quaternion_xyzw,
    rotation_from_rot6d,
)

K = np.array([[322.0, 0.5, 318.2], [0.0, 430.0, 241.7], [0.0, 0.0, 1.0]])
steady = settings(max_examples=40, derandomize=True, deadline=None)
unit = st.floats(-1.0, 1.0, allow_nan=False)
quaternions = st.tuples(unit, unit, unit, unit).filter(lambda q: sum(x * x for x in q) > 0.01)
places = st.tuples(*[st.floats(-3, 3, allow_nan=False)] * 3)
angles = st.tuples(*[st.floats(-math.pi, math.pi, allow_nan=False)] * 3)


def pose(quaternion: tuple[float, ...], translation: tuple[float, ...]) -> np.ndarray:
    return pose_from_quaternion_wxyz(np.array(translation), np.array(quaternion))


@steady
@given(quaternions)
def test_quaternions_rotations_and_their_angles_are_those_of_scipy(quaternion):
    rotation = rotation_from_quaternion_wxyz(np.array(quaternion))
    reference = Rotation.from_quat(quaternion, scalar_first=True)
    np.testing.assert_allclose(rotation, reference.as_matrix(), atol=1e-14)
    assert float(rotation_angle_deg(rotation)) == pytest.approx(math.degrees(reference.magnitude()), abs=1e-6)
    turned = rotation_about_axis(2 * reference.as_rotvec(), float(reference.magnitude()))
    np.testing.assert_allclose(turned, reference.as_matrix(), atol=1e-12)
    # Back up to the sign; the two orders hold the same numbers.
    back, xyzw = quaternion_wxyz_from_rotation(rotation), quaternion_xyzw_from_rotation(rotation)
    assert back[0] >= 0
    assert abs(back @ reference.as_quat(scalar_first=True)) == pytest.approx(1.0, abs=1e-14)
    assert np.array_equal(np.roll(back, -1), xyzw)
    np.testing.assert_allclose(rotation_from_quaternion_xyzw(xyzw), rotation, atol=1e-12)


@steady
@given(angles)
def test_euler_angles_about_fixed_and_moving_axes_are_those_of_scipy(angle):
    fixed, moving = rotation_from_euler_fixed_xyz(np.array(angle)), rotation_from_euler_moving_xyz(np.array(angle))
    np.testing.assert_allclose(fixed, Rotation.from_euler("xyz", angle).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(moving, Rotation.from_euler("XYZ", angle).as_matrix(), atol=1e-12)
    found = euler_fixed_xyz_from_rotation(fixed)
    np.testing.assert_allclose(rotation_from_euler_fixed_xyz(found), fixed, atol=1e-7)
    if abs(angle[1]) < math.pi / 2 - 0.01:
        assert np.abs(np.angle(np.exp(1j * (found - np.array(angle))))).max() < 1e-7


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2])
def test_euler_angles_at_the_gimbal_lock_still_give_the_rotation(pitch):
    rotation = rotation_from_euler_fixed_xyz(np.array([0.7, pitch, -1.1]))
    again = rotation_from_euler_fixed_xyz(euler_fixed_xyz_from_rotation(rotation))
    np.testing.assert_allclose(again, rotation, atol=1e-9)


@steady
@given(quaternions, places, places, quaternions)
def test_torch_and_numpy_project_alike(quaternion, translation, point, orientation):
    camera, tool = pose(quaternion, translation), pose(orientation, point)
    assert bool(is_rigid(torch.from_numpy(camera)))
    matrices = (torch.from_numpy(each)[None] for each in (K, camera))
    seen = project_tools(torch.from_numpy(tool)[None, None], torch.full((1, 1), 0.5), *matrices, (480, 640))
    uv, depth = project_points(np.array([point]), K, camera[None])
    assert float(seen.depth) == pytest.approx(float(depth[0]), abs=1e-12)
    if float(depth[0]) > 0.0101:
        np.testing.assert_allclose(seen.uv[0, 0], uv, rtol=1e-10, atol=1e-8)
    # The orientation of the tool in the camera, from the definition: R_camera_tool's first two columns.
    in_camera = (rigid_inverse(camera) @ tool)[:3, :3]
    np.testing.assert_allclose(seen.rot6d[0, 0, 0], in_camera[:, :2].T.reshape(6), atol=1e-12)
    np.testing.assert_allclose(rotation_from_rot6d(seen.rot6d[0, 0, 0].numpy()), in_camera, atol=1e-12)
    np.testing.assert_allclose(invert(torch.from_numpy(camera)).numpy(), rigid_inverse(camera), atol=1e-14)
    moved = transform_points(torch.from_numpy(camera), torch.tensor([point], dtype=torch.float64))
    np.testing.assert_allclose(moved[0], camera[:3, :3] @ point + camera[:3, 3], atol=1e-12)


@steady
@given(st.lists(st.tuples(*[unit] * 6), min_size=1, max_size=6))
def test_rot6d_of_any_two_vectors_is_a_rotation_that_comes_back(columns):
    rot6d = np.array(columns)
    usable = np.linalg.norm(np.cross(rot6d[:, :3], rot6d[:, 3:]), axis=-1) > 1e-3
    rotation = rotation_from_rot6d(rot6d[usable])
    products = rotation @ np.swapaxes(rotation, -1, -2)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(rotation), np.ones(len(rotation)))
    again = rotation_from_rot6d(rot6d_from_rotation(torch.from_numpy(rotation)).numpy())
    np.testing.assert_allclose(again, rotation, atol=1e-12)


def test_a_point_in_the_camera_plane_gives_no_nan():
    uv, depth = project_points(np.zeros((1, 3)), K, np.eye(4)[None])
    assert np.isfinite(uv).all()
    assert float(depth[0]) == 0.0


@steady
@given(st.floats(0, math.pi))
def test_rotation_angle_is_accurate_at_both_ends(angle):
    q = np.array([math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0])
    assert float(rotation_angle(rotation_from_quaternion_wxyz(q))) == pytest.approx(angle, abs=1e-12)


@pytest.mark.parametrize("bad", [0.0, 1e-9, math.nan, math.inf])
def test_a_quaternion_without_direction_is_refused(bad):
    quaternions = np.array([[1.0, 0, 0, 0], [bad, 0, 0, 0]])
    with pytest.raises(CalibrationError, match="no direction"):
        rotation_from_quaternion_wxyz(quaternions)


@pytest.mark.parametrize("columns", [[0, 0, 0, 0, 1, 0], [1, 0, 0, 2, 0, 0], [1, 0, 0, math.nan, 0, 0]])
def test_rot6d_that_spans_no_frame_is_refused(columns):
    with pytest.raises(CalibrationError, match=r"spans no frame[\s\S]*1 of 1"):
        rotation_from_rot6d(np.array(columns))


@pytest.mark.parametrize("shape", [(9, 50, 2), (4, 5, 6, 3)])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_lengths_are_numpys_to_the_bit(shape: tuple[int, ...], kind: type) -> None:
    vectors = np.random.default_rng(0).normal(size=shape).astype(kind)
    for each in (vectors, np.asfortranarray(vectors), vectors[::2]):
        expected = np.linalg.norm(each, axis=-1)
        assert lengths(each).dtype == expected.dtype
        assert np.array_equal(lengths(each), expected)
