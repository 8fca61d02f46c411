"""A calibration file gives cameras to recordings of every kind, those on hands by the joints as the contract has them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from tests.data import test_source_robomind, test_source_unitree_h5
from tests.data.curating import preset, reasons, run
from tests.data.published_lerobot import FRAMES, HEIGHT, WIDTH, picture, wave, write_droid, write_robocoin
from tests.data.test_source_agibot import write_episode
from tests.data.test_source_lerobot_layouts import robocoin
from tools.labelled_clips import view_thumbnails
from worldline_core.calibration.estimate.estimate import estimate_cameras
from worldline_core.calibration.estimate.estimate_config import CAMERAS, EstimateConfig
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.sources.lerobot import LeRobotSourceConfig
from worldline_core.data.sources.open import open_source
from worldline_core.errors import DataError
from worldline_core.filters.filter import inspect
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.filters.signals import measure
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import pose_from_rotation

K = [[60.0, 0.0, 63.5], [0.0, 62.0, 35.5], [0.0, 0.0, 1.0]]
POSE = [[1.0, 0.0, 0.0, 0.1], [0.0, 0.0, 1.0, -0.4], [0.0, -1.0, 0.0, 1.3], [0.0, 0.0, 0.0, 1.0]]
ON_HAND = [[1.0, 0.0, 0.0, 0.06], [0.0, 1.0, 0.0, 0.02], [0.0, 0.0, 1.0, -0.05], [0.0, 0.0, 0.0, 1.0]]
# All pictures are 64 x 48; K belongs to twice that.
SIZE = {"width": 128, "height": 96, "K": [[120.0, 0.0, 63.5], [0.0, 120.0, 47.5], [0.0, 0.0, 1.0]]}
STILL = {**SIZE, "maps": "camera_to_base", "axes": "opencv", "T": POSE}


def robomind(root: Path) -> dict[str, Any]:
    test_source_robomind.write_franka(root / "h5_franka_3rgb")
    source = {"kind": "robomind", "path": str(root / "h5_franka_3rgb"), "layout": "h5_franka_3rgb", "fps": 10}
    views = {"head": "camera_top", "right_wrist": "camera_left"}
    return {**source, "gripper_state": test_source_robomind.GRIPPER, "views": views}


def unitree(write: Callable[..., Path]) -> Callable[[Path], dict[str, Any]]:
    def written(root: Path) -> dict[str, Any]:
        write(root)
        return test_source_unitree_h5.settings(root, channels="standard")

    return written


pytestmark = pytest.mark.usefixtures("reading_in_this_process")  # each reader process would import torch
KINDS = {
    "pixels": robomind,
    "video": unitree(test_source_unitree_h5.write_transitions),
    "HDF5": unitree(test_source_unitree_h5.write_hdf5),
}


@pytest.mark.parametrize("kind", KINDS)
def test_recordings_of_every_kind_take_cameras_from_a_file(tmp_path: Path, kind: str) -> None:
    source = KINDS[kind](tmp_path / "raw")
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps({"views": {"head": STILL, "right_wrist": {**SIZE, "T_tool_camera": ON_HAND}}}))
    _, curated = run(tmp_path, {**source, "calibration": str(file)}, image_size=None)
    episode = curated.episode(0)
    assert np.allclose(episode.cameras["head"].K[0], [60.0, 0.0, 31.5])
    assert np.allclose(episode.cameras["head"].T_base_camera, [POSE])
    kinematics = ArmKinematics(load_embodiment(episode.embodiment))
    arm = [each.camera_view for each in kinematics.embodiment.arms].index("right_wrist")
    tools = kinematics.tool_poses(episode.state.astype(np.float64)).numpy()[:, arm]
    assert np.allclose(episode.cameras["right_wrist"].T_base_camera, tools @ ON_HAND, atol=1e-5)
    assert curated.rows[0].stage2_ok


FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "K of other proportions": ({"head": {**STILL, "width": 96}}, "missing_calibration"),
    "a feature": (
        {"head": {**SIZE, "maps": "camera_to_base", "axes": "opencv", "T_feature": {"name": "a", "format": "matrix"}}},
        "missing_column",
    ),
    "a view of no arm": ({"head": {**SIZE, "mount": "embodiment"}}, "missing_calibration"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_file_that_does_not_belong_to_the_recordings_is_refused(tmp_path: Path, fault: str) -> None:
    views, reason = FAULTS[fault]
    source = robomind(tmp_path / "raw")
    file = Path(source["path"]) / "cameras.json"
    file.write_text(json.dumps({"views": views}))
    healthy = unitree(test_source_unitree_h5.write_hdf5)(tmp_path / "healthy")
    _, curated = run(tmp_path, {**source, "calibration": "cameras.json"}, healthy)
    assert set(reasons(curated).values()) == {reason}


def test_a_recording_may_lack_a_view_of_the_file(tmp_path: Path) -> None:
    source = robomind(tmp_path / "raw")
    views = {"head": STILL, "left_wrist": {**SIZE, "T_tool_camera": ON_HAND}}
    (Path(source["path"]) / "cameras.json").write_text(json.dumps({"views": views}))
    declared = source["views"] | {"left_wrist": "camera_that_is_not_there"}
    changed = {"calibration": "cameras.json", "views": declared}
    _, curated = run(tmp_path, {**source, **changed}, views="available")
    assert set(curated.episode(0).cameras) == {"head"}


@pytest.mark.parametrize("departure", [{"angle_unit": "deg"}, {"arms": "exchanged"}, {"image_lag_frames": 1}])
def test_a_mounted_camera_follows_the_repaired_joints(tmp_path: Path, departure: dict[str, Any]) -> None:
    """Written otherwise than declared, the joints would put it elsewhere."""
    write_robocoin(tmp_path / "raw")
    write_calibration(tmp_path / "raw", {"left_wrist": on_hand(T_tool_camera=ON_HAND)})
    changed = {"calibration": "meta/calibration.json", "embodiment": "ur5e_silver", "conventions": departure}
    config = LeRobotSourceConfig.model_validate(robocoin(tmp_path) | changed)
    source = open_source(config, tmp_path / "raw")
    episode = source.load(source.episode_ids()[0]).episode
    tools = ArmKinematics(load_embodiment("ur5e_silver")).tool_poses(episode.state.astype(np.float64)).numpy()
    assert np.allclose(episode.cameras["left_wrist"].T_base_camera, tools[:, 0] @ ON_HAND, atol=1e-6)


def test_only_unknown_cameras_are_estimated_while_fitting(tmp_path: Path) -> None:
    source = robomind(tmp_path / "raw")
    curate = CurateConfig.model_validate({"sources": [source]})
    assert EstimateConfig.of(curate, {}) is not None  # no file is named
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps({"views": {"head": STILL, "right_wrist": {**SIZE, "T_tool_camera": ON_HAND}}}))
    config = EstimateConfig.model_validate({"source": {**source, "calibration": str(file)}})
    assert estimate_cameras(config, {}, tmp_path / "estimate") == {"views": {}, "reasons": {}}
    assert not (tmp_path / "estimate" / CAMERAS).exists()
    # Recordings that hold their cameras, of a robot whose description is not here.
    for n in range(2):
        write_episode(tmp_path / "agibot", 327, 648642 + n, 20 * n)
    config = EstimateConfig.model_validate({"source": {"kind": "agibot_world", "path": str(tmp_path / "agibot")}})
    assert estimate_cameras(config, {}, tmp_path / "agibot_estimate") == {"views": {}, "reasons": {}}


def calibration(**changes: Any) -> dict[str, Any]:
    return {"width": WIDTH, "height": HEIGHT, "K": K, "maps": "camera_to_base", "axes": "opencv", "T": POSE, **changes}


def on_hand(**mount: Any) -> dict[str, Any]:
    return {"width": WIDTH, "height": HEIGHT, "K": K, **mount}


def write_calibration(root: Path, views: dict[str, Any], name: str = "calibration.json") -> None:
    text = json.dumps({"views": views}) if name.endswith("json") else yaml.safe_dump({"views": views})
    (root / "meta" / name).write_text(text)


@pytest.mark.parametrize("name", ["calibration.json", "calibration.yaml"])
def test_a_calibration_file_beside_the_dataset_is_used(tmp_path: Path, name: str) -> None:
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
    source = robocoin(tmp_path, calibration=f"meta/{name}", embodiment="ur5e_pair")
    _, curated = run(tmp_path, source, require_calibration=True)
    cameras = curated.episode(0).cameras
    # Half the size: u' = (u + 1/2) / 2 - 1/2.
    assert np.allclose(cameras["head"].K, [[60, 0, 63.5], [0, 62, 35.5], [0, 0, 1]])
    assert np.allclose(cameras["head"].T_base_camera, np.asarray(POSE)[None])
    assert np.allclose(cameras["left_wrist"].T_base_camera, moving)
    assert np.allclose(cameras["right_wrist"].T_base_camera, np.asarray(POSE)[None])
    assert curated.rows[0].stage2_ok


@pytest.mark.slow
def test_a_wrist_camera_may_be_where_the_robot_mounts_it(tmp_path: Path) -> None:
    write_robocoin(tmp_path / "raw")
    mounted = on_hand(mount="embodiment")
    views = {"head": calibration(), "left_wrist": mounted, "right_wrist": mounted}
    write_calibration(tmp_path / "raw", views, "calibration.yaml")
    source = robocoin(tmp_path, calibration="meta/calibration.yaml")
    episode = run(tmp_path, source | {"embodiment": "ur5e_silver"})[1].episode(0)
    poses = ArmKinematics(load_embodiment("ur5e_silver")).wrist_camera_poses(episode.state.astype(np.float64))
    for view in ("left_wrist", "right_wrist"):
        assert np.allclose(episode.cameras[view].T_base_camera, poses[view], atol=1e-6)
    with pytest.raises(DataError, match="missing_calibration"):  # it mounts none
        run(tmp_path / "second", source | {"embodiment": "piper_pair"})


@pytest.mark.slow
def test_a_calibrated_mount_takes_the_place_of_the_described_one(tmp_path: Path) -> None:
    write_robocoin(tmp_path / "raw")
    T = pose_from_rotation(np.array([0.06, 0.02, -0.05]), Rotation.from_euler("x", 0.9).as_matrix())
    views = {"head": calibration(), "left_wrist": on_hand(T_tool_camera=T.tolist())}
    write_calibration(tmp_path / "raw", views, "calibration.yaml")
    source = robocoin(tmp_path, calibration="meta/calibration.yaml") | {"embodiment": "ur5e_silver"}
    curated = run(tmp_path, source)[1]
    episode, seen = curated.episode(0), {"head": view_thumbnails(curated.frames(0, "head"), 8.0)}
    tools = ArmKinematics(load_embodiment("ur5e_silver")).tool_poses(episode.state.astype(np.float64)).numpy()
    assert np.allclose(episode.cameras["left_wrist"].T_base_camera, tools[:, 0] @ T, atol=1e-6)

    def hand_eye(recorded: Episode) -> bool:
        (found,) = (f for f in inspect(FilterConfig(), measure(recorded, seen)) if f.detector == "hand_eye")
        return found.verdict.passed

    assert hand_eye(episode)
    assert not hand_eye(replace(episode, conventions={}))  # the description mounts it elsewhere


def lacking(key: str, **changes: Any) -> dict[str, Any]:
    return {name: value for name, value in calibration(**changes).items() if name != key}


FEATURE = {"T_feature": {"name": "action", "format": "matrix"}}
LENS = {"model": "radtan", "coefficients": [0.05, 0.0, 0.0, 0.0]}
ENTRIES: list[tuple[dict[str, Any], str | None]] = [
    ({"head": calibration()}, None),
    ({"head": calibration(distortion=LENS)}, None),
    ({"top": calibration()}, "missing_view"),
    *(({"head": entry}, reason) for entry, reason in (
        (calibration(T=[[1, 0], [0, 1]]), "invalid_extrinsics"),
        (calibration(T=[POSE] * (FRAMES - 1)), "length_mismatch"),
        (calibration(T=(2 * np.asarray(POSE)).tolist()), "invalid_extrinsics"),
        (calibration(T=["far", "away"]), "invalid_extrinsics"),
        (calibration(K=[[0, 0, 0]] * 3), "singular_intrinsics"),
        (calibration(width=WIDTH // 2), "missing_calibration"),
        (lacking("maps"), "missing_column"),
        (calibration(**FEATURE), "missing_column"),
        (lacking("T"), "missing_column"),
        (calibration(units="mm"), "missing_column"),
        (lacking("T", **FEATURE), "length_mismatch"),
        (lacking("T", T_feature={"name": "poses", "format": "matrix"}), "missing_column"),
    )),
]  # fmt: skip


def test_calibration_may_be_a_file_an_episode_and_costs_that_one_alone(tmp_path: Path) -> None:
    write_robocoin(tmp_path / "raw", episodes=len(ENTRIES) + 1)
    for number, (views, _) in enumerate(ENTRIES):
        write_calibration(tmp_path / "raw", views, f"camera_{number:06d}.json")
    _, curated = run(tmp_path, robocoin(tmp_path, calibration="meta/camera_{episode_index:06d}.json"))
    expected = [reason for _, reason in ENTRIES] + ["missing_calibration"]  # the last one has no file
    assert reasons(curated) == {f"robocoin-{n:06d}": reason for n, reason in enumerate(expected) if reason}
    assert ["undistorted" in curated.episode(i).conventions for i in range(len(curated.rows))] == [False, True]
    with pytest.raises(DataError, match="path_traversal"):
        run(tmp_path / "second", robocoin(tmp_path, calibration="../calibration.json"))


DROID_CALIBRATION = {
    view: {
        "width": 1280, "height": 720, "maps": "camera_to_base", "axes": "opencv",
        "K": [[530.0, 0, 639.5], [0, 530.0, 359.5], [0, 0, 1]],
        "T_feature": {"name": f"camera_extrinsics.{name}", "format": "xyz_rpy_fixed"},
    }
    for view, name in (("head", "exterior_1_left"), ("exterior_2", "exterior_2_left"))
}  # fmt: skip


def test_droid_with_a_calibration_file(tmp_path: Path) -> None:
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
