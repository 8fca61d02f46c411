"""A calibration file gives cameras to recordings of every kind, those on hands by the joints as the contract has them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.data import published_robomind, test_source_unitree_h5
from tests.data.curating import reasons, run
from tests.data.published_lerobot import HEIGHT, WIDTH, write_robocoin
from tests.data.test_source_agibot import write_episode
from tests.data.test_source_lerobot_layouts import robocoin, write_calibration
from worldline_core.calibration.estimate.estimate import estimate_cameras
from worldline_core.calibration.estimate.estimate_config import CAMERAS, EstimateConfig
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.sources.lerobot import LeRobotSourceConfig
from worldline_core.data.sources.open import open_source
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics

T = [[1.0, 0.0, 0.0, 0.1], [0.0, 0.0, 1.0, -0.4], [0.0, -1.0, 0.0, 1.3], [0.0, 0.0, 0.0, 1.0]]
ON_HAND = [[1.0, 0.0, 0.0, 0.06], [0.0, 1.0, 0.0, 0.02], [0.0, 0.0, 1.0, -0.05], [0.0, 0.0, 0.0, 1.0]]
# All pictures are 64 x 48; K belongs to twice that.
SIZE = {"width": 128, "height": 96, "K": [[120.0, 0.0, 63.5], [0.0, 120.0, 47.5], [0.0, 0.0, 1.0]]}
STILL = {**SIZE, "maps": "camera_to_base", "axes": "opencv", "T": T}


def robomind(root: Path) -> dict[str, Any]:
    published_robomind.write_franka(root / "h5_franka_3rgb")
    source = {"kind": "robomind", "path": str(root / "h5_franka_3rgb"), "layout": "h5_franka_3rgb", "fps": 10}
    views = {"head": "camera_top", "right_wrist": "camera_left"}
    return {**source, "gripper_state": published_robomind.GRIPPER, "views": views}


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
    assert np.allclose(episode.cameras["head"].T_base_camera, [T])
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
    entry = {"width": WIDTH, "height": HEIGHT, "K": [[60, 0, 63.5], [0, 62, 35.5], [0, 0, 1]], "T_tool_camera": ON_HAND}
    write_calibration(tmp_path / "raw", {"left_wrist": entry})
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
