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
from worldline_core.geometry.cameras import inside_image, project_points
from worldline_core.geometry.tensor_transforms import invert, rot6d_from_rotation, transform_points
from worldline_core.geometry.transforms import (
    euler_fixed_xyz_from_rotation,
    pose_from_quaternion_wxyz,
    quaternion_wxyz_from_rotation,
    quaternion_xyzw_from_rotation,
    rigid_inverse,
    rotation_about_axis,
    rotation_angle_deg,
    rotation_from_euler_fixed_xyz,
    rotation_from_euler_moving_xyz,
    rotation_from_quaternion_wxyz,
    rotation_from_quaternion_xyzw,
    rotation_from_rot6d,
)

K = np.array([[322.0, 0.5, 318.2], [0.0, 430.0, 241.7], [0.0, 0.0, 1.0]])
steady = settings(derandomize=True, deadline=None)
unit = st.floats(-1.0, 1.0, allow_nan=False)
quaternions = st.tuples(unit, unit, unit, unit).filter(lambda q: sum(x * x for x in q) > 0.01)
places = st.tuples(*[st.floats(-3, 3, allow_nan=False)] * 3)
angles = st.tuples(*[st.floats(-math.pi, math.pi, allow_nan=False)] * 3)


def pose(quaternion: tuple[float, ...], translation: tuple[float, ...]) -> np.ndarray:
    return pose_from_quaternion_wxyz(np.array(translation), np.array(quaternion))


@steady
@given(quaternions)
def test_a_quaternion_comes_back_up_to_its_sign(quaternion):
    given_unit = np.array(quaternion) / np.linalg.norm(quaternion)
    back = quaternion_wxyz_from_rotation(rotation_from_quaternion_wxyz(np.array(quaternion)))
    assert back[0] >= 0
    assert min(np.abs(back - given_unit).max(), np.abs(back + given_unit).max()) < 1e-10
    # The two orders hold the same numbers, and scipy reads xyzw.
    xyzw = quaternion_xyzw_from_rotation(rotation_from_quaternion_wxyz(np.array(quaternion)))
    assert np.array_equal(np.roll(back, -1), xyzw)
    np.testing.assert_allclose(rotation_from_quaternion_xyzw(xyzw), Rotation.from_quat(xyzw).as_matrix(), atol=1e-12)


@steady
@given(quaternions)
def test_rotations_and_their_angles_are_those_of_scipy(quaternion):
    rotation = rotation_from_quaternion_wxyz(np.array(quaternion))
    reference = Rotation.from_quat(quaternion, scalar_first=True)
    np.testing.assert_allclose(rotation, reference.as_matrix(), atol=1e-14)
    assert float(rotation_angle_deg(rotation)) == pytest.approx(math.degrees(reference.magnitude()), abs=1e-6)
    turned = rotation_about_axis(2 * reference.as_rotvec(), float(reference.magnitude()))
    np.testing.assert_allclose(turned, reference.as_matrix(), atol=1e-12)


