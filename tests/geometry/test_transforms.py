"""Rigid transforms and Rot6D: properties that hold for every rotation."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from worldline_core.errors import CalibrationError
from worldline_core.geometry.tensor_transforms import is_rigid, rot6d_from_rotation
from worldline_core.geometry.transforms import (
    lengths,
    pose_from_quaternion_wxyz,
    rotation_angle,
    rotation_from_quaternion_wxyz,
    rotation_from_rot6d,
)

steady = settings(derandomize=True, deadline=None)
unit = st.floats(-1.0, 1.0, allow_nan=False)
quaternions = st.tuples(unit, unit, unit, unit).filter(lambda q: sum(x * x for x in q) > 0.01)
points = st.tuples(*[st.floats(-3, 3, allow_nan=False)] * 3)


def pose(quaternion: tuple[float, ...], translation: tuple[float, ...]) -> torch.Tensor:
    return torch.from_numpy(pose_from_quaternion_wxyz(np.array(translation), np.array(quaternion)))


def test_rot6d_is_the_first_two_columns_one_after_the_other():
    rotation = torch.arange(9.0).reshape(3, 3)
    assert rot6d_from_rotation(rotation).tolist() == [0, 3, 6, 1, 4, 7]


@steady
@given(quaternions, points)
def test_every_pose_is_rigid_and_its_scaled_copy_is_not(quaternion, translation):
    T = pose(quaternion, translation)
    assert bool(is_rigid(T))
    scaled = T.clone()
    scaled[:3, :3] *= 1.01
    assert not bool(is_rigid(scaled))


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


@pytest.mark.parametrize("shape", [(9, 50, 2), (20, 7, 3), (4, 5, 6, 3), (2, 2)])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_lengths_are_numpys_to_the_bit(shape: tuple[int, ...], kind: type) -> None:
    vectors = np.random.default_rng(0).normal(size=shape).astype(kind)
    for each in (vectors, np.asfortranarray(vectors), vectors[::2]):
        expected = np.linalg.norm(each, axis=-1)
        assert lengths(each).dtype == expected.dtype
        assert np.array_equal(lengths(each), expected)
