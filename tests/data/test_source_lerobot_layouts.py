"""Galaxea, RoboCOIN and DROID through the shipped configurations; calibration files; DROID never trains."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from tests.data.curating import preset, reasons, run
from tests.data.published_lerobot import (
    FRAMES,
    picture,
    write_droid,
    write_galaxea,
    write_robocoin,
)  # fmt: skip
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.sources.lerobot import LeRobotSourceConfig, state_columns
from worldline_core.errors import ConfigError, DataError
from worldline_core.geometry.embodiment import load_embodiment


def robocoin(tmp_path: Path, **changes: Any) -> dict[str, Any]:
    return preset("robocoin", tmp_path / "raw", collection=False, **changes)


def test_galaxea(tmp_path: Path) -> None:
    columns = write_galaxea(tmp_path / "raw/Clean_The_Mirror/Clean_The_Mirror")
    shutil.copytree(tmp_path / "raw/Clean_The_Mirror", tmp_path / "raw/Other")
    (tmp_path / "raw/Other/Clean_The_Mirror/meta/info.json").write_text("{")
    _, curated = run(tmp_path, preset("galaxea", tmp_path / "raw"))
    assert reasons(curated) == {"galaxea-Other-Clean_The_Mirror": "unreadable"}
    (row,), episode = curated.rows, curated.episode(0)
    assert row.episode_id == "galaxea-Clean_The_Mirror-Clean_The_Mirror-000000"
    assert (row.scene, row.instruction) == ("galaxea-Clean_The_Mirror-Clean_The_Mirror", "clean the mirror")
    assert (row.fps, row.stage2_reason) == (15.0, "missing_calibration")
    joints = [*(f"joint_{i}" for i in range(1, 7)), "gripper"]
    assert episode.state_names == tuple(f"{arm}/{name}" for arm in ("left", "right") for name in joints)
    for start, arm in ((0, "left"), (7, "right")):
        assert np.allclose(episode.state[:, start : start + 6], columns[f"observation.state.{arm}_arm"], atol=1e-6)
        assert np.allclose(episode.action[:, start : start + 6], columns[f"action.{arm}_arm"], atol=1e-6)
        assert np.allclose(episode.state[:, start + 6], np.clip(np.linspace(1, -0.03, FRAMES), 0, 1), atol=1e-6)
        assert np.allclose(episode.action[:, start + 6], np.linspace(0.9, 0.1, FRAMES), atol=1e-6)
    assert episode.conventions["gripper_overshoot"] == 2
    # head_rgb is the first video, left_wrist_rgb the third, right_wrist_rgb the fourth.
    assert row.views == ("head", "left_wrist", "right_wrist")
    for seed, view in zip((0, 2, 3), row.views, strict=True):
        assert np.abs(curated.frames(0, view, [7])[0].astype(int) - picture(seed, 7)).mean() < 6


def test_robocoin(tmp_path: Path) -> None:
    state = write_robocoin(tmp_path / "raw/Cobot_Magic_move_the_bread", episodes=2)
    write_robocoin(tmp_path / "raw/Cobot_Magic_open")
    counts, curated = run(tmp_path, preset("robocoin", tmp_path / "raw"))
    assert (counts["found"], counts["kept"]) == (3, 2)
    # The first episodes of the two tasks were written alike: the content is what tells recordings apart.
    assert counts["reasons"] == {"duplicate": 1}
    episode = curated.episode(0)
    assert np.allclose(episode.state, state[:, [*range(7), *range(13, 20)]], atol=1e-6)
    assert np.allclose(episode.action[:, :6], state[:, :6] + 0.01, atol=1e-6)
    assert curated.rows[0].instruction == "move the bread"
    assert {row.scene for row in curated.rows} == {"robocoin-Cobot_Magic_move_the_bread"}


LIMITS = [[-2.0, 2.0], [-1.0, 3.0]]


@pytest.mark.parametrize(
    ("unit", "joints", "expected"),
    [
        ("deg", {}, np.deg2rad),
        ("deg", {"signs": [-1, 1], "zeros": [90, 0]}, lambda v: np.deg2rad(v) * [-1, 1] + [np.pi / 2, 0]),
        ("rad", {"signs": [1, -1]}, lambda v: v * [1, -1]),
        ("range_m100_100", {"ranges": LIMITS}, lambda v: v / 100 * 2 + [0, 1]),
        ("range_m100_100", {"ranges": LIMITS, "signs": [1, -1]}, lambda v: v / 100 * [2, -2] + [0, 1]),
        ("range_m100_100", {"ranges": [[2.0, -2.0], [-1.0, 3.0]]}, lambda v: v / 100 * [-2, 2] + [0, 1]),
    ],
)
def test_columns_by_place_in_lerobots_own_units(
    tmp_path: Path, unit: str, joints: dict[str, Any], expected: Any
) -> None:
    state = write_robocoin(tmp_path / "raw")
    gripper = {"feature": "observation.state", "indices": [19], "closed": 1, "open": 0}
    track = {"joints": {"feature": "observation.state", "indices": [13, 15], **joints}, "gripper": gripper}
    arms = [{"name": "right", "state": track} | ({"action": track} if joints else {})]
    episode = run(tmp_path, robocoin(tmp_path, arms=arms, angle_unit=unit))[1].episode(0)
    assert episode.state_names == ("right/joint_1", "right/joint_2", "right/gripper")
    assert np.allclose(episode.state[:, :2], expected(state[:, [13, 15]]), atol=1e-6)
    assert np.allclose(episode.state[:, 2], 1 - state[:, 19], atol=1e-6)
    assert np.array_equal(episode.action, episode.state)
    assert episode.conventions.get("action") == (None if joints else "repeats the state")


def test_the_range_of_a_described_robot_is_its_limits() -> None:
    features = {"observation.state": {"shape": [6], "names": [f"j{i}" for i in range(6)]}}
    common = {"kind": "lerobot_v21", "path": "x", "views": {}, "angle_unit": "range_m100_100", "embodiment": "so101"}
    arms = right(indices=[0, 1, 2, 3, 4])
    arms[0]["state"]["gripper"] = {"feature": "observation.state", "indices": [5], "closed": 0, "open": 100}
    config = LeRobotSourceConfig.model_validate({**common, "arms": arms})
    limits = np.array(load_embodiment("so101").arms[0].limits)
    for reading, angles in ((-100, limits[:, 0]), (100, limits[:, 1]), (0, limits.mean(axis=1))):
        values = np.full((1, 6), reading, np.float64) * [1, 1, 1, 1, 1, 0]
        state, _, _ = state_columns(config, features, "x").read(lambda _, values=values: values)
        assert np.allclose(state[0, :5], angles, atol=1e-6)
    for changes, message in (
        ({"embodiment": "none", "arms": arms}, "declare ranges"),
        ({"arms": None}, "declare arms"),
        ({"arms": right(zeros=[0])}, "takes ranges"),
        ({"arms": right(ranges=[[0, 0]])}, "must differ"),
        ({"arms": right(ranges=[[0, 1]]), "angle_unit": "deg"}, "angle_unit is deg"),
    ):
        with pytest.raises(ValueError, match=message):
            LeRobotSourceConfig.model_validate({**common, **changes})
    short = LeRobotSourceConfig.model_validate({**common, "arms": right(indices=[0, 1], signs=[1])})
    with pytest.raises(ConfigError, match=r"`signs`|`ranges`"):
        state_columns(short, features, "x")


def right(**joints: Any) -> list[dict[str, Any]]:
    return [{"name": "right", "state": {"joints": {"feature": "observation.state", **joints}}}]


LEFT = {"name": "left", "state": {"joints": {"feature": "observation.state", "indices": [0]}}}
NO_OPENING = {"gripper": {"feature": "action", "closed": 0, "open": 1}}


def commanded(*indices: int) -> dict[str, Any]:
    return {**LEFT, "action": {"joints": {"feature": "action", "indices": list(indices)}}}


@pytest.mark.parametrize(
    ("arms", "message"),
    [
        (right(feature="observation.qpos"), r"(?s)no such feature.*observation\.state, action.*observation\.qpos"),
        (right(columns=["left_arm_joint_9_rad"]), r"(?s)no such column.*left_arm_joint_1_rad"),
        (right(indices=[26]), r"(?s)cannot be chosen.*0\.\.25"),
        (right(indices=[3, 3]), "cannot be chosen"),
        (right(feature="observation.images.cam_high_rgb"), "cannot be chosen"),
        ([*right(indices=[1]), LEFT], r"(?s)another order.*left, right"),
        ([LEFT, LEFT], "another order"),
        ([commanded(0, 1)], "State and action of an arm differ in size"),
        ([commanded(0), *right(indices=[1])], "Either all arms have actions or none"),
        ([{"name": "left", "state": {**LEFT["state"], **NO_OPENING}}], "A gripper is one column"),
    ],
)
def test_columns_that_are_not_there_are_refused(tmp_path: Path, arms: Any, message: str) -> None:
    write_robocoin(tmp_path / "raw")
    with pytest.raises(ConfigError, match=message):
        run(tmp_path, robocoin(tmp_path, arms=arms))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"arms": [], "grippers": {}}, "at least 1 item"),
        ({"grippers": {"gripper": {"closed": 0, "open": 1}}}, "not both"),
        ({"grippers": {"g": {"closed": 1, "open": 1}}, "arms": None}, "two different readings"),
        ({"evaluation_only": True}, "evaluation only: split train"),
        ({"views": {"a": "head", "b": "head"}}, "the same view"),
    ],
)
def test_configurations_that_contradict_themselves_are_refused(changes: Any, message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        CurateConfig.model_validate({"sources": [preset("robocoin", Path("x"), **changes)]})


@pytest.mark.parametrize("split", ["train", "validation"])
def test_droid_is_refused_for_training_whatever_it_is_called(tmp_path: Path, split: str) -> None:
    write_droid(tmp_path / "plain")
    hidden = preset("droid_lerobot", tmp_path / "plain", name="office", evaluation_only=False, embodiment="none")
    with pytest.raises(ConfigError, match=rf"(?s)DROID is for evaluation only.*got: {split}"):
        run(tmp_path, {**hidden, "split": split})
    with pytest.raises(ConfigError, match="evaluation only were assigned to training"):
        run(tmp_path, {**hidden, "split": "test"}, splits={"office*": split})


@pytest.mark.parametrize(
    ("changes", "robot"), [({"name": "my_droid_100"}, "franka"), ({}, "Droid"), ({"embodiment": "droid_franka"}, "x")]
)
def test_droid_is_known_by_name_robot_or_embodiment(tmp_path: Path, changes: dict[str, Any], robot: str) -> None:
    write_robocoin(tmp_path / "raw")
    info = tmp_path / "raw/meta/info.json"
    info.write_text(json.dumps({**json.loads(info.read_text()), "robot_type": robot}))
    with pytest.raises(ConfigError, match="DROID is for evaluation only"):
        run(tmp_path, robocoin(tmp_path, **changes))
    if robot == "x":
        assert run(tmp_path, robocoin(tmp_path, name="android", embodiment="none"))[0]["splits"] == {"train": 1}


def test_an_evaluation_set_stays_out_of_training_when_it_is_curated_again(tmp_path: Path) -> None:
    write_robocoin(tmp_path / "raw")
    run(tmp_path, robocoin(tmp_path, evaluation_only=True, split="ood_test"))
    with pytest.raises(ConfigError, match="evaluation only were assigned to training"):
        run(tmp_path / "second", {"kind": "episode_set", "path": str(tmp_path / "out")}, splits={"*": "train"})


def test_tasks_that_are_no_text_are_named(tmp_path: Path) -> None:
    write_droid(tmp_path / "raw")
    path = tmp_path / "raw/meta/tasks.parquet"
    path.write_bytes(path.read_bytes().replace(b"Close the", b"Cl\xcase the"))
    with pytest.raises(DataError, match="unreadable"):
        run(tmp_path, preset("droid_lerobot", tmp_path / "raw", embodiment="none"))
