"""Galaxea, RoboCOIN and DROID through the shipped configurations; calibration files; DROID never trains."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from published_lerobot import (
    FRAMES,
    HEIGHT,
    WIDTH,
    picture,
    wave,
    write_droid,
    write_galaxea,
    write_robocoin,
)
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.sources.lerobot import LeRobotSourceConfig, state_columns
from worldline_core.errors import ConfigError, DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics

K = [[60.0, 0.0, 63.5], [0.0, 62.0, 35.5], [0.0, 0.0, 1.0]]
POSE = [[1.0, 0.0, 0.0, 0.1], [0.0, 0.0, 1.0, -0.4], [0.0, -1.0, 0.0, 1.3], [0.0, 0.0, 0.0, 1.0]]


@pytest.fixture
def preset(project_root: Path) -> Any:
    """The source of a shipped configuration, pointed at a folder."""

    def make(preset: str, path: Path, **changes: Any) -> dict[str, Any]:
        content = yaml.safe_load((project_root / "configs/sources" / f"{preset}.yaml").read_text())
        return {**content["curate"]["sources"][0], "path": str(path), "name": preset, **changes}

    return make


def run(tmp_path: Path, *sources: dict[str, Any], **changes: Any) -> tuple[dict[str, Any], EpisodeSet]:
    config = CurateConfig.model_validate({"sources": sources, **changes})
    counts = curate(config, {}, tmp_path / "out")
    assert counts["kept"] + counts["quarantined"] == counts["found"]
    return counts, EpisodeSet.open(tmp_path / "out")


def test_galaxea(tmp_path: Path, preset: Any) -> None:
    columns = write_galaxea(tmp_path / "raw/Clean_The_Mirror/Clean_The_Mirror")
    shutil.copytree(tmp_path / "raw/Clean_The_Mirror", tmp_path / "raw/Other")
    (tmp_path / "raw/Other/Clean_The_Mirror/meta/info.json").write_text("{")
    counts, curated = run(tmp_path, preset("galaxea", tmp_path / "raw"))
    assert (counts["found"], counts["kept"], counts["reasons"]) == (2, 1, {"unreadable": 1})
    assert curated.quarantine()[0].episode_id == "galaxea-Other-Clean_The_Mirror"
    row, episode = curated.rows[0], curated.episode(0)
    assert row.episode_id == "galaxea-Clean_The_Mirror-Clean_The_Mirror-000000"
    assert (row.scene, row.instruction) == ("galaxea-Clean_The_Mirror-Clean_The_Mirror", "clean the mirror")
    assert (row.fps, row.views, row.stage2_reason) == (
        15.0,
        ("head", "left_wrist", "right_wrist"),
        "missing_calibration",
    )
    assert episode.state_names == tuple(
        f"{a}/{n}" for a in ("left", "right") for n in (*(f"joint_{i}" for i in range(1, 7)), "gripper")
    )
    for start, arm in ((0, "left"), (7, "right")):
        assert np.allclose(episode.state[:, start : start + 6], columns[f"observation.state.{arm}_arm"], atol=1e-6)
        assert np.allclose(episode.action[:, start : start + 6], columns[f"action.{arm}_arm"], atol=1e-6)
        assert np.allclose(episode.state[:, start + 6], np.clip(np.linspace(1, -0.03, FRAMES), 0, 1), atol=1e-6)
        assert np.allclose(episode.action[:, start + 6], np.linspace(0.9, 0.1, FRAMES), atol=1e-6)
    assert episode.conventions["gripper_overshoot"] == 2
    # head_rgb is the first video, left_wrist_rgb the third, right_wrist_rgb the fourth.
    for seed, view in ((0, "head"), (2, "left_wrist"), (3, "right_wrist")):
        assert np.abs(curated.frames(0, view, [7])[0].astype(int) - picture(seed, 7)).mean() < 6


def test_robocoin(tmp_path: Path, preset: Any) -> None:
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


def test_columns_may_be_chosen_by_place_and_an_action_may_be_missing(tmp_path: Path, preset: Any) -> None:
    state = write_robocoin(tmp_path / "raw")
    arm = {
        "name": "right",
        "state": {
            "joints": {"feature": "observation.state", "indices": [13, 15]},
            "gripper": {"feature": "observation.state", "indices": [19], "closed": 1, "open": 0},
        },
    }
    _, curated = run(tmp_path, preset("robocoin", tmp_path / "raw", collection=False, arms=[arm], angle_unit="deg"))
    episode = curated.episode(0)
    assert episode.state_names == ("right/joint_1", "right/joint_2", "right/gripper")
    assert np.allclose(episode.state[:, :2], np.deg2rad(state[:, [13, 15]]), atol=1e-6)
    assert np.allclose(episode.state[:, 2], 1 - state[:, 19], atol=1e-6)
    assert np.array_equal(episode.state, episode.action)
    assert episode.conventions["action"] == "repeats the state"


LIMITS = [[-2.0, 2.0], [-1.0, 3.0]]


@pytest.mark.parametrize(
    ("unit", "joints", "expected"),
    [
        ("deg", {}, lambda v: np.deg2rad(v)),
        ("deg", {"signs": [-1, 1], "zeros": [90, 0]}, lambda v: np.deg2rad(v) * [-1, 1] + [np.pi / 2, 0]),
        ("rad", {"signs": [1, -1]}, lambda v: v * [1, -1]),
        ("range_m100_100", {"ranges": LIMITS}, lambda v: v / 100 * 2 + [0, 1]),
        ("range_m100_100", {"ranges": LIMITS, "signs": [1, -1]}, lambda v: v / 100 * [2, -2] + [0, 1]),
        ("range_m100_100", {"ranges": [[2.0, -2.0], [-1.0, 3.0]]}, lambda v: v / 100 * [-2, 2] + [0, 1]),
    ],
)
def test_joints_in_lerobots_own_units(
    tmp_path: Path, preset: Any, unit: str, joints: dict[str, Any], expected: Any
) -> None:
    state = write_robocoin(tmp_path / "raw")
    gripper = {"feature": "observation.state", "indices": [19], "closed": 0, "open": 1}
    track = {"joints": {"feature": "observation.state", "indices": [13, 15], **joints}, "gripper": gripper}
    arms = [{"name": "right", "state": track, "action": track}]
    _, curated = run(tmp_path, preset("robocoin", tmp_path / "raw", collection=False, arms=arms, angle_unit=unit))
    found = curated.episode(0)
    assert np.allclose(found.state[:, :2], expected(state[:, [13, 15]]), atol=1e-6)
    assert np.array_equal(found.action, found.state)


def test_the_range_of_a_described_robot_is_its_limits() -> None:
    features = {"observation.state": {"shape": [6], "names": [f"j{i}" for i in range(6)]}}
    joints = {"feature": "observation.state", "indices": [0, 1, 2, 3, 4]}
    gripper = {"feature": "observation.state", "indices": [5], "closed": 0, "open": 100}
    common = {"kind": "lerobot_v21", "path": "x", "views": {}, "angle_unit": "range_m100_100"}
    arms = [{"name": "right", "state": {"joints": joints, "gripper": gripper}}]
    config = LeRobotSourceConfig.model_validate({**common, "embodiment": "so101", "arms": arms})
    limits = np.array(load_embodiment("so101").arms[0].limits)
    for reading, angles in ((-100, limits[:, 0]), (100, limits[:, 1]), (0, limits.mean(axis=1))):
        values = np.full((1, 6), reading, np.float64) * [1, 1, 1, 1, 1, 0]
        state, _, _ = state_columns(config, features, "x").read(lambda _, values=values: values)
        assert np.allclose(state[0, :5], angles, atol=1e-6)
    for changes, message in (
        ({"embodiment": "none", "arms": arms}, "declare ranges"),
        ({"embodiment": "so101", "arms": None}, "declare arms"),
        ({"embodiment": "so101", "arms": right(zeros=[0])}, "takes ranges"),
        ({"embodiment": "so101", "arms": right(ranges=[[0, 0]])}, "must differ"),
        ({"embodiment": "so101", "arms": right(ranges=[[0, 1]]), "angle_unit": "deg"}, "angle_unit is deg"),
    ):
        with pytest.raises(ValueError, match=message):
            LeRobotSourceConfig.model_validate({**common, **changes})
    short = LeRobotSourceConfig.model_validate(
        {**common, "embodiment": "so101", "arms": right(indices=[0, 1], signs=[1])}
    )
    with pytest.raises(ConfigError, match=r"(?s)One of `signs`|One of `ranges`"):
        state_columns(short, features, "x")


def right(**joints: Any) -> list[dict[str, Any]]:
    return [{"name": "right", "state": {"joints": {"feature": "observation.state", **joints}}}]


LEFT = {"name": "left", "state": {"joints": {"feature": "observation.state", "indices": [0]}}}


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
        (
            [{**LEFT, "action": {"joints": {"feature": "action", "indices": [0, 1]}}}],
            "State and action of an arm differ in size",
        ),
        (
            [{**LEFT, "action": {"joints": {"feature": "action", "indices": [0]}}}, *right(indices=[1])],
            "Either all arms have actions or none",
        ),
        (
            [{"name": "left", "state": {**LEFT["state"], "gripper": {"feature": "action", "closed": 0, "open": 1}}}],
            "A gripper is one column",
        ),
    ],
)
def test_columns_that_are_not_there_are_refused(tmp_path: Path, preset: Any, arms: Any, message: str) -> None:
    write_robocoin(tmp_path / "raw")
    source = preset("robocoin", tmp_path / "raw", collection=False, arms=arms)
    with pytest.raises(ConfigError, match=message):
        run(tmp_path, source)


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
def test_configurations_that_contradict_themselves_are_refused(preset: Any, changes: Any, message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        CurateConfig.model_validate({"sources": [preset("robocoin", Path("x"), **changes)]})


def calibration(**changes: Any) -> dict[str, Any]:
    return {"width": WIDTH, "height": HEIGHT, "K": K, "maps": "camera_to_base", "axes": "opencv", "T": POSE, **changes}


def write_calibration(root: Path, views: dict[str, Any], name: str = "calibration.json") -> None:
    text = json.dumps({"views": views}) if name.endswith("json") else yaml.safe_dump({"views": views})
    (root / "meta" / name).write_text(text)


@pytest.mark.parametrize("name", ["calibration.json", "calibration.yaml"])
def test_a_calibration_file_beside_the_dataset_is_used(tmp_path: Path, preset: Any, name: str) -> None:
    write_robocoin(tmp_path / "raw")
    moving = np.tile(np.asarray(POSE), (FRAMES, 1, 1))
    moving[:, 0, 3] = 0.01 * np.arange(FRAMES)
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    views = {
        "head": calibration(width=2 * WIDTH, height=2 * HEIGHT, K=[[120, 0, 127.5], [0, 124, 71.5], [0, 0, 1]]),
        "left_wrist": calibration(T=(moving @ flip).tolist(), axes="opengl"),
        "right_wrist": calibration(T=np.linalg.inv(np.asarray(POSE)).tolist(), maps="base_to_camera"),
    }
    write_calibration(tmp_path / "raw", views, name)
    source = preset("robocoin", tmp_path / "raw", collection=False, calibration=f"meta/{name}", embodiment="ur5e_pair")
    counts, curated = run(tmp_path, source, require_calibration=True)
    assert counts["kept"] == 1
    cameras = curated.episode(0).cameras
    # Half the size: u' = (u + 1/2) / 2 - 1/2.
    assert np.allclose(cameras["head"].K, [[60, 0, 63.5], [0, 62, 35.5], [0, 0, 1]])
    assert np.allclose(cameras["head"].T_base_camera, np.asarray(POSE)[None])
    assert np.allclose(cameras["left_wrist"].T_base_camera, moving)
    assert np.allclose(cameras["right_wrist"].T_base_camera, np.asarray(POSE)[None])
    assert curated.rows[0].stage2_ok


@pytest.mark.parametrize(("robot", "reason"), [("ur5e_silver", None), ("piper_pair", "missing_calibration")])
def test_a_wrist_camera_may_be_where_the_robot_mounts_it(
    tmp_path: Path, preset: Any, robot: str, reason: str | None
) -> None:
    write_robocoin(tmp_path / "raw")
    mounted = {key: value for key, value in calibration().items() if key not in ("T", "maps", "axes")}
    mounted["mount"] = "embodiment"
    views = {"head": calibration(), "left_wrist": mounted, "right_wrist": mounted}
    write_calibration(tmp_path / "raw", views, "calibration.yaml")
    source = preset(
        "robocoin", tmp_path / "raw", collection=False, calibration="meta/calibration.yaml", embodiment=robot
    )
    if reason is not None:
        with pytest.raises(DataError, match=reason):
            run(tmp_path, source)
        return
    episode = run(tmp_path, source)[1].episode(0)
    poses = ArmKinematics(load_embodiment(robot)).wrist_camera_poses(episode.state.astype(np.float64))
    for view in ("left_wrist", "right_wrist"):
        assert np.allclose(episode.cameras[view].T_base_camera, poses[view], atol=1e-6)


def test_calibration_may_be_a_file_an_episode_and_name_a_lens(tmp_path: Path, preset: Any) -> None:
    write_robocoin(tmp_path / "raw", episodes=3)
    lens = {"model": "radtan", "coefficients": [0.05, 0.0, 0.0, 0.0]}
    entries = {
        view: calibration(K=[[80.0, 0, 63.5], [0, 80, 35.5], [0, 0, 1]])
        for view in ("head", "left_wrist", "right_wrist")
    }
    write_calibration(tmp_path / "raw", entries, "camera_000000.json")
    write_calibration(
        tmp_path / "raw", {**entries, "head": {**entries["head"], "distortion": lens}}, "camera_000001.json"
    )
    source = preset("robocoin", tmp_path / "raw", collection=False, calibration="meta/camera_{episode_index:06d}.json")
    counts, curated = run(tmp_path, source)
    assert counts["reasons"] == {"missing_calibration": 1}
    assert [row.episode_id for row in curated.rows] == ["robocoin-000000", "robocoin-000001"]
    noted = [curated.episode(i).conventions.get("undistorted") for i in range(2)]
    assert noted[0] is None
    assert "radtan" in str(noted[1])


@pytest.mark.parametrize(
    ("entry", "reason"),
    [
        (calibration(T=[[1, 0], [0, 1]]), "invalid_extrinsics"),
        (calibration(T=[POSE] * (FRAMES - 1)), "length_mismatch"),
        (calibration(T=(2 * np.asarray(POSE)).tolist()), "invalid_extrinsics"),
        (calibration(T=["far", "away"]), "invalid_extrinsics"),
        (calibration(K=[[0, 0, 0]] * 3), "singular_intrinsics"),
        (calibration(width=WIDTH // 2), "missing_calibration"),
        ({k: v for k, v in calibration().items() if k != "maps"}, "missing_column"),
        (calibration(T_feature={"name": "action", "format": "matrix"}), "missing_column"),
        ({k: v for k, v in calibration().items() if k != "T"}, "missing_column"),
        (calibration(units="mm"), "missing_column"),
        (
            {k: v for k, v in calibration(T_feature={"name": "action", "format": "matrix"}).items() if k != "T"},
            "length_mismatch",
        ),
        (
            {k: v for k, v in calibration(T_feature={"name": "poses", "format": "matrix"}).items() if k != "T"},
            "missing_column",
        ),
    ],
)
def test_calibration_that_cannot_be_meant_is_quarantined(
    tmp_path: Path, preset: Any, entry: dict[str, Any], reason: str
) -> None:
    write_robocoin(tmp_path / "raw", episodes=2)
    good = calibration()
    write_calibration(tmp_path / "raw", {"head": entry}, "camera_000000.json")
    write_calibration(tmp_path / "raw", {"head": good}, "camera_000001.json")
    source = preset("robocoin", tmp_path / "raw", collection=False, calibration="meta/camera_{episode_index:06d}.json")
    counts, curated = run(tmp_path, source)
    assert (counts["kept"], counts["reasons"]) == (1, {reason: 1})
    assert curated.quarantine()[0].episode_id == "robocoin-000000"


def test_calibration_of_a_view_that_is_not_read_and_paths_out_of_the_folder(tmp_path: Path, preset: Any) -> None:
    write_robocoin(tmp_path / "raw", episodes=2)
    write_calibration(tmp_path / "raw", {"top": calibration()}, "camera_000000.json")
    write_calibration(tmp_path / "raw", {"head": calibration()}, "camera_000001.json")
    name = "meta/camera_{episode_index:06d}.json"
    counts, _ = run(tmp_path, preset("robocoin", tmp_path / "raw", collection=False, calibration=name))
    assert counts["reasons"] == {"missing_view": 1}
    outside = preset("robocoin", tmp_path / "raw", collection=False, calibration="../calibration.json")
    with pytest.raises(DataError, match=r"(?s)No episode was kept.*path_traversal"):
        curate(CurateConfig.model_validate({"sources": [outside]}), {}, tmp_path / "second")


DROID_CALIBRATION = {
    view: {
        "width": 1280, "height": 720, "maps": "camera_to_base", "axes": "opencv",
        "K": [[530.0, 0, 639.5], [0, 530.0, 359.5], [0, 0, 1]],
        "T_feature": {"name": f"camera_extrinsics.{name}", "format": "xyz_rpy_fixed"},
    }
    for view, name in (("head", "exterior_1_left"), ("exterior_2", "exterior_2_left"))
}  # fmt: skip


def test_droid_with_a_calibration_file(tmp_path: Path, preset: Any) -> None:
    written = write_droid(tmp_path / "raw")
    write_calibration(tmp_path / "raw", DROID_CALIBRATION, "calibration.yaml")
    source = preset("droid_lerobot", tmp_path / "raw", calibration="meta/calibration.yaml", embodiment="none")
    counts, curated = run(tmp_path, source)
    assert (counts["found"], counts["kept"], counts["splits"]) == (2, 2, {"test": 2})
    first, second = curated.episode(0), curated.episode(1)
    assert [row.outcome for row in curated.rows] == ["success", "failure"]
    assert [row.instruction for row in curated.rows] == ["put the pen in the cup", "close the drawer"]
    assert np.allclose(first.state[:, :7], wave(8)[:, :7], atol=1e-6)
    assert np.allclose(first.state[:, 7], np.linspace(1, 0, FRAMES), atol=1e-6)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", written["exterior_1_left"][0, 3:]).as_matrix()
    pose[:3, 3] = written["exterior_1_left"][0, :3]
    assert np.allclose(first.cameras["head"].T_base_camera, pose[None], atol=1e-6)
    assert np.allclose(first.cameras["head"].K[0], [53.0, 0, 63.5])
    assert set(first.cameras) == {"head", "exterior_2"}
    assert set(second.cameras) == {"head"}  # zeros are no calibration
    for position, seed in ((0, 1), (1, 2)):
        assert np.abs(curated.frames(position, "head", [5])[0].astype(int) - picture(seed, 5)).mean() < 6


@pytest.mark.parametrize("split", ["train", "validation"])
def test_droid_is_refused_for_training_whatever_it_is_called(tmp_path: Path, preset: Any, split: str) -> None:
    write_droid(tmp_path / "plain")
    hidden = preset(
        "droid_lerobot",
        tmp_path / "plain",
        name="office",
        split=split,
        evaluation_only=False,
        embodiment="none",
    )
    with pytest.raises(ConfigError, match=rf"(?s)DROID is for evaluation only.*got: {split}"):
        run(tmp_path, hidden)
    # Not by the way of a pattern either.
    with pytest.raises(ConfigError, match="evaluation only were assigned to training"):
        run(tmp_path, {**hidden, "split": "test"}, splits={"office*": split})


@pytest.mark.parametrize(
    ("changes", "robot"), [({"name": "my_droid_100"}, "franka"), ({}, "Droid"), ({"embodiment": "droid_franka"}, "x")]
)
def test_droid_is_known_by_its_name_its_robot_or_its_embodiment(
    tmp_path: Path, preset: Any, changes: dict[str, Any], robot: str
) -> None:
    write_robocoin(tmp_path / "raw")
    info = tmp_path / "raw/meta/info.json"
    info.write_text(json.dumps({**json.loads(info.read_text()), "robot_type": robot}))
    source = preset("robocoin", tmp_path / "raw", collection=False, **changes)
    with pytest.raises(ConfigError, match="DROID is for evaluation only"):
        run(tmp_path, source)
    android = preset("robocoin", tmp_path / "raw", collection=False, name="android", embodiment="none")
    if robot == "x":
        assert run(tmp_path, android)[0]["splits"] == {"train": 1}


def test_an_evaluation_set_stays_out_of_training_when_it_is_curated_again(tmp_path: Path, preset: Any) -> None:
    write_robocoin(tmp_path / "raw")
    source = preset("robocoin", tmp_path / "raw", collection=False, evaluation_only=True, split="ood_test")
    run(tmp_path, source)
    again = CurateConfig.model_validate(
        {"sources": [{"kind": "episode_set", "path": str(tmp_path / "out")}], "splits": {"*": "train"}}
    )
    with pytest.raises(ConfigError, match="evaluation only were assigned to training"):
        curate(again, {}, tmp_path / "second")


def test_a_folder_without_datasets_is_named(tmp_path: Path, preset: Any) -> None:
    (tmp_path / "raw").mkdir()
    with pytest.raises(DataError, match=r"(?s)holds no episode.*meta/info\.json"):
        run(tmp_path, preset("robocoin", tmp_path / "raw"))


def test_tasks_that_are_no_text_are_named(tmp_path: Path, preset: Any) -> None:
    write_droid(tmp_path / "raw")
    path = tmp_path / "raw/meta/tasks.parquet"
    path.write_bytes(path.read_bytes().replace(b"Close the", b"Cl\xcase the"))
    with pytest.raises(DataError, match=r"(?s)No episode was kept.*unreadable"):
        run(tmp_path, preset("droid_lerobot", tmp_path / "raw", embodiment="none"))
