"""Datasets written here open in LeRobot's own class; foreign LeRobot datasets are read."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.data.episodes.view_recording import RecordedView
from worldline_core.data.video.clip import VideoClip, decode_video
from worldline_core.data.video.encoder import encode_video
from worldline_core.errors import ConfigError, DataError

Make = Callable[..., tuple]


@pytest.mark.slow
@pytest.mark.timeout(600)  # importing LeRobot alone takes minutes on a busy machine
def test_lerobots_own_class_reads_the_same_frames_and_values(
    tmp_path: Path, sample: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_DATASETS_CACHE", str(tmp_path / "cache"))
    with EpisodeSetWriter(tmp_path / "set") as writer:
        for number in range(3):
            writer.add(*sample(number, num_frames=5 + number))
    stored = EpisodeSet.open(tmp_path / "set")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    opened: Any = LeRobotDataset("local/set", root=tmp_path / "set/datasets/ur5e_pair", video_backend="pyav")
    assert (opened.num_episodes, len(opened), opened.fps) == (3, 5 + 6 + 7, 8)
    assert opened.meta.stats["observation.state"]["mean"].shape == (14,)
    for position, (episode, frame) in {0: (0, 0), 4: (0, 4), 5: (1, 0), 12: (2, 1), 17: (2, 6)}.items():
        item = opened[position]
        assert (int(item["episode_index"]), int(item["frame_index"])) == (episode, frame)
        assert np.array_equal(item["observation.state"].numpy(), stored.episode(episode).state[frame])
        assert np.array_equal(item["action"].numpy(), stored.episode(episode).action[frame])
        assert item["task"] == stored.rows[episode].instruction
        for view in stored.rows[episode].views:
            pixels = (item[f"observation.images.{view}"].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
            assert np.array_equal(pixels, stored.frames(episode, view, [frame])[0])
    # Videos copied as they were recorded, with frames stored out of order, one file an episode.
    shown = {}
    with EpisodeSetWriter(tmp_path / "copied") as writer:
        for number in range(2):
            episode, frames, _ = sample(number, num_frames=15)
            path = tmp_path / f"{number}.mp4"
            _foreign_video(path, frames["head"])
            shown[number] = decode_video(path)
            clip = VideoClip.whole_file(path, 15, 8.0)
            only_head = replace(episode, cameras={"head": episode.cameras["head"]})
            writer.add(only_head, {"head": RecordedView(lambda: iter(()), 15, clip)})
    copied: Any = LeRobotDataset("local/copied", root=tmp_path / "copied/datasets/ur5e_pair", video_backend="pyav")
    for position in (0, 1, 7, 14, 15, 22, 29):
        pixels = (copied[position]["observation.images.head"].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
        assert np.array_equal(pixels, shown[position // 15][position % 15])


def _foreign_video(path: Path, frames: np.ndarray) -> None:
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=8)
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], "yuv420p"
        stream.options = {"bf": "3", "threads": "1"}
        for image in frames:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        out.mux(stream.encode(None))


def v21_dataset(root: Path, lengths: dict[int, int], *, degrees: bool = False) -> None:
    names = ["shoulder", "elbow", "gripper"]
    vector = {"dtype": "float32", "shape": [3], "names": [names]}
    info = {
        "codebase_version": "v2.1",
        "fps": 10,
        "chunks_size": 1000,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
        "features": {
            "observation.state": vector,
            "action": vector,
            "observation.images.cam": {"dtype": "video", "shape": [16, 24, 3]},
        },
    }
    (root / "meta").mkdir(parents=True)
    (root / "meta/info.json").write_text(json.dumps(info))
    listed = [{"episode_index": i, "tasks": ["push"], "length": 6} for i in range(3)]
    (root / "meta/episodes.jsonl").write_text("\n".join(json.dumps(row) for row in listed))
    (root / "meta/tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": "push"}))
    for index, length in lengths.items():
        state = np.stack([np.linspace(0, 1, length), np.linspace(0.5, 0, length), np.linspace(90, -10, length)], 1)
        if degrees:
            state[:, :2] = np.rad2deg(state[:, :2])
        columns = {
            "observation.state": state.astype(np.float32).tolist(),
            "action": state.astype(np.float32).tolist(),
            "timestamp": np.arange(length) / 10,
            "task_index": [0] * length,
        }
        data = root / f"data/chunk-000/episode_{index:06d}.parquet"
        data.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(columns), data)
        video = root / f"videos/chunk-000/observation.images.cam/episode_{index:06d}.mp4"
        video.parent.mkdir(parents=True, exist_ok=True)
        frames = np.random.default_rng(index).integers(0, 255, (length, 16, 24, 3), dtype=np.uint8)
        encode_video(video, frames, 10)


def source(root: Path, **changes: object) -> CurateConfig:
    declared = {
        "kind": "lerobot_v21",
        "path": str(root),
        "embodiment": "none",
        "angle_unit": "rad",
        "views": {"observation.images.cam": "head"},
        "grippers": {"gripper": {"closed": 0, "open": 80}},
    }
    return CurateConfig.model_validate({"sources": [declared | changes]})


@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_v21_is_read_with_declared_units_and_missing_episodes_are_listed(tmp_path: Path, unit: str) -> None:
    v21_dataset(tmp_path / "v21", {0: 6, 2: 5}, degrees=unit == "deg")
    counts = curate(source(tmp_path / "v21", angle_unit=unit), {}, tmp_path / "out")
    assert (counts["found"], counts["kept"]) == (3, 1)
    assert counts["reasons"] == {"length_mismatch": 1, "missing_file": 1}
    episode = EpisodeSet.open(tmp_path / "out").episode(0)
    assert np.allclose(episode.state[:, 0], np.linspace(0, 1, 6), atol=1e-6)
    assert episode.state[0, 2] == 1.0  # 90 of 80: clipped and counted
    assert episode.state[-1, 2] == 0.0
    assert episode.conventions["gripper_overshoot"] == 4
    assert episode.instruction == "push"


def test_undeclared_or_unknown_things_are_refused(tmp_path: Path) -> None:
    v21_dataset(tmp_path / "v21", {0: 6})
    with pytest.raises(ConfigError, match=r"(?s)no camera.*observation\.images\.cam"):
        curate(source(tmp_path / "v21", views={"observation.images.top": "head"}), {}, tmp_path / "out")
    with pytest.raises(ValueError, match="angle_unit"):
        source(tmp_path / "v21", angle_unit=None)
    with pytest.raises(DataError, match=r"(?s)another version.*expected: v3\.0.*got: v2\.1"):
        curate(source(tmp_path / "v21", kind="lerobot_v3"), {}, tmp_path / "out")
