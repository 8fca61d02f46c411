"""Recorded poses at the door: repaired and counted, or in quarantine with the numbers; both sides of the threshold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tools.corrupted.conventions import written_as_moving, written_as_wxyz
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.data.episodes.recorded_poses import camera_pose, with_rigid_poses
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.geometry.transforms import reread_as_moving, reread_as_wxyz, rotation_deviation

Make = Callable[..., tuple]


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


def with_camera(episode: Episode, view: str, poses: np.ndarray) -> Episode:
    return replace(episode, cameras={**episode.cameras, view: replace(episode.cameras[view], T_base_camera=poses)})


def test_both_sides_of_the_threshold_show_in_the_curated_set(tmp_path: Path, sample: Make) -> None:
    samples = []
    for number, deviation in enumerate((0.0, 0.9e-3, 1.1e-3)):
        episode, frames, masks = sample(number)
        wrist = sheared(episode.cameras["left_wrist"].T_base_camera, 4, deviation)
        samples.append((with_camera(episode, "left_wrist", wrist), frames, masks))
    with EpisodeSetWriter(tmp_path / "raw", video_crf=8) as writer:
        for values in samples:
            writer.add(*values)
    source = {"kind": "episode_set", "path": str(tmp_path / "raw")}
    counts = curate(CurateConfig.model_validate({"sources": [source]}), {}, tmp_path / "out")
    assert (counts["kept"], counts["reasons"]) == (2, {"invalid_extrinsics": 1})
    curated = EpisodeSet.open(tmp_path / "out")
    clean, repaired = curated.episode(0), curated.episode(1)
    assert not any(key.startswith("rotations_repaired") for key in clean.conventions)
    assert np.array_equal(clean.cameras["left_wrist"].T_base_camera, samples[0][0].cameras["left_wrist"].T_base_camera)
    assert repaired.conventions["rotations_repaired"] == 1
    assert repaired.conventions["rotations_repaired_of"] == "left_wrist"
    assert repaired.conventions["rotations_repaired_largest_deviation"] == pytest.approx(0.9e-3, rel=1e-2)
    assert rotation_deviation(repaired.cameras["left_wrist"].T_base_camera[:, :3, :3]).max() < 1e-12
    (row,) = curated.quarantine()
    assert row.numbers["view"] == "left_wrist"
    assert row.numbers["frame"] == 4
    assert row.numbers["frames"] == 1
    assert row.numbers["rotation_deviation"] == pytest.approx(1.1e-3, rel=1e-2)
    assert "frame 4" in row.detail


def test_tool_poses_are_held_to_the_same(sample: Make) -> None:
    tools = np.tile(np.eye(4), (9, 2, 1, 1))
    values = {"T_base_ee": sheared(tools, 3, 5e-4), "gripper": np.zeros((9, 2))}
    repaired = with_rigid_poses(sample(0, **values)[0])
    assert repaired.conventions["rotations_repaired"] == 2  # both arms of frame 3
    assert repaired.conventions["rotations_repaired_of"] == "tool poses"
    assert rotation_deviation(repaired.T_base_ee[..., :3, :3]).max() < 1e-12
    values["T_base_ee"] = sheared(tools, 3, 5e-3)
    with pytest.raises(RejectedInputError, match=r"Not a rigid transform[\s\S]*tool poses, frame 3") as caught:
        with_rigid_poses(sample(0, **values)[0])
    assert caught.value.reason == "invalid_tool_pose"
    assert caught.value.evidence["rotation_deviation"] == pytest.approx(5e-3, rel=1e-2)


@pytest.mark.parametrize("track", ["state", "action"])
def test_a_zero_quaternion_in_a_state_of_tool_poses_is_quarantined(track: str, sample: Make) -> None:
    names = tuple(f"{a}/{n}" for a in ("left", "right") for n in ("x", "y", "z", "qx", "qy", "qz", "qw", "gripper"))
    rows = np.tile(np.array([0.1, 0.2, 0.3, 0, 0, 0, 1, 0.5] * 2, np.float32), (9, 1))
    arrays = {"state": rows.copy(), "action": rows.copy()}
    given = {"state_names": names, "state_kind": "ee_pose"}
    whole = sample(0, **arrays, **given)[0]
    assert with_rigid_poses(whole) is whole
    arrays[track][5, 11:15] = 0
    with pytest.raises(RejectedInputError, match=rf"no direction[\s\S]*{track} right/qx, entry 5") as caught:
        with_rigid_poses(sample(0, **arrays, **given)[0])
    assert caught.value.reason == "nan_state"
    assert caught.value.evidence["columns"] == ["right/qx", "right/qy", "right/qz", "right/qw"]


def test_a_source_may_name_the_other_conventions() -> None:
    T_base_camera = np.tile(np.eye(4), (3, 1, 1))
    T_base_camera[:, :3, :3] = Rotation.random(3, random_state=0).as_matrix()
    T_base_camera[:, :3, 3] = [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    inverse = np.linalg.inv(T_base_camera @ np.diag([1.0, -1, -1, 1]))
    pose = camera_pose("head", inverse, extrinsics="base_to_camera", axes="opengl", where="episode 1")
    np.testing.assert_allclose(pose.T_base_camera, T_base_camera, atol=1e-12)
    inverse[1, :3, :3] *= 2
    with pytest.raises(RejectedInputError, match=r"episode 1, view head, frame 1") as caught:
        camera_pose("head", inverse, extrinsics="base_to_camera", axes="opengl", where="episode 1")
    assert caught.value.reason == "invalid_extrinsics"
    assert caught.value.evidence["view"] == "head"
