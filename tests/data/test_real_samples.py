"""The real samples of several laboratories, where they are at hand."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.data import curating
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.geometry.transforms import pose_from_euler_fixed_xyz


def run(
    tmp_path: Path, *, image_size: Any = (48, 64), trim: Any = None, **source: Any
) -> tuple[dict[str, Any], EpisodeSet]:
    return curating.run(tmp_path, source, image_size=image_size, trim=trim)


def test_agibot_v1(tmp_path: Path, shared_data: Path) -> None:
    counts, curated = run(tmp_path, kind="agibot_gesim", path=str(shared_data / "agibot_gesim"), fps=30)
    assert (counts["found"], counts["kept"]) == (2, 2)
    for i, row in enumerate(curated.rows):
        episode = curated.episode(i)
        assert (row.num_frames, row.video_frames) == (300, 4)
        assert curated.frames(i, "left_wrist").shape == (4, 48, 64, 3)
        raw = np.load(next((shared_data / "agibot_gesim").glob(f"{row.scene.rsplit('-', 1)[1]}/actions.npy")))
        distance = np.linalg.norm(episode.T_base_ee[:, 0, :3, 3] - raw[:, :3], axis=1)
        assert np.allclose(distance, 0.23, atol=1e-6)
        # A wrist camera is fixed to its arm: millimetres, as its README measured.
        mount = np.linalg.inv(episode.T_base_ee[:, 1]) @ episode.cameras["right_wrist"].T_base_camera
        assert mount[:, :3, 3].std(axis=0).max() < 0.02
    closed = curated.episode(0).state[:, 15]
    assert closed.max() < 0.1  # about 117 of 120: closed
    assert curated.episode(0).state[:, 7].min() > 0.9  # about 35: open


def test_agibot_v1_as_a_clip_of_enerverse_ac(tmp_path: Path, shared_data: Path) -> None:
    """Put together as EnerVerse-AC's own script does it: the same poses, openings, camera and first picture."""
    recorded, clip = shared_data / "agibot_gesim/sample_0", tmp_path / "clips/sample_0"
    clip.mkdir(parents=True)
    for name, values in (("action", "actions"), ("intrinsics", "intrinsic_head")):
        shutil.copy(recorded / f"{values}.npy", clip / f"{name}.npy")
    np.save(clip / "extrinsics.npy", np.load(recorded / "extrinsic_head.npy")[0])
    shutil.copy(recorded / "head_color/0.png", clip / "frame.png")
    _, clips = run(tmp_path / "a", kind="enerverse_ac", path=str(tmp_path / "clips"), fps=30)
    _, whole = run(tmp_path / "b", kind="agibot_gesim", path=str(shared_data / "agibot_gesim"), fps=30)
    (found,), (position,) = (
        [i for i, row in enumerate(each.rows) if row.episode_id.endswith("sample_0")] for each in (clips, whole)
    )
    episode, expected = clips.episode(found), whole.episode(position)
    assert np.array_equal(episode.state, expected.state)
    assert np.array_equal(episode.T_base_ee, expected.T_base_ee)  # type: ignore[arg-type]
    assert np.array_equal(episode.cameras["head"].K, expected.cameras["head"].K)
    assert np.allclose(episode.cameras["head"].T_base_camera[0], expected.cameras["head"].T_base_camera[0], atol=1e-9)
    difference = clips.frames(found, "head")[0].astype(int) - whole.frames(position, "head")[0]
    assert np.abs(difference).mean() < 5  # each set encodes its own video


def test_agibot_v2(tmp_path: Path, shared_data: Path) -> None:
    counts, curated = run(tmp_path, kind="agibot_gesim", path=str(shared_data / "agibot_gesim_v2"), fps=30)
    assert (counts["found"], counts["kept"]) == (2, 2)
    assert [row.video_frames for row in curated.rows] == [1, 1]
    assert [row.num_frames for row in curated.rows] == [456, 299]
    episode = curated.episode(0)
    assert episode.state.shape == (456, 16)
    assert np.abs(episode.state - episode.action)[:, :7].max() < 0.2  # the command is tracked
    assert 0 <= episode.state[:, [7, 15]].min() < 0.05 < 0.99 < episode.state[0, 15] <= 1
    head = episode.cameras["head"]
    assert (head.width, head.height) == (64, 48)
    in_camera = np.linalg.inv(head.T_base_camera[0]) @ np.append(episode.T_base_ee[0, 0, :3, 3], 1)  # type: ignore[index]
    u, v = (head.K @ (in_camera[:3] / in_camera[2]))[:2]
    assert in_camera[2] > 0 and 0 < u < 64 and 0 < v < 48


@pytest.mark.slow
def test_droid(tmp_path: Path, shared_data: Path) -> None:
    folder = shared_data / "droid_ctrl_world" / "droid_new_setup"
    counts, curated = run(tmp_path, kind="droid_annotation", path=str(folder), name="droid")
    assert (counts["found"], counts["reasons"]) == (6, {"length_mismatch": 2})
    assert {row.episode_id: row.numbers for row in curated.quarantine()} == {
        "droid-val-0003": {"frames": 206, "states": 205},
        "droid-val-0006": {"frames": 42, "states": 41},
    }
    assert {row.stage2_reason for row in curated.rows} == {"missing_calibration"}
    assert all(row.stage1_ok and row.fps == 4.0 for row in curated.rows)
    uneven = {"kind": "droid_annotation", "name": "droid", "include": ["droid-val-0003", "droid-val-0006"]}
    counts, trimmed = run(tmp_path / "trimmed", trim="common", path=str(folder), **uneven)
    assert (counts["kept"], counts["trimmed"]) == (2, 2)
    assert [trimmed.rows[trimmed.position(f"droid-val-{n}")].num_frames for n in ("0003", "0006")] == [205, 41]


