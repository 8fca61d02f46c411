"""Projection: round trips, invariance, borders, and camera matrices that are none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from worldline_core.geometry.cameras import inside_image, project_points
from worldline_core.geometry.tensor_transforms import valid_intrinsics
from worldline_core.geometry.transforms import pose_from_quaternion_wxyz

K = np.array([[322.0, 0.5, 318.2], [0.0, 430.0, 241.7], [0.0, 0.0, 1.0]])
steady = settings(derandomize=True, deadline=None)
unit = st.floats(-1.0, 1.0, allow_nan=False)
quaternions = st.tuples(unit, unit, unit, unit).filter(lambda q: sum(x * x for x in q) > 0.01)
points = st.tuples(*[st.floats(-2, 2, allow_nan=False)] * 3)


def pose(quaternion, translation):
    return pose_from_quaternion_wxyz(np.array(translation), np.array(quaternion))


@steady
@given(quaternions, points, st.floats(-200, 800), st.floats(-200, 600), st.floats(0.05, 5))
def test_the_point_at_a_pixel_and_depth_is_projected_to_them(quaternion, translation, u, v, depth):
    T_base_camera = pose(quaternion, translation)
    in_camera = depth * np.linalg.inv(K) @ [u, v, 1.0]
    point = T_base_camera[:3, :3] @ in_camera + T_base_camera[:3, 3]
    uv, found = project_points(point[None], K, T_base_camera[None])
    np.testing.assert_allclose(uv[0], [u, v], atol=1e-7)
    assert float(found[0]) == pytest.approx(depth, abs=1e-10)


@steady
@given(quaternions, points, quaternions, points, points)
def test_moving_camera_and_point_together_changes_nothing(q1, t1, q2, t2, point):
    T_base_camera, T_new_base = pose(q1, t1), pose(q2, t2)
    p = np.array([point])
    uv, depth = project_points(p, K, T_base_camera[None])
    moved = p @ T_new_base[:3, :3].T + T_new_base[:3, 3]
    uv_moved, depth_moved = project_points(moved, K, (T_new_base @ T_base_camera)[None])
    assert float(depth_moved[0]) == pytest.approx(float(depth[0]), abs=1e-10)
    if abs(float(depth[0])) > 0.05:
        np.testing.assert_allclose(uv_moved, uv, atol=1e-6, rtol=1e-9)


def test_project_equals_opencv():
    rng = np.random.default_rng(0)
    rvec, tvec = np.array([0.3, -0.2, 0.1]), np.array([0.1, 0.2, 0.9])
    rotation, _ = cv2.Rodrigues(rvec)
    T_camera_base = np.eye(4)
    T_camera_base[:3, :3], T_camera_base[:3, 3] = rotation, tvec
    square = K.copy()
    square[0, 1] = 0.0  # OpenCV has no skew
    world = rng.uniform(-0.3, 0.3, (20, 3))
    expected, _ = cv2.projectPoints(world, rvec, tvec, square, None)
    uv, _ = project_points(world, square, np.linalg.inv(T_camera_base)[None])
    np.testing.assert_allclose(uv, expected[:, 0], atol=1e-9)


def test_image_border_lies_half_a_pixel_outside_the_outer_centres():
    uv = torch.tensor([[-0.5, -0.5], [95.49, 63.49], [95.5, 10.0], [10.0, 63.5], [-0.51, 3.0]])
    assert inside_image(uv, (64, 96)).tolist() == [True, True, False, False, False]
    assert inside_image(uv.double().numpy(), (64, 96)).tolist() == [True, True, False, False, False]


def test_a_point_in_the_camera_plane_gives_no_nan():
    uv, depth = project_points(np.zeros((1, 3)), K, np.eye(4)[None])
    assert np.isfinite(uv).all()
    assert float(depth[0]) == 0.0


@pytest.mark.parametrize("broken", ["singular", "nan", "transposed", "negative"])
def test_bad_intrinsics_are_not_valid(broken):
    bad = torch.from_numpy(K.copy())
    assert bool(valid_intrinsics(bad))
    if broken == "singular":
        bad[1, 1] = 0
    elif broken == "nan":
        bad[0, 2] = float("nan")
    elif broken == "transposed":
        bad = bad.T.contiguous()
    else:
        bad[0, 0] = -322.0
    assert valid_intrinsics(torch.stack([torch.from_numpy(K), bad])).tolist() == [True, False]
