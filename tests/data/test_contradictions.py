"""Tracks that contradict each other are refused, whatever the source; recorded poses are repaired and counted, or refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.data.conftest import make_sample
from tests.data.curating import record, rejected, run
from tools.corrupted.conventions import written_as_moving, written_as_wxyz
from worldline_core.data.curation.recorded_episode import check_commands, check_joints, check_tool_poses
from worldline_core.data.episodes.conventions import RecordedConventions, apply_conventions
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.recorded_poses import with_rigid_poses
from worldline_core.data.episodes.source import joint_names
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematic_tree import read_tree, tool_poses
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import (
    pose_from_euler_fixed_xyz,
    reread_as_moving,
    reread_as_wxyz,
    rotation_deviation,
)

LENGTH = 90
Change = Callable[[np.ndarray], np.ndarray]


def episode(arms: tuple[str, ...] = ("left", "right"), **changes: object) -> Episode:
    """Arms of seven joints and a gripper in slow motion; commands lead by five frames."""
    time = np.arange(LENGTH + 5)[:, None] / 30
    phase = np.arange(8 * len(arms))
    motion = np.array([0.1, -0.4, 0.3, -1.6, 0.2, 1.5, 0.4, 0.5] * len(arms)) + 0.3 * np.sin(1.3 * time + phase)
    values = motion.astype(np.float32)
    tracks = {"state": values[:LENGTH], "action": values[5:], "state_names": joint_names(dict.fromkeys(arms, 7))}
    described = {"embodiment": "none", "fps": 30.0, "timestamps": np.arange(LENGTH) / 30, "cameras": {}, **tracks}
    return make_sample(num_frames=LENGTH, views=(), **{**described, **changes})[0]


def refused(check: Callable[[Episode], None], told: Episode, message: str) -> str:
    """The reason."""
    with pytest.raises(RejectedInputError, match=message) as caught:
        check(told)
    return caught.value.reason


def part(chosen: object, change: Change) -> Change:
    """A change of some columns, or of another part, alone."""

    def changed(values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[chosen] = change(values[chosen])  # type: ignore[index]
        return values

    return changed


def columns(chosen: object, change: Change) -> Change:
    return part((slice(None), chosen), change)


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
        told = replace(told, state=columns([7], lambda _: square[:, None])(good.state))
        told.action[:, 7] = 1 - square
    if meaning is None:
        check_commands(told)
    else:
        assert refused(check_commands, told, meaning) == "contradicting_tracks"
    if name == "degrees":
        assert refused(check_joints, told, "Commands of joints are no angles") == "joint_out_of_range"


def test_an_arm_at_rest_may_have_no_commands() -> None:
    state, action = episode().state.copy(), episode().action.copy()
    state[:, :8], action[:, :8] = state[:1, :8], 0
    check_commands(episode(state=state, action=action))
    check_commands(episode(state=state, action=state, conventions={"action": "repeats the state"}))


@pytest.mark.parametrize("name", ["right/gripper", "gripper.pos", "main_gripper"])
def test_a_gripper_of_an_undescribed_robot_is_an_opening_too(name: str) -> None:
    for reading, kept in ((0.9, True), (1.66, False), (-0.5, False)):
        values = np.full((LENGTH, 1), reading, np.float32)
        one = episode(state=values, action=values, state_names=(name,))
        if kept:
            check_joints(one)
        else:
            assert refused(check_joints, one, "closed and open") == "invalid_gripper"


def panda() -> Episode:
    robot = load_embodiment("droid_franka")
    one = episode(("right",), embodiment="droid_franka")
    return replace(one, T_base_ee=tool_poses(robot, read_tree(robot), one.state), gripper=one.state[:, 7:])


def reread(change: Change) -> Change:
    return part((..., slice(3), slice(3)), change)


def moved(change: Change) -> Change:
    return part((..., slice(3), 3), change)


TOOL = pose_from_euler_fixed_xyz(np.array([0.0, 0.02, 0.155]), np.array([0.0, 0.3, 1.0]))
POSES: dict[str, tuple[Change, bool]] = {
    "as the joints": (lambda poses: poses, True),
    "another point of the gripper": (lambda poses: poses @ TOOL, True),
    "a description that is a centimetre off": (moved(lambda places: places + np.array([0.01, 0, 0])), True),
    "millimetres": (moved(lambda places: 1000 * places), False),
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
    else:
        assert refused(check_tool_poses, told, "do not move the tools") == "contradicting_tracks"
    if name == "millimetres":
        check_tool_poses(apply_conventions(told, RecordedConventions(pose_unit="mm")))


def test_a_flipped_joint_contradicts_the_tool_poses() -> None:
    good = panda()
    for joint in range(7):
        told = replace(good, state=columns([joint], np.negative)(good.state))
        assert refused(check_tool_poses, told, "do not move the tools") == "contradicting_tracks"


@pytest.mark.parametrize("name", ["droid_franka", "yam_station", "ur5e_pair"])
def test_kinematics_without_torch_are_those_with_it(name: str) -> None:
    robot = load_embodiment(name)
    state = np.random.default_rng(0).uniform(-1, 1, (5, robot.state_size))
    expected = ArmKinematics(robot).tool_poses(state).numpy()
    np.testing.assert_allclose(tool_poses(robot, read_tree(robot), state), expected, atol=1e-12)


def test_a_wrong_reading_and_its_repair_cancel() -> None:
    rotations = Rotation.random(100, random_state=2).as_matrix()
    for write, read in ((written_as_wxyz, reread_as_wxyz), (written_as_moving, reread_as_moving)):
        wrong = write(rotations)
        assert np.abs(wrong - rotations).max() > 0.1
        assert np.abs(read(wrong) - rotations).max() < 1e-9
    # From the definition: the four numbers are the same, read in the other order.
    xyzw = Rotation.from_matrix(rotations).as_quat()
    expected = Rotation.from_quat(np.roll(xyzw, 1, axis=1)).as_matrix()
    assert np.abs(written_as_wxyz(rotations) - expected).max() < 1e-9


def sheared(poses: np.ndarray, frame: int, deviation: float) -> np.ndarray:
    result = poses.copy()
    shear = np.eye(3)
    shear[0, 1] = deviation
    result[frame, ..., :3, :3] = shear @ result[frame, ..., :3, :3]
    return result


def test_both_sides_of_the_threshold_show_in_the_curated_set(tmp_path: Path) -> None:
    samples = []
    for number, deviation in enumerate((0.0, 0.9e-3, 1.1e-3)):
        episode, *pictures = make_sample(number)
        wrist = episode.cameras["left_wrist"]
        wrist = replace(wrist, T_base_camera=sheared(wrist.T_base_camera, 4, deviation))
        samples.append((replace(episode, cameras={**episode.cameras, "left_wrist": wrist}), *pictures))
    counts, curated = run(tmp_path, {"kind": "episode_set", "path": str(record(tmp_path / "raw", samples))})
    assert (counts["kept"], counts["reasons"]) == (2, {"invalid_extrinsics": 1})
    clean, repaired = curated.episode(0), curated.episode(1)
    assert not any(key.startswith("rotations_repaired") for key in clean.conventions)
    assert np.array_equal(clean.cameras["left_wrist"].T_base_camera, samples[0][0].cameras["left_wrist"].T_base_camera)
    assert repaired.conventions["rotations_repaired"] == 1
    assert repaired.conventions["rotations_repaired_of"] == "left_wrist"
    assert repaired.conventions["rotations_repaired_largest_deviation"] == pytest.approx(0.9e-3, rel=1e-2)
    assert rotation_deviation(repaired.cameras["left_wrist"].T_base_camera[:, :3, :3]).max() < 1e-12
    (row,) = curated.quarantine()
    assert row.numbers.items() >= {"view": "left_wrist", "frame": 4, "frames": 1}.items()
    assert row.numbers["rotation_deviation"] == pytest.approx(1.1e-3, rel=1e-2)


def test_tool_poses_are_held_to_the_same() -> None:
    tools = np.tile(np.eye(4), (9, 2, 1, 1))
    values = {"T_base_ee": sheared(tools, 3, 5e-4), "gripper": np.zeros((9, 2))}
    repaired = with_rigid_poses(make_sample(0, **values)[0])
    assert repaired.conventions["rotations_repaired"] == 2  # both arms of frame 3
    assert repaired.conventions["rotations_repaired_of"] == "tool poses"
    assert rotation_deviation(repaired.T_base_ee[..., :3, :3]).max() < 1e-12
    values["T_base_ee"] = sheared(tools, 3, 5e-3)
    with rejected("invalid_tool_pose", r"Not a rigid transform[\s\S]*tool poses, frame 3") as caught:
        with_rigid_poses(make_sample(0, **values)[0])
    assert caught.value.evidence["rotation_deviation"] == pytest.approx(5e-3, rel=1e-2)


@pytest.mark.parametrize("track", ["state", "action"])
def test_a_zero_quaternion_in_a_state_of_tool_poses_is_quarantined(track: str) -> None:
    names = tuple(f"{a}/{n}" for a in ("left", "right") for n in ("x", "y", "z", "qx", "qy", "qz", "qw", "gripper"))
    rows = np.tile(np.array([0.1, 0.2, 0.3, 0, 0, 0, 1, 0.5] * 2, np.float32), (9, 1))
    arrays = {"state": rows.copy(), "action": rows.copy()}
    given = {"state_names": names, "state_kind": "ee_pose"}
    whole = make_sample(0, **arrays, **given)[0]
    assert with_rigid_poses(whole) is whole
    arrays[track][5, 11:15] = 0
    with rejected("nan_state", rf"no direction[\s\S]*{track} right/qx, entry 5") as caught:
        with_rigid_poses(make_sample(0, **arrays, **given)[0])
    assert caught.value.evidence["columns"] == ["right/qx", "right/qy", "right/qz", "right/qw"]