@pytest.mark.slow
def test_droid_subset_with_its_kinematics(tmp_path: Path, shared_data: Path) -> None:
    """The other nine episodes all come through, and their joints and poses agree."""
    from worldline_core.geometry.embodiment import load_embodiment
    from worldline_core.geometry.kinematics import ArmKinematics

    folder = shared_data / "droid_ctrl_world" / "droid_subset"
    counts, curated = run(tmp_path, kind="droid_annotation", path=str(folder))
    assert (counts["found"], counts["kept"], counts["reasons"]) == (9, 9, {})
    assert {row.fps for row in curated.rows} == {5.0}
    kinematics = ArmKinematics(load_embodiment("droid_franka"))
    for i, row in enumerate(curated.rows):
        episode = curated.episode(i)
        assert set(row.views) == {"head", "exterior_2", "right_wrist"}
        tools = np.asarray(kinematics.tool_poses(episode.state.astype(np.float64)))
        assert np.abs(tools[..., :3, 3] - episode.T_base_ee[..., :3, 3]).max() < 2e-3, row.episode_id
        assert np.abs(tools[..., :3, 2] - episode.T_base_ee[..., :3, 2]).max() < 1e-2, row.episode_id


@pytest.mark.slow
def test_unitree_with_its_arms_named(tmp_path: Path, shared_data: Path) -> None:
    root = shared_data / "lerobot_unitree_g1"
    order = ("ShoulderPitch", "ShoulderRoll", "ShoulderYaw", "Elbow", "WristRoll", "WristPitch", "WristYaw")
    arms = [
        {"name": side} | {
            track: {"joints": {"feature": feature, "columns": [f"k{side.title()}{joint}" for joint in order]}}
            for track, feature in (("state", "observation.state"), ("action", "action"))
        }
        for side in ("left", "right")
    ]  # fmt: skip
    counts, curated = run(
        tmp_path, kind="lerobot_v21", path=str(root), name="unitree", embodiment="none", angle_unit="rad",
        views={"observation.images.cam_high": "head"}, arms=arms,
    )  # fmt: skip
    assert (counts["found"], counts["kept"], counts["reasons"]) == (100, 2, {"missing_file": 98})
    assert [(row.num_frames, row.stage2_reason) for row in curated.rows] == [
        (221, "missing_calibration"), (277, "missing_calibration"),
    ]  # fmt: skip
    first = curated.episode(0)
    table = pq.read_table(root / "data/chunk-000/episode_000029.parquet", columns=["observation.state", "action"])
    raw = np.asarray(table["observation.state"].to_pylist())
    assert curated.rows[0].episode_id == "unitree-000029"
    assert np.allclose(first.state, raw[:, :14], atol=1e-6)
    assert curated.rows[0].instruction == "pick up the yellow bottle on the table"
    # The commands lead the joints they are given to.
    assert np.abs(first.action - first.state).mean() < np.abs(first.action - first.state[::-1]).mean()


def test_droid_with_the_self_calibration(tmp_path: Path, shared_data: Path) -> None:
    """The sample's own calibration as a calibration file: fingertips land in both pictures."""
    folder = shared_data / "droid_ctrl_world"
    recorded = json.loads((folder / "selfcal_droid_new_setup_0003.json").read_text())
    width, height = recorded["image_size"]
    record = json.loads((folder / "droid_new_setup/annotation/val/0003.json").read_text())
    states = np.asarray(record["states"])
    tips = pose_from_euler_fixed_xyz(states[:, :3], states[:, 3:6]) @ np.array([0, 0, 0.155, 1.0])
    views = {}
    for number, view in enumerate(("head", "exterior_2")):
        camera = recorded[f"camera_{number}"]
        size = {"width": width, "height": height, "maps": "camera_to_base", "axes": "opencv"}
        views[view] = {**size, "K": camera["K"], "T": camera["c2w_opencv"]}
    (tmp_path / "cameras.json").write_text(json.dumps({"views": views}))
    _, curated = run(
        tmp_path, kind="droid_annotation", path=str(folder), calibration=str(tmp_path / "cameras.json"),
        include=["*new_setup*0003"], image_size=(height // 2, width // 2), trim="common",
    )  # fmt: skip
    (row,), cameras = curated.rows, curated.episode(0).cameras
    assert row.stage2_ok and set(cameras) == set(views)
    tips = tips[: row.num_frames]
    for found in cameras.values():
        seen = tips @ np.linalg.inv(found.T_base_camera[0]).T
        pixels = (seen[:, :3] / seen[:, 2:3] @ found.K.T)[:, :2]
        inside = (seen[:, 2] > 0) & (pixels >= 0).all(axis=1) & (pixels < [width // 2, height // 2]).all(axis=1)
        assert inside.mean() > 0.9
