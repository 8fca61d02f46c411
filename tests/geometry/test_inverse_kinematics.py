"""Inverse kinematics against forward kinematics."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.embodiment_report import random_states
from worldline_core.geometry.kinematics import ArmKinematics, InverseKinematics
from worldline_core.geometry.transforms import rotation_about_axis, rotation_angle


@cache
def solver(name: str) -> InverseKinematics:
    return InverseKinematics(ArmKinematics(load_embodiment(name)))


def tools(inverse: InverseKinematics, state: np.ndarray) -> np.ndarray:
    return inverse.kinematics.tool_poses(state[None])[0].numpy()


@pytest.mark.parametrize("name", ["aloha_viperx", "kinova_gen3", "so101"])
def test_jacobians_agree_with_finite_differences(name: str) -> None:
    inverse = solver(name)
    embodiment = inverse.kinematics.embodiment
    state = random_states(embodiment, 1, 3)[0]
    for a, (arm, jacobian) in enumerate(zip(embodiment.arms, inverse.jacobians(state)[1], strict=True)):
        for d, column in enumerate(range(*embodiment.joint_columns(arm).indices(embodiment.state_size))):
            step = 1e-5 * (np.arange(len(state)) == column)
            T_ahead, T_behind = tools(inverse, state + step)[a], tools(inverse, state - step)[a]
            spin = Rotation.from_matrix(T_ahead[:3, :3] @ T_behind[:3, :3].T).as_rotvec()
            expected = np.concatenate([T_ahead[:3, 3] - T_behind[:3, 3], spin]) / 2e-5
            assert np.allclose(jacobian[:, d], expected, atol=1e-5), arm.joints[d]


@pytest.mark.parametrize(
    "name", ["ur5e_pair", "xarm7_pair", "aloha_viperx", "kinova_gen3", "panda_pair", "yam_station"]
)
def test_reachable_poses_are_reached_within_the_limits(name: str) -> None:
    inverse = solver(name)
    embodiment = inverse.kinematics.embodiment
    generator = np.random.default_rng(0)
    reached = []
    for state in random_states(embodiment, 10, 5):
        wanted = tools(inverse, state)
        start = state + generator.normal(0, 0.25, state.shape)
        found = inverse.solve(start, wanted, iterations=60)
        assert not embodiment.outside_limits(found.state[None], 0.0).any()
        there = tools(inverse, found.state)
        errors = np.linalg.norm(there[:, :3, 3] - wanted[:, :3, 3], axis=1)
        turns = rotation_angle(np.swapaxes(there[:, :3, :3], 1, 2) @ wanted[:, :3, :3])
        assert np.allclose(found.position_error_m, errors, atol=1e-9)
        assert np.allclose(found.rotation_error_rad, turns, atol=1e-6)
        for arm in embodiment.arms:
            assert found.state[embodiment.gripper_column(arm)] == start[embodiment.gripper_column(arm)]
        reached += list((errors < 1e-3) & (turns < 1e-2))
    # From a start a quarter of a radian away at every joint a few land at the far side of a joint's limit.
    assert np.mean(reached) >= 0.9


@pytest.mark.parametrize("name", ["ur5e_pair", "so101"])
def test_poses_out_of_reach_end_at_a_steady_near_one(name: str) -> None:
    """Also the five joints of the SO-101, which cannot have every orientation: no shaking, no error."""
    inverse = solver(name)
    embodiment = inverse.kinematics.embodiment
    state = random_states(embodiment, 1, 1)[0]
    wanted = tools(inverse, state)
    wanted[:, :3, 3] += (1.5, 0.0, 0.0)
    wanted[:, :3, :3] = wanted[:, :3, :3] @ rotation_about_axis(np.array([1.0, 0.0, 0.0]), 0.7)
    found = inverse.solve(state, wanted, iterations=80)
    assert not embodiment.outside_limits(found.state[None], 0.0).any()
    assert (found.position_error_m < np.linalg.norm(wanted[:, :3, 3] - tools(inverse, state)[:, :3, 3], axis=1)).all()
    again = inverse.solve(found.state, wanted, iterations=40)
    assert np.abs(again.state - found.state).max() < 0.1
    assert (again.position_error_m <= found.position_error_m + 1e-2).all()


def test_a_straight_drive_follows_in_few_iterations() -> None:
    """Targets as from a gamepad: centimetres a frame, from where the arm is."""
    inverse = solver("ur5e_pair")
    state = np.array([0.2, -1.2, 1.6, -1.9, -1.57, 0.0, 0.5, 0.2, -1.2, 1.6, -1.9, -1.57, 0.0, 0.5])
    wanted = tools(inverse, state)
    for _ in range(10):
        wanted[:, :3, 3] += (0.01, 0.0, 0.01)
        found = inverse.solve(state, wanted, iterations=6)
        assert found.position_error_m.max() < 1e-3
        assert np.abs(found.state - state).max() < 0.2
        state = found.state


@pytest.mark.parametrize(
    ("state", "wanted", "said"),
    [
        (np.zeros(14), np.eye(4)[None], r"(?s)Wanted tool poses.*\(2, 4, 4\)"),
        (np.zeros(14), np.full((2, 4, 4), np.nan), "Wanted tool poses"),
        (np.full(14, np.nan), np.stack([np.eye(4)] * 2), "not finite"),
        (np.zeros(13), np.stack([np.eye(4)] * 2), "wrong length"),
    ],
)
def test_what_does_not_fit_is_refused(state: np.ndarray, wanted: np.ndarray, said: str) -> None:
    with pytest.raises(DataError, match=said):
        solver("ur5e_pair").solve(state, wanted)
