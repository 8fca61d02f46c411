"""Projection: round trips, invariance, borders, and camera matrices that are none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from worldline_core.errors import CalibrationError
from worldline_core.geometry.cameras import (
    check_intrinsics,
    inside_image,
    project,
    unproject,
)
from worldline_core.geometry.se3 import rotation_from_quaternion_wxyz, transform_from, transform_points

K = torch.tensor([[322.0, 0.5, 318.2], [0.0, 430.0, 241.7], [0.0, 0.0, 1.0]], dtype=torch.float64)
steady = settings(derandomize=True, deadline=None)
unit = st.floats(-1.0, 1.0, allow_nan=False)
quaternions = st.tuples(unit, unit, unit, unit).filter(lambda q: sum(x * x for x in q) > 0.01)
points = st.tuples(*[st.floats(-2, 2, allow_nan=False)] * 3)


def pose(quaternion, translation):
    rotation = rotation_from_quaternion_wxyz(torch.tensor(quaternion, dtype=torch.float64))
    return transform_from(rotation, torch.tensor(translation, dtype=torch.float64))


@steady
@given(quaternions, points, st.floats(-200, 800), st.floats(-200, 600), st.floats(0.05, 5))
def test_unproject_then_project_returns_the_pixel(quaternion, translation, u, v, depth):
    T_base_camera = pose(quaternion, translation)
    uv = torch.tensor([u, v], dtype=torch.float64)
    point = unproject(uv, torch.tensor(depth, dtype=torch.float64), K, T_base_camera)
    again, depth_again = project(point, K, T_base_camera)
    torch.testing.assert_close(again, uv, atol=1e-7, rtol=0)
    assert float(depth_again) == pytest.approx(depth, abs=1e-10)


@steady
@given(quaternions, points, quaternions, points, points)
def test_moving_camera_and_point_together_changes_nothing(q1, t1, q2, t2, point):
    T_base_camera, T_new_base = pose(q1, t1), pose(q2, t2)
    p = torch.tensor(point, dtype=torch.float64)
    uv, depth = project(p, K, T_base_camera)
    uv_moved, depth_moved = project(transform_points(T_new_base, p), K, T_new_base @ T_base_camera)
    assert float(depth_moved) == pytest.approx(float(depth), abs=1e-10)
    if abs(float(depth)) > 0.05:
        torch.testing.assert_close(uv_moved, uv, atol=1e-6, rtol=1e-9)


def test_project_equals_opencv():
    rng = np.random.default_rng(0)
    rvec, tvec = np.array([0.3, -0.2, 0.1]), np.array([0.1, 0.2, 0.9])
    rotation, _ = cv2.Rodrigues(rvec)
    T_camera_base = np.eye(4)
    T_camera_base[:3, :3], T_camera_base[:3, 3] = rotation, tvec
    square = K.numpy().copy()
    square[0, 1] = 0.0  # OpenCV has no skew
    world = rng.uniform(-0.3, 0.3, (20, 3))
    expected, _ = cv2.projectPoints(world, rvec, tvec, square, None)
    uv, _ = project(
        torch.from_numpy(world), torch.from_numpy(square), torch.from_numpy(np.linalg.inv(T_camera_base))[None]
    )
    np.testing.assert_allclose(uv.numpy(), expected[:, 0], atol=1e-9)


def test_image_border_lies_half_a_pixel_outside_the_outer_centres():
    uv = torch.tensor([[-0.5, -0.5], [95.49, 63.49], [95.5, 10.0], [10.0, 63.5], [-0.51, 3.0]])
    assert inside_image(uv, (64, 96)).tolist() == [True, True, False, False, False]


def test_a_point_in_the_camera_plane_gives_no_nan():
    uv, depth = project(torch.zeros(3), K.float(), torch.eye(4))
    assert torch.isfinite(uv).all()
    assert float(depth) == 0.0


@pytest.mark.parametrize("broken", ["singular", "nan", "transposed", "negative"])
def test_bad_intrinsics_are_named(broken):
    bad = K.clone()
    if broken == "singular":
        bad[1, 1] = 0
    elif broken == "nan":
        bad[0, 2] = float("nan")
    elif broken == "transposed":
        bad = bad.T.contiguous()
    else:
        bad[0, 0] = -322.0
    with pytest.raises(CalibrationError, match=r"singular or not that of a pinhole[\s\S]*episode 7, head"):
        check_intrinsics(bad, "episode 7, head")
