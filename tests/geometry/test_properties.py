"""Properties that hold for every pose, camera and point, on both implementations (torch and NumPy)."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from worldline_core.geometry.cameras import inside_image, project, unproject
from worldline_core.geometry.se3 import (
    invert,
    rot6d_from_rotation,
    rotation_angle,
    rotation_from_quaternion_wxyz,
    rotation_from_rot6d,
    transform_from,
)
from worldline_core.geometry.transforms import (
    euler_fixed_xyz_from_rotation,
    euler_moving_xyz_from_rotation,
    project_points,
    quaternion_wxyz_from_rotation,
    quaternion_xyzw_from_rotation,
    rigid_inverse,
    rotation_angle_deg,
    rotation_from_euler_fixed_xyz,
    rotation_from_euler_moving_xyz,
    rotation_from_quaternion_xyzw,
)
from worldline_core.geometry.transforms import inside_image as inside_in_numpy
from worldline_core.geometry.transforms import rotation_from_quaternion_wxyz as rotation_in_numpy

K = torch.tensor([[322.0, 0.5, 318.2], [0.0, 430.0, 241.7], [0.0, 0.0, 1.0]], dtype=torch.float64)
steady = settings(derandomize=True, deadline=None)
unit = st.floats(-1.0, 1.0, allow_nan=False)
quaternions = st.tuples(unit, unit, unit, unit).filter(lambda q: sum(x * x for x in q) > 0.01)
places = st.tuples(*[st.floats(-3, 3, allow_nan=False)] * 3)
angles = st.tuples(*[st.floats(-math.pi, math.pi, allow_nan=False)] * 3)


def pose(quaternion: tuple[float, ...], translation: tuple[float, ...]) -> torch.Tensor:
    rotation = rotation_from_quaternion_wxyz(torch.tensor(quaternion, dtype=torch.float64))
    return transform_from(rotation, torch.tensor(translation, dtype=torch.float64))


@steady
@given(quaternions)
def test_a_quaternion_comes_back_up_to_its_sign(quaternion):
    given_unit = np.array(quaternion) / np.linalg.norm(quaternion)
    back = quaternion_wxyz_from_rotation(rotation_in_numpy(np.array(quaternion)))
    assert back[0] >= 0
    assert min(np.abs(back - given_unit).max(), np.abs(back + given_unit).max()) < 1e-10
    # The two orders hold the same numbers, and scipy reads xyzw.
    xyzw = quaternion_xyzw_from_rotation(rotation_in_numpy(np.array(quaternion)))
    assert np.array_equal(np.roll(back, -1), xyzw)
    np.testing.assert_allclose(rotation_from_quaternion_xyzw(xyzw), Rotation.from_quat(xyzw).as_matrix(), atol=1e-12)


@steady
@given(quaternions)
def test_torch_and_numpy_agree_on_rotations(quaternion):
    rotation = rotation_from_quaternion_wxyz(torch.tensor(quaternion, dtype=torch.float64))
    np.testing.assert_allclose(rotation.numpy(), rotation_in_numpy(np.array(quaternion)), atol=1e-14)
    assert math.degrees(float(rotation_angle(rotation))) == pytest.approx(
        float(rotation_angle_deg(rotation.numpy())), abs=1e-9
    )


@steady
@given(angles)
def test_euler_angles_about_fixed_and_moving_axes_are_those_of_scipy(angle):
    fixed, moving = rotation_from_euler_fixed_xyz(np.array(angle)), rotation_from_euler_moving_xyz(np.array(angle))
    np.testing.assert_allclose(fixed, Rotation.from_euler("xyz", angle).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(moving, Rotation.from_euler("XYZ", angle).as_matrix(), atol=1e-12)


@steady
@given(angles)
def test_euler_angles_come_back_as_the_same_rotation(angle):
    for forward, backward in (
        (rotation_from_euler_fixed_xyz, euler_fixed_xyz_from_rotation),
        (rotation_from_euler_moving_xyz, euler_moving_xyz_from_rotation),
    ):
        rotation = forward(np.array(angle))
        np.testing.assert_allclose(forward(backward(rotation)), rotation, atol=1e-7)
        if abs(angle[1]) < math.pi / 2 - 0.01:
            inside = np.array(angle)
            assert np.abs(np.angle(np.exp(1j * (backward(rotation) - inside)))).max() < 1e-7


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2])
def test_euler_angles_at_the_gimbal_lock_still_give_the_rotation(pitch):
    for forward, backward in (
        (rotation_from_euler_fixed_xyz, euler_fixed_xyz_from_rotation),
        (rotation_from_euler_moving_xyz, euler_moving_xyz_from_rotation),
    ):
        rotation = forward(np.array([0.7, pitch, -1.1]))
        np.testing.assert_allclose(forward(backward(rotation)), rotation, atol=1e-9)


@steady
@given(quaternions, places, places)
def test_torch_and_numpy_project_alike(quaternion, translation, point):
    camera, p = pose(quaternion, translation), torch.tensor([point], dtype=torch.float64)
    uv, depth = project(p, K, camera)
    uv_numpy, depth_numpy = project_points(p.numpy(), K.numpy(), camera.numpy()[None])
    np.testing.assert_allclose(depth.numpy(), depth_numpy, atol=1e-12)
    if abs(float(depth[0])) > 0.01:
        np.testing.assert_allclose(uv.numpy(), uv_numpy, rtol=1e-10, atol=1e-8)
        if float(depth[0]) > 0.0101:
            assert inside_image(uv, (480, 640)).numpy() == inside_in_numpy(uv_numpy, depth_numpy, 640, 480)
    np.testing.assert_allclose(invert(camera).numpy(), rigid_inverse(camera.numpy()), atol=1e-14)


@steady
@given(quaternions, places, quaternions, places, st.lists(places, min_size=1, max_size=8))
def test_moving_base_camera_and_points_together_changes_nothing(q1, t1, q2, t2, points):
    camera, moved = pose(q1, t1), pose(q2, t2)
    p = torch.tensor(points, dtype=torch.float64)
    uv, depth = project(p, K, camera)
    rotated = p @ moved[:3, :3].mT + moved[:3, 3]
    uv_moved, depth_moved = project(rotated, K, moved @ camera)
    torch.testing.assert_close(depth_moved, depth, atol=1e-11, rtol=0)
    visible = depth.abs() > 0.05
    torch.testing.assert_close(uv_moved[visible], uv[visible], atol=1e-6, rtol=1e-9)


@steady
@given(quaternions, places, st.lists(places, min_size=1, max_size=8))
def test_a_projected_point_is_found_again_at_its_depth(quaternion, translation, points):
    camera, p = pose(quaternion, translation), torch.tensor(points, dtype=torch.float64)
    uv, depth = project(p, K, camera)
    known = depth.abs() > 1e-3
    again = unproject(uv, depth, K, camera)
    torch.testing.assert_close(again[known], p[known], atol=1e-9, rtol=0)


@steady
@given(st.lists(st.tuples(*[unit] * 6), min_size=1, max_size=6))
def test_rot6d_of_any_two_vectors_is_a_rotation_that_comes_back(columns):
    rot6d = torch.tensor(columns, dtype=torch.float64)
    usable = torch.linalg.cross(rot6d[:, :3], rot6d[:, 3:]).norm(dim=-1) > 1e-3
    rotation = rotation_from_rot6d(rot6d[usable])
    eye = torch.eye(3, dtype=torch.float64).expand_as(rotation)
    torch.testing.assert_close(rotation @ rotation.mT, eye, atol=1e-9, rtol=0)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(len(rotation)).double())
    torch.testing.assert_close(rotation_from_rot6d(rot6d_from_rotation(rotation)), rotation, atol=1e-12, rtol=0)


def test_gradients_in_float64():
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    camera = pose((0.9, 0.1, -0.2, 0.3), (0.1, 0.2, -2.0)).expand(4, 4, 4).clone().requires_grad_()
    intrinsics = K.expand(4, 3, 3).clone().requires_grad_()
    points = (0.3 * random(4, 3)).requires_grad_()
    assert torch.autograd.gradcheck(project, (points, intrinsics, camera))
    uv = (300 + 50 * random(4, 2)).requires_grad_()
    depth = (1 + random(4).abs()).requires_grad_()
    assert torch.autograd.gradcheck(unproject, (uv, depth, intrinsics, camera))
    assert torch.autograd.gradcheck(rotation_from_quaternion_wxyz, random(5, 4).requires_grad_())
    assert torch.autograd.gradcheck(rotation_from_rot6d, random(5, 6).requires_grad_())
    assert torch.autograd.gradcheck(rot6d_from_rotation, random(5, 3, 3).requires_grad_())


def test_functions_broadcast_keep_dtype_and_run_where_their_input_is():
    device = "cuda" if torch.cuda.is_available() else "cpu"
    camera = pose((0.9, 0.1, -0.2, 0.3), (0.1, 0.2, -2.0)).float().to(device)
    points = torch.zeros(5, 7, 3, device=device)
    uv, depth = project(points, K.float().to(device), camera.expand(7, 4, 4))
    assert uv.shape == (5, 7, 2)
    assert depth.shape == (5, 7)
    assert uv.dtype == depth.dtype == torch.float32
    assert uv.device == points.device
    assert unproject(uv, depth, K.float().to(device), camera).shape == (5, 7, 3)
