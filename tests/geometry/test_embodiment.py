"""Embodiment files: strict, with errors that name what is valid."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from worldline_core.errors import ConfigError, DataError, UnavailableError
from worldline_core.geometry.embodiment import embodiment_names, load_embodiment, read_description
from worldline_core.geometry.kinematics import ArmKinematics

ARM = {
    "name": "right", "joints": ["pan", "lift"], "limits": [[-1.0, 1.0], [-2.0, 2.0]], "end_effector_link": "hand",
    "gripper": {"closed": 0.0, "open": 0.04},
}  # fmt: skip
BODY = {"name": "toy", "description": {"format": "mjcf", "file": "toy.xml"}, "base_link": "world", "arms": [ARM]}


def write(tmp_path, **changes):
    path = tmp_path / "toy.yaml"
    path.write_text(yaml.safe_dump({**BODY, **changes}))
    return path


@pytest.mark.parametrize("name", embodiment_names())
def test_every_shipped_file_is_valid_orders_its_state_and_has_a_description_or_says_where_to_get_it(name, monkeypatch):
    monkeypatch.delenv(f"WORLDLINE_DESCRIPTION_{name.upper()}", raising=False)
    embodiment = load_embodiment(name)
    assert embodiment.name == name
    assert len(embodiment.state_names) == embodiment.state_size
    columns = list(range(embodiment.state_size))
    joints = [c for arm in embodiment.arms for c in columns[embodiment.joint_columns(arm)]]
    assert sorted(joints + [embodiment.gripper_column(arm) for arm in embodiment.arms]) == columns
    if embodiment.description_path.is_file():
        assert read_description(embodiment)
    else:
        with pytest.raises(UnavailableError, match=r"take .* from github.com"):
            read_description(embodiment)


def test_unknown_name_lists_the_known_ones():
    with pytest.raises(ConfigError, match=r"agibot_g1[\s\S]*did you mean 'agibot_g1'"):
        load_embodiment("agibot_g2")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"limits": [[-1.0, 1.0]]}, "1 limits for 2 joints"),
        ({"limits": [[1.0, -1.0], [-2.0, 2.0]]}, "lower limit is not below"),
        ({"limits": [[float("nan"), 1.0], [-2.0, 2.0]]}, "lower limit is not below"),
        ({"gripper": {"closed": 0.5, "open": 0.5}}, "closed and open are equal"),
        ({"T_link_tool": {"rotation_wxyz": [1.002, 0.0, 0.0, 0.0]}}, "rotation_wxyz has length 1.002"),
        ({"T_link_tool": {"rotation_wxyz": [0.0, 0.0, 0.0, 0.0]}}, "rotation_wxyz has length"),
        ({"wrist_camera": {"link": "hand", "T_link_camera": [[1.0, 0.0], [0.0, 1.0]]}}, "not a 4x4 matrix"),
        (
            {"wrist_camera": {"link": "hand", "T_link_camera": np.diag([1.0, 1.0, -1.0, 1.0]).tolist()}},
            "not a rigid transform",
        ),
        ({"joints": ["pan", "pan"]}, "joints named twice: pan"),
        ({"end_efector_link": "hand"}, "end_efector_link"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, change, message):
    with pytest.raises(ConfigError, match=message):
        load_embodiment(write(tmp_path, arms=[{**ARM, **change}]))


def test_quaternion_with_rounding_errors_is_normalised(tmp_path):
    arm = {**ARM, "T_link_tool": {"rotation_wxyz": [0.7067, 0.0, 0.7067, 0.0]}}
    T = load_embodiment(write(tmp_path, arms=[arm])).arms[0].T_link_tool.matrix()
    np.testing.assert_allclose(T[:3, :3], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=1e-12)


def test_own_file_and_variable_go_before_the_file_beside_the_yaml(tmp_path, monkeypatch):
    path, mine = write(tmp_path), tmp_path / "mine.xml"
    mine.write_text("mine")
    monkeypatch.setenv("WORLDLINE_DESCRIPTION_TOY", str(mine))
    assert read_description(load_embodiment(path)) == "mine"
    assert load_embodiment(path, tmp_path / "other.xml").description_path.name == "other.xml"


def test_states_of_another_length_or_no_numbers_are_named(tmp_path):
    embodiment = load_embodiment(write(tmp_path))
    with pytest.raises(DataError, match=r"wrong length[\s\S]*\(N, 3\): pan, lift, right/gripper[\s\S]*\(5, 4\)"):
        embodiment.check_state(np.zeros((5, 4)), "episode 3")
    state = np.zeros((5, 3))
    state[4, 1] = np.nan
    with pytest.raises(DataError, match=r"not finite[\s\S]*frame 4, lift"):
        embodiment.check_state(state, "episode 3")


def test_limits_are_checked_joint_by_joint_and_never_for_the_gripper(tmp_path):
    toy = load_embodiment(write(tmp_path))
    state = np.array([[0.0, 0.0, 9.0], [1.5, 0.0, 0.0], [0.0, -2.01, 0.0]])
    assert toy.outside_limits(state).tolist() == [[False] * 3, [True, False, False], [False] * 3]
    with pytest.raises(DataError, match=r"episode 3.*frame 1, pan[\s\S]*-1 to 1[\s\S]*1\.5; 1 of 3 frames"):
        toy.check_limits(state, "episode 3")
    toy.check_limits(state[:1], "episode 3")
    free = {**ARM, "limits": [[float("-inf"), float("inf")], [-2.0, 2.0]]}
    assert not load_embodiment(write(tmp_path, arms=[free])).outside_limits(state).any()


def test_one_of_two_mounts_may_be_unknown_until_kinematics_are_needed(tmp_path):
    described = {"format": "mjcf", "file": "toy.xml", "mounts": {"left": {}, "right": "unknown"}}
    embodiment = load_embodiment(write(tmp_path, description=described))
    with pytest.raises(ConfigError, match=r"mounts.right[\s\S]*worldline calibrate estimate"):
        ArmKinematics(embodiment)
    with pytest.raises(ConfigError, match="one mount of two"):
        load_embodiment(write(tmp_path, description=described | {"mounts": {"left": "unknown", "right": "unknown"}}))
