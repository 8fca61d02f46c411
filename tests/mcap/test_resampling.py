"""Resampling and clocks against independent computations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldline_core.data.mcap.resampling import instants, nearest, resampled, resampled_poses

MS = 1_000_000


@given(st.integers(0, 2**32 - 1), st.integers(1, 20))
@settings(max_examples=60, deadline=None)
def test_instants_get_the_nearest_the_last_or_what_lies_between(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    times = 1_700_000_000 * 10**9 + np.cumsum(rng.integers(1, 50, count))
    grid = np.sort(rng.integers(times[0] - 20, times[-1] + 20, 25))
    distance = np.abs(times[None] - grid[:, None])
    assert np.array_equal(np.abs(times[nearest(times, grid)] - grid), distance.min(axis=1))
    values = rng.normal(size=(count, 2))
    last = [max([i for i in range(count) if times[i] <= t], default=0) for t in grid]
    assert np.array_equal(resampled(times, values, grid, hold=True), values[last])
    between = resampled(times, values, grid)
    before = np.maximum(np.searchsorted(times, grid, side="right") - 1, 0)
    after = np.minimum(before + 1, count - 1)
    share = np.clip((grid - times[before]) / np.maximum(times[after] - times[before], 1), 0, 1)[:, None]
    assert np.allclose(between, values[before] + share * (values[after] - values[before]))


def test_poses_turn_on_the_shorter_arc_whatever_the_sign_of_their_quaternions() -> None:
    angles = np.array([0.0, 0.4, 0.4, 2.0])
    poses = np.zeros((4, 7))
    poses[:, 0] = angles
    poses[:, 5], poses[:, 6] = np.sin(angles / 2), np.cos(angles / 2)
    poses[2, 3:] *= -3.0  # of any sign and length
    times = 10**18 + np.arange(4) * MS
    for at, angle in ((0.5, 0.2), (1.3, 0.4), (2.25, 0.8), (-1.0, 0.0), (9.0, 2.0)):
        (pose,) = resampled_poses(times, poses, np.array([10**18 + round(at * MS)]))
        turned = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        assert pose[:2, :2] == pytest.approx(np.array(turned)) and pose[0, 3] == pytest.approx(angle)
    assert np.array_equal(resampled_poses(times[:1], poses[:1], times), np.tile(np.eye(4), (4, 1, 1)))


@pytest.mark.parametrize("fps", [30.0, 29.97, 10.0, 7.5])
def test_instants_do_not_drift(fps: float) -> None:
    grid = instants(1_700_000_000 * 10**9, 1_700_000_000 * 10**9 + 3600 * 10**9, fps)
    assert len(grid) == int(3600 * fps + 1e-6) + 1
    exact = np.arange(len(grid)) / fps * 1e9
    assert np.abs((grid - grid[0]) - exact).max() <= 1
