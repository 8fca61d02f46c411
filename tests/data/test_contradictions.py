"""Tracks of one recording that contradict each other are refused, whatever the source; what is merely unusual is kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from worldline_core.data.curation.episode_checks import check_commands, check_joints, check_tool_poses
from worldline_core.data.episodes.conventions import RecordedConventions, apply_conventions
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.source import joint_names
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematic_tree import read_tree, tool_poses
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import (
    pose_from_euler_fixed_xyz,
    reread_as_moving,
    reread_as_wxyz,
)

LENGTH = 90
Change = Callable[[np.ndarray], np.ndarray]


def episode(arms: tuple[str, ...] = ("left", "right"), **changes: object) -> Episode:
    """Arms of seven joints and a gripper in slow motion; commands lead by five frames."""
    time = np.arange(LENGTH + 5)[:, None] / 30
    phase = np.arange(8 * len(arms))
    motion = np.array([0.1, -0.4, 0.3, -1.6, 0.2, 1.5, 0.4, 0.5] * len(arms)) + 0.3 * np.sin(1.3 * time + phase)
    values = motion.astype(np.float32)
    described = {
        "episode_id": "a", "source": "test", "embodiment": "none", "scene": "s", "task_family": "unknown", "instruction": "",
        "outcome": "unknown", "split": "test", "fps": 30.0, "state": values[:LENGTH], "action": values[5:],
        "timestamps": np.arange(LENGTH) / 30, "state_names": joint_names(dict.fromkeys(arms, 7)),
    }  # fmt: skip
    return Episode(**{**described, **changes})  # type: ignore[arg-type]


def columns(chosen: object, change: Change) -> Change:
    """A change of some columns alone."""

    def changed(values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[:, chosen] = change(values[:, chosen])  # type: ignore[index]
        return values

    return changed


JOINTS = [*range(7), *range(8, 15)]
COMMANDS: dict[str, tuple[Change, str | None]] = {
    "as the states": (lambda v: v, None),
    "a little off": (lambda v: v + 0.08, None),
    "other sign": (columns(JOINTS, np.negative), "other sign"),
    "one joint's sign": (columns([11], np.negative), "other sign"),
    "twice as large": (columns(JOINTS, lambda v: 2 * v), None),  # a motion of its own
    "degrees": (columns(JOINTS, np.rad2deg), "degrees, the states radians"),
    "radians of degrees": (columns(JOINTS, np.deg2rad), "radians, the states degrees"),
    "the other arm's": (lambda v: np.roll(v, 8, axis=1), "other arm"),
    "differences": (columns(JOINTS, lambda v: np.gradient(v, axis=0)), "relative"),
    "never written": (columns(JOINTS, np.zeros_like), "relative"),
    "inverted gripper": (columns([7], lambda v: 1 - v), "inverted openings"),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_commands_that_contradict_the_states_are_refused(name: str) -> None:
    change, meaning = COMMANDS[name]
    good = episode()
    told = replace(good, action=change(good.action).astype(np.float32))
    # An opening about 0.5 looks alike both ways: this one opens and closes.
    if name == "inverted gripper":
        square = (np.arange(LENGTH) // 30 % 2).astype(np.float32)
        state = good.state.copy()
        state[:, 7], told.action[:, 7] = square, 1 - square
        told = replace(told, state=state)
    if meaning is None:
        check_commands(told)
        return
    with pytest.raises(RejectedInputError, match=meaning) as caught:
        check_commands(told)
    assert caught.value.reason == "contradicting_tracks"


def test_commands_in_degrees_are_no_angles() -> None:
    good = episode()
    with pytest.raises(RejectedInputError, match="Commands of joints are no angles") as caught:
        check_joints(replace(good, action=columns(JOINTS, np.rad2deg)(good.action)))
    assert caught.value.reason == "joint_out_of_range"


def test_an_arm_at_rest_may_have_no_commands() -> None:
    state, action = episode().state.copy(), episode().action.copy()
    state[:, :8], action[:, :8] = state[:1, :8], 0
    check_commands(episode(state=state, action=action))
    check_commands(episode(state=state, action=state, conventions={"action": "repeats the state"}))


@pytest.mark.parametrize("names", [("right/gripper",), ("gripper.pos",), ("main_gripper",)])
@pytest.mark.parametrize(("reading", "kept"), [(0.9, True), (1.66, False), (-0.5, False)])
def test_a_gripper_of_an_undescribed_robot_is_an_opening_too(
    names: tuple[str, ...], reading: float, kept: bool
) -> None:
    values = np.full((LENGTH, 1), reading, np.float32)
    one = episode(state=values, action=values, state_names=names)
    if kept:
        check_joints(one)
        return
    with pytest.raises(RejectedInputError, match="closed and open") as caught:
        check_joints(one)
    assert caught.value.reason == "invalid_gripper"


def panda() -> Episode:
    robot = load_embodiment("droid_franka")
    one = episode(("right",), embodiment="droid_franka")
    return replace(one, T_base_ee=tool_poses(robot, read_tree(robot), one.state), gripper=one.state[:, 7:])


def reread(change: Change) -> Change:
    def changed(poses: np.ndarray) -> np.ndarray:
        poses = poses.copy()
        poses[..., :3, :3] = change(poses[..., :3, :3])
        return poses

    return changed


TOOL = pose_from_euler_fixed_xyz(np.array([0.0, 0.02, 0.155]), np.array([0.0, 0.3, 1.0]))
POSES: dict[str, tuple[Change, bool]] = {
    "as the joints": (lambda poses: poses, True),
    "another point of the gripper": (lambda poses: poses @ TOOL, True),
    "a description that is a centimetre off": (
        lambda poses: poses + 0.01 * np.eye(4)[0, 0] * (np.arange(4) == 3) * [[1], [0], [0], [0]],
        True,
    ),
    "millimetres": (lambda poses: poses * np.where(np.arange(4) == 3, [[1000]] * 3 + [[1]], 1), False),
    "moving Euler angles": (reread(reread_as_moving), False),
    "another order of quaternions": (reread(reread_as_wxyz), False),
    "those of another recording": (lambda poses: poses[::-1], False),
}


@pytest.mark.parametrize("name", POSES)
def test_tool_poses_that_contradict_the_joints_are_refused(name: str) -> None:
    change, kept = POSES[name]
    good = panda()
    told = replace(good, T_base_ee=change(np.asarray(good.T_base_ee)))
    if kept:
        check_tool_poses(told)
        return
    with pytest.raises(RejectedInputError, match="do not move the tools") as caught:
        check_tool_poses(told)
    assert caught.value.reason == "contradicting_tracks"
    if name == "millimetres":
        check_tool_poses(apply_conventions(told, RecordedConventions(pose_unit="mm")))


@pytest.mark.parametrize("joint", range(7))
def test_a_flipped_joint_contradicts_the_tool_poses(joint: int) -> None:
    good = panda()
    with pytest.raises(RejectedInputError, match="do not move the tools"):
        check_tool_poses(replace(good, state=columns([joint], np.negative)(good.state)))


@pytest.mark.parametrize("name", ["droid_franka", "yam_station", "ur5e_pair"])
def test_kinematics_without_torch_are_those_with_it(name: str) -> None:
    robot = load_embodiment(name)
    state = np.random.default_rng(0).uniform(-1, 1, (5, robot.state_size))
    expected = ArmKinematics(robot).tool_poses(state).numpy()
    np.testing.assert_allclose(tool_poses(robot, read_tree(robot), state), expected, atol=1e-12)
