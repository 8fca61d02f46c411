"""Resampling and clocks against independent computations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap.images import spoiled_frames
from worldline_core.data.mcap.timing import Clock, hold, in_order, instants, interpolated_poses, linear, nearest, slerp

MS = 1_000_000


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_slerp_is_that_of_scipy_whatever_the_sign(seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.integers(1 * MS, 60 * MS, 12))
    quaternions = Rotation.random(12, rng=rng).as_quat() * rng.choice([-1.0, 1.0], (12, 1))
    places = rng.normal(size=(12, 3))
    grid = np.sort(rng.integers(times[0], times[-1], 30))
    found = interpolated_poses(times, np.concatenate([places, quaternions], axis=1), grid)
    expected = Slerp(times.astype(float), Rotation.from_quat(quaternions))(grid.astype(float))
    assert (Rotation.from_quat(found[:, 3:]).inv() * expected).magnitude().max() < 1e-6
    for axis in range(3):
        assert np.allclose(found[:, axis], np.interp(grid, times, places[:, axis]))


@given(st.integers(0, 2**32 - 1), st.integers(1, 20))
@settings(max_examples=60, deadline=None)
def test_nearest_and_linear_are_those_of_a_search(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.integers(1, 50, count))
    grid = np.sort(rng.integers(times[0] - 20, times[-1] + 20, 25))
    found = nearest(times, grid)
    distance = np.abs(times[None] - grid[:, None])
    assert np.array_equal(np.abs(times[found] - grid), distance.min(axis=1))
    values = rng.normal(size=(count, 2))
    interpolated = linear(times, values, grid)
    assert np.allclose(interpolated[:, 1], np.interp(grid, times, values[:, 1]))
    held = hold(times, values, grid)
    last = [max([i for i in range(count) if times[i] <= t], default=0) for t in grid]
    assert np.array_equal(held, values[last])


def test_equal_quaternions_and_half_turns_are_interpolated() -> None:
    same = np.array([[0.0, 0.0, 0.0, 1.0]])
    assert np.allclose(slerp(same, same, np.array([0.3])), same)
    turned = np.array([[0.0, 0.0, 1.0, 0.0]])
    half = slerp(same, turned, np.array([0.5]))
    assert np.allclose(np.abs(half), np.sqrt([[0, 0, 0.5, 0.5]]))


@pytest.mark.parametrize("fps", [30.0, 29.97, 10.0, 7.5])
def test_instants_do_not_drift(fps: float) -> None:
    grid = instants(1_700_000_000 * 10**9, 1_700_000_000 * 10**9 + 3600 * 10**9, fps)
    assert len(grid) == int(3600 * fps + 1e-6) + 1
    exact = np.arange(len(grid)) / fps * 1e9
    assert np.abs((grid - grid[0]) - exact).max() <= 1


def test_drift_and_skew_of_a_clock_are_found_under_jitter() -> None:
    rng = np.random.default_rng(2)
    true = np.arange(0, 120 * 10**9, 33 * MS)
    delay = 4 * MS + rng.exponential(3 * MS, len(true)).astype(np.int64)
    drifting = true + (true * 80e-6).astype(np.int64) - 250 * MS  # 80 ppm fast, a quarter second behind
    clock = Clock.of(drifting, true + delay)
    assert clock.drift_ppm == pytest.approx(-80, abs=5)
    steady = Clock.of(true, true + delay)
    assert steady.drift_ppm == pytest.approx(0, abs=5)
    assert steady.least_delay_ms == pytest.approx(4, abs=0.2)
    assert clock.least_delay_ms - steady.least_delay_ms == pytest.approx(250 - 120e3 * 80e-6, abs=1)
    assert Clock.of(true[:100], true[:100] + delay[:100]).drift_ppm is None  # three seconds show no drift


def test_lost_messages_are_counted_and_jitter_is_not() -> None:
    rng = np.random.default_rng(1)
    regular = np.arange(300) * 10 * MS
    jittered = regular + rng.uniform(-4 * MS, 4 * MS, 300).astype(np.int64)
    assert in_order(np.sort(jittered), "x", 1.0).lost <= 3
    assert in_order(regular[~np.isin(np.arange(300), [5, 50, 51, 200])], "x", 1.0).lost == 4
    assert in_order(regular[:1], "x", 1.0).median_step_ns == 0
    with pytest.raises(RejectedInputError, match="jump back"):
        in_order(np.concatenate([regular, regular]), "x", 1.0)


def test_video_is_spoiled_from_a_gap_to_the_next_key_frame() -> None:
    times = np.delete(np.arange(12) * 33 * MS, 5)
    keys = np.zeros(11, bool)
    keys[[0, 7]] = True
    assert np.flatnonzero(spoiled_frames(times, 33.0 * MS, keys)).tolist() == [5, 6]
    keys[5] = True
    assert not spoiled_frames(times, 33.0 * MS, keys).any()
