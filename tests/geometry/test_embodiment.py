"""Embodiment files: strict, with errors that name what is valid."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from worldline_core.errors import ConfigError, DataError, UnavailableError
from worldline_core.geometry.embodiment import embodiment_names, load_embodiment, read_description

ARM = {
    "name": "right",
    "joints": ["pan", "lift"],
    "limits": [[-1.0, 1.0], [-2.0, 2.0]],
    "end_effector_link": "hand",
    "gripper": {"index_after_joints": True, "closed": 0.0, "open": 0.04},
}
BODY = {"name": "toy", "description": {"format": "mjcf", "file": "toy.xml"}, "base_link": "world", "arms": [ARM]}


def write(tmp_path, **changes):
    path = tmp_path / "toy.yaml"
    path.write_text(yaml.safe_dump({**BODY, **changes}))
    return path


@pytest.mark.parametrize("name", embodiment_names())
def test_every_shipped_file_is_valid_and_orders_its_state(name):
    embodiment = load_embodiment(name)
    assert embodiment.name == name
    assert len(embodiment.state_names) == embodiment.state_size
    columns = sorted(
        [c for arm in embodiment.arms for c in range(*embodiment.joint_columns(arm).indices(10**6))]
        + [embodiment.gripper_column(arm) for arm in embodiment.arms]
    )
    assert columns == list(range(embodiment.state_size))


def test_unknown_name_lists_the_known_ones():
    with pytest.raises(ConfigError, match=r"Unknown embodiment[\s\S]*agibot_g1[\s\S]*did you mean 'agibot_g1'"):
        load_embodiment("agibot_g2")


def test_unknown_key_is_an_error(tmp_path):
    with pytest.raises(ConfigError, match="end_efector_link"):
        load_embodiment(write(tmp_path, arms=[{**ARM, "end_efector_link": "hand"}]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"limits": [[-1.0, 1.0]]}, "1 limits for 2 joints"),
        ({"limits": [[1.0, -1.0], [-2.0, 2.0]]}, "lower limit is not below"),
        ({"gripper": {"closed": 0.5, "open": 0.5}}, "closed and open are equal"),
        ({"T_link_tool": {"rotation_wxyz": [1.0, 1.0, 0.0, 0.0]}}, "rotation_wxyz has length"),
        ({"wrist_camera": {"link": "hand", "T_link_camera": [[1.0, 0.0], [0.0, 1.0]]}}, "not a 4x4 matrix"),
        (
            {"wrist_camera": {"link": "hand", "T_link_camera": np.diag([1.0, 1.0, -1.0, 1.0]).tolist()}},
            "not a rigid transform",
        ),
        ({"joints": ["pan", "pan"]}, "joints named twice: pan"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, change, message):
    with pytest.raises(ConfigError, match=message):
        load_embodiment(write(tmp_path, arms=[{**ARM, **change}]))


def test_wrong_length_of_the_joint_vector_names_the_columns(tmp_path):
    embodiment = load_embodiment(write(tmp_path))
    with pytest.raises(DataError, match=r"wrong length[\s\S]*\(N, 3\): pan, lift, right/gripper[\s\S]*\(5, 4\)"):
        embodiment.check_state(np.zeros((5, 4)), "episode 3")


def test_nan_joint_names_frame_and_joint(tmp_path):
    state = np.zeros((5, 3))
    state[4, 1] = np.nan
    with pytest.raises(DataError, match=r"not finite[\s\S]*frame 4, lift"):
        load_embodiment(write(tmp_path)).check_state(state, "episode 3")


def test_limits_are_checked_joint_by_joint_and_never_for_the_gripper(tmp_path):
    state = np.array([[0.0, 0.0, 9.0], [1.5, 0.0, 0.0], [0.0, -2.01, 0.0]])
    outside = load_embodiment(write(tmp_path)).outside_limits(state)
    assert outside.tolist() == [[False] * 3, [True, False, False], [False] * 3]


def test_missing_description_says_how_to_get_it(monkeypatch, tmp_path):
    monkeypatch.delenv("WORLDLINE_DESCRIPTION_AGIBOT_G1", raising=False)
    embodiment = load_embodiment("agibot_g1")
    with pytest.raises(UnavailableError, match=r"cosmos-framework[\s\S]*WORLDLINE_DESCRIPTION_AGIBOT_G1"):
        read_description(embodiment)
    monkeypatch.setenv("WORLDLINE_DESCRIPTION_AGIBOT_G1", str(tmp_path / "here.urdf"))
    (tmp_path / "here.urdf").write_text("<robot/>")
    assert read_description(load_embodiment("agibot_g1")) == "<robot/>"
    (tmp_path / "there.urdf").write_text("<robot name='there'/>")
    assert "there" in read_description(load_embodiment("agibot_g1", tmp_path / "there.urdf"))
