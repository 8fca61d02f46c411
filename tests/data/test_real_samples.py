"""The real samples of several laboratories, where they are at hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from worldline_core.data.curate import curate
from worldline_core.data.curate_config import CurateConfig
from worldline_core.data.episode_set import EpisodeSet


def run(tmp_path: Path, **source: Any) -> tuple[dict[str, Any], EpisodeSet]:
    counts = curate(CurateConfig.model_validate({"sources": [source], "image_size": (48, 64)}), {}, tmp_path / "out")
    assert counts["kept"] + counts["quarantined"] == counts["found"]
    return counts, EpisodeSet.open(tmp_path / "out")


def test_agibot_v1(tmp_path: Path, shared_data: Path) -> None:
    counts, curated = run(tmp_path, kind="agibot_gesim", path=str(shared_data / "agibot_gesim"), fps=30)
    assert (counts["found"], counts["kept"]) == (2, 2)
    for i, row in enumerate(curated.rows):
        episode = curated.episode(i)
        assert (row.num_frames, row.video_frames) == (300, 4)
        assert curated.frames(i, "left_wrist").shape == (4, 48, 64, 3)
        raw = np.load(next((shared_data / "agibot_gesim").glob(f"{row.scene.rsplit('-', 1)[1]}/actions.npy")))
        assert episode.T_base_ee is not None
        distance = np.linalg.norm(episode.T_base_ee[:, 0, :3, 3] - raw[:, :3], axis=1)
        assert np.allclose(distance, 0.23, atol=1e-6)
        # A wrist camera is fixed to its arm: millimetres, as its README measured.
        mount = np.linalg.inv(episode.T_base_ee[:, 1]) @ episode.cameras["right_wrist"].T_base_camera
        assert mount[:, :3, 3].std(axis=0).max() < 0.02
    closed = curated.episode(0).state[:, 15]
    assert closed.max() < 0.1  # about 117 of 120: closed
    assert curated.episode(0).state[:, 7].min() > 0.9  # about 35: open


def test_agibot_v2(tmp_path: Path, shared_data: Path) -> None:
    counts, curated = run(tmp_path, kind="agibot_gesim", path=str(shared_data / "agibot_gesim_v2"), fps=30)
    assert (counts["found"], counts["kept"]) == (2, 2)
    assert [row.video_frames for row in curated.rows] == [1, 1]
    assert [row.num_frames for row in curated.rows] == [456, 299]
    episode = curated.episode(0)
    assert episode.state.shape == (456, 16)
    assert np.abs(episode.state - episode.action)[:, :7].max() < 0.2  # the command is tracked
    assert 0 <= episode.state[:, [7, 15]].min() <= episode.state[:, [7, 15]].max() <= 1
    assert episode.state[0, 15] > 0.99
    assert episode.state[:, 15].min() < 0.05
    head = episode.cameras["head"]
    assert (head.width, head.height) == (64, 48)
    in_camera = np.linalg.inv(head.T_base_camera[0]) @ np.append(episode.T_base_ee[0, 0, :3, 3], 1)  # type: ignore[index]
    u, v = (head.K @ (in_camera[:3] / in_camera[2]))[:2]
    assert in_camera[2] > 0
    assert 0 < u < 64
    assert 0 < v < 48


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


def test_unitree(tmp_path: Path, shared_data: Path) -> None:
    counts, curated = run(
        tmp_path,
        kind="lerobot_v21",
        path=str(shared_data / "lerobot_unitree_g1"),
        embodiment="unitree_g1",
        angle_unit="rad",
        views={"observation.images.cam_high": "head"},
    )
    assert (counts["found"], counts["kept"], counts["reasons"]) == (100, 2, {"missing_file": 98})
    assert [row.num_frames for row in curated.rows] == [221, 277]
    assert [row.stage2_reason for row in curated.rows] == ["missing_view", "missing_view"]