@steady
@given(angles)
def test_euler_angles_about_fixed_and_moving_axes_are_those_of_scipy(angle):
    fixed, moving = rotation_from_euler_fixed_xyz(np.array(angle)), rotation_from_euler_moving_xyz(np.array(angle))
    np.testing.assert_allclose(fixed, Rotation.from_euler("xyz", angle).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(moving, Rotation.from_euler("XYZ", angle).as_matrix(), atol=1e-12)


@steady
@given(angles)
def test_euler_angles_come_back_as_the_same_rotation(angle):
    rotation = rotation_from_euler_fixed_xyz(np.array(angle))
    found = euler_fixed_xyz_from_rotation(rotation)
    np.testing.assert_allclose(rotation_from_euler_fixed_xyz(found), rotation, atol=1e-7)
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
    seen = project_tools(
        torch.from_numpy(tool)[None, None],
        torch.full((1, 1), 0.5),
        torch.from_numpy(K)[None],
        torch.from_numpy(camera)[None],
        (480, 640),
    )
    uv, depth = project_points(np.array([point]), K, camera[None])
    assert float(seen.depth) == pytest.approx(float(depth[0]), abs=1e-12)
    if float(depth[0]) > 0.0101:
        np.testing.assert_allclose(seen.uv[0, 0], uv, rtol=1e-10, atol=1e-8)
    # The orientation of the tool in the camera, from the definition: R_camera_tool's first two columns.
    in_camera = (rigid_inverse(camera) @ tool)[:3, :3]
    np.testing.assert_allclose(seen.rot6d[0, 0, 0], in_camera[:, :2].T.reshape(6), atol=1e-12)
    np.testing.assert_allclose(rotation_from_rot6d(seen.rot6d[0, 0, 0].numpy()), in_camera, atol=1e-12)
    np.testing.assert_allclose(invert(torch.from_numpy(camera)).numpy(), rigid_inverse(camera), atol=1e-14)


@steady
@given(quaternions, places, quaternions, places, st.lists(places, min_size=1, max_size=8))
def test_moving_base_camera_and_points_together_changes_nothing(q1, t1, q2, t2, points):
    camera, moved, p = pose(q1, t1), pose(q2, t2), np.array(points)
    uv, depth = project_points(p, K, camera[None])
    rotated = transform_points(torch.from_numpy(moved), torch.from_numpy(p)).numpy()
    uv_moved, depth_moved = project_points(rotated, K, (moved @ camera)[None])
    np.testing.assert_allclose(depth_moved, depth, atol=1e-11)
    visible = np.abs(depth) > 0.05
    np.testing.assert_allclose(uv_moved[visible], uv[visible], atol=1e-6, rtol=1e-9)


@steady
@given(quaternions, places, st.lists(places, min_size=1, max_size=8))
def test_a_projected_point_is_found_again_at_its_depth(quaternion, translation, points):
    camera, p = pose(quaternion, translation), np.array(points)
    uv, depth = project_points(p, K, camera[None])
    known = np.abs(depth) > 1e-3
    rays = np.concatenate([uv, np.ones((len(uv), 1))], axis=1) @ np.linalg.inv(K).T
    again = (rays * depth[:, None]) @ camera[:3, :3].T + camera[:3, 3]
    np.testing.assert_allclose(again[known], p[known], atol=1e-9)


@steady
@given(st.lists(st.tuples(*[unit] * 6), min_size=1, max_size=6))
def test_rot6d_of_any_two_vectors_is_a_rotation_that_comes_back(columns):
    rot6d = np.array(columns)
    usable = np.linalg.norm(np.cross(rot6d[:, :3], rot6d[:, 3:]), axis=-1) > 1e-3
    rotation = rotation_from_rot6d(rot6d[usable])
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, -1, -2), np.tile(np.eye(3), (len(rotation), 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(rotation), np.ones(len(rotation)))
    again = rotation_from_rot6d(rot6d_from_rotation(torch.from_numpy(rotation)).numpy())
    np.testing.assert_allclose(again, rotation, atol=1e-12)


def test_gradients_in_float64():
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    camera = torch.from_numpy(pose((0.9, 0.1, -0.2, 0.3), (0.1, 0.2, -2.0)))
    cameras = camera.expand(4, 4, 4).clone().requires_grad_()
    points = (0.3 * random(4, 3)).requires_grad_()
    assert torch.autograd.gradcheck(invert, cameras)
    assert torch.autograd.gradcheck(transform_points, (cameras, points))
    assert torch.autograd.gradcheck(rot6d_from_rotation, random(5, 3, 3).requires_grad_())
    tools = torch.from_numpy(pose((0.3, 0.8, 0.2, -0.4), (0.05, 0.1, 0.2))).expand(4, 1, 4, 4).clone().requires_grad_()

    def projected(T_base_tool: torch.Tensor) -> tuple[torch.Tensor, ...]:
        seen = project_tools(
            T_base_tool, torch.zeros(4, 1).double(), torch.from_numpy(K)[None], camera[None], (480, 640)
        )
        return seen.uv, seen.depth, seen.rot6d

    assert torch.autograd.gradcheck(projected, tools)


def test_image_border_lies_half_a_pixel_outside_the_outer_centres():
    uv = torch.tensor([[-0.5, -0.5], [95.49, 63.49], [95.5, 10.0], [10.0, 63.5], [-0.51, 3.0]])
    assert inside_image(uv, (64, 96)).tolist() == [True, True, False, False, False]
    assert inside_image(uv.double().numpy(), (64, 96)).tolist() == [True, True, False, False, False]


def test_a_point_in_the_camera_plane_gives_no_nan():
    uv, depth = project_points(np.zeros((1, 3)), K, np.eye(4)[None])
    assert np.isfinite(uv).all()
    assert float(depth[0]) == 0.0
