"""Exports of an EpisodeSet: read by LeRobot's own class and edited by its own tools, by MCAP and Rerun readers."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from worldline_core.data.episodes.episode import REPEATS_STATE, CameraTrack, Episode
from worldline_core.data.episodes.episode_index import read_index, write_index
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.mcap.exported import read_exported_episode
from worldline_core.data.mcap.file import McapFile
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.exports.export import export, shown_tracks
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.publishing import set_files
from worldline_core.store.artifact_files import write_manifest

FRAMES = 20


@pytest.fixture(scope="module")
def linked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set like a filter's: segments of episodes whose datasets lie in another artifact, with that one's licences."""
    root = tmp_path_factory.mktemp("sets")
    with EpisodeSetWriter(root / "curated") as writer:
        for number in range(3):
            time = np.arange(FRAMES) / 10
            state = np.stack([np.sin(time + number), np.cos(time)], axis=1).astype(np.float32)
            rows, columns = np.mgrid[:32, :48]
            shade = (columns[None] * 3 + rows[None] * 2 + 6 * np.arange(FRAMES)[:, None, None] + 30 * number) % 200
            frames = np.stack([shade, 200 - shade, shade // 2], axis=-1).astype(np.uint8)
            moving = np.tile(np.eye(4), (FRAMES, 1, 1))
            moving[:, 0, 3] = time
            cameras = {"head": CameraTrack("head", np.diag([40.0, 41.0, 1.0]), moving, 48, 32)}
            episode = Episode(
                episode_id=f"e{number}", source="toy", embodiment="toy", scene="s", task_family="lift", instruction=f"lift {number}",
                outcome="success", split="train", fps=10.0, state=state, action=state + 1, timestamps=time, cameras=cameras,
                state_names=("right/a", "right/gripper"),
            )  # fmt: skip
            writer.add(episode, {"head": frames}, {"head": shade < 60})
    (root / "curated/sources.json").write_text(json.dumps([{"label": "toy", "license": "MIT"}]))
    (root / "filtered").mkdir()
    rows = [replace(row, dataset=f"../curated/{row.dataset}") for row in read_index(root / "curated")]
    whole, segment = rows[0], replace(rows[1], episode_id="e1#5-15", start=5, stop=15, num_frames=10, video_frames=10)
    write_index(root / "filtered", [whole, segment, rows[2]])
    return root / "filtered"


@pytest.mark.slow
@pytest.mark.timeout(600)  # importing LeRobot alone takes minutes on a busy machine
def test_lerobots_own_class_and_tools_work_on_an_export(
    linked: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_DATASETS_CACHE", str(tmp_path / "cache"))
    assert export(linked, tmp_path / "out", ["lerobot"]) == [tmp_path / "out"]
    before: Any = EpisodeSet.open(linked)
    after: Any = EpisodeSet.open(tmp_path / "out")
    assert [row.episode_id for row in after.rows] == ["e0", "e1#5-15", "e2"]
    for i in range(3):
        assert np.array_equal(after.episode(i).state, before.episode(i).state)
        assert np.array_equal(
            after.episode(i).cameras["head"].T_base_camera, before.episode(i).cameras["head"].T_base_camera
        )
        assert np.array_equal(after.robot_masks(i, "head"), before.robot_masks(i, "head"))
        difference = np.abs(after.frames(i, "head").astype(int) - before.frames(i, "head"))
        # Whole rows are copied; the segment begins between key frames and is encoded again.
        assert difference.max() == 0 if i != 1 else difference.mean() < 2
    assert set_files(tmp_path / "out")  # can be pushed: nothing of it lies elsewhere
    assert json.loads((tmp_path / "out/sources.json").read_text()) == [{"label": "toy", "license": "MIT"}]
    from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets, split_dataset
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = tmp_path / "out/datasets/toy"
    offsets = {"observation.images.head": [-0.1, 0.0], "action": [0.0, 0.1, 0.2]}
    opened: Any = LeRobotDataset("local/set", root=root, video_backend="pyav", delta_timestamps=offsets)
    assert (opened.num_episodes, len(opened), opened.fps) == (3, 50, 10)
    item = opened[22]  # frame 2 of the second episode
    assert np.array_equal(item["action"].numpy(), after.episode(1).action[[2, 3, 4]])
    pixels = (item["observation.images.head"].permute(0, 2, 3, 1).numpy() * 255).round()
    assert np.abs(pixels - after.frames(1, "head", [1, 2])).max() <= 3
    assert opened[20]["observation.images.head_is_pad"].tolist() == [True, False]
    stats = opened.meta.stats["observation.state"]
    everything = np.concatenate([after.episode(i).state for i in range(3)])
    assert np.allclose(stats["mean"], everything.mean(axis=0), atol=1e-6)
    assert np.allclose(stats["std"], everything.std(axis=0), atol=1e-6)
    whole: Any = LeRobotDataset("local/set", root=root, video_backend="pyav")
    fewer = delete_episodes(whole, [1], output_dir=tmp_path / "fewer", repo_id="local/fewer")
    assert (fewer.num_episodes, len(fewer)) == (2, 40)
    parts = split_dataset(whole, {"a": [0], "b": [1, 2]}, output_dir=tmp_path / "parts")
    merged: Any = merge_datasets(list(parts.values()), output_repo_id="local/all", output_dir=tmp_path / "all")
    assert (merged.num_episodes, len(merged)) == (3, 50)
    assert np.array_equal(merged[45]["observation.state"].numpy(), after.episode(2).state[15])


def test_episodes_as_mcap_and_rerun(linked: Path, tmp_path: Path) -> None:
    written = export(linked, tmp_path, ["mcap-ros2", "mcap", "rrd"], episode_ids=["e1#5-15"])
    stem = safe_stem("e1#5-15")
    names = [f"{stem}.mcap", f"{stem}.ros2.mcap", f"{stem}.rrd"]
    assert sorted(path.name for path in written) == names
    episodes: Any = EpisodeSet.open(linked)
    for name in names[:2]:
        read: Any = read_exported_episode(McapFile(tmp_path / name))
        assert np.array_equal(read.frames("head"), episodes.frames(1, "head"))
        assert np.array_equal(read.robot_masks("head"), episodes.robot_masks(1, "head"))
        assert np.array_equal(read.episode.state, episodes.episode(1).state)
    from rerun.chunk import RrdReader

    reader = RrdReader(tmp_path / f"{stem}.rrd")
    assert len(reader.blueprints()) == 1
    assert {"/world/cameras/head/true", "/signals/action/right_gripper"} <= {c.entity_path for c in reader.stream()}


def test_a_rerun_export_holds_the_tools_and_names_what_they_are(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    from rerun.chunk import RrdReader

    poses = np.tile(np.diag([1.0, -1, -1, 1]), (6, 1, 1, 1))
    poses[:, 0, :3, 3] = np.linspace([-0.2, 0, 0.8], [0.2, 0.1, 0.6], 6)
    cameras = {"head": CameraTrack("head", np.diag([40.0, 41.0, 1.0]), np.eye(4)[None], 48, 32)}
    state = np.linspace(0, 1, 12, dtype=np.float32).reshape(6, 2)
    with EpisodeSetWriter(tmp_path / "set") as writer:
        for name, tools in (("recorded", poses), ("unknown", None)):
            episode = Episode(
                episode_id=name, source="toy", embodiment="nobody", scene="s", task_family="lift", instruction="lift", outcome="success",
                split="train", fps=10.0, state=state, action=state, timestamps=np.arange(6) / 10, cameras=cameras, T_base_ee=tools,
                gripper=None if tools is None else state[:, 1:], state_names=("right/a", "right/gripper"),
            )  # fmt: skip
            writer.add(episode, {"head": np.full((6, 32, 48, 3), 90, np.uint8)})
    export(tmp_path / "set", tmp_path / "out", ["rrd"])
    recorded = {
        chunk.entity_path: chunk.to_record_batch() for chunk in RrdReader(tmp_path / "out/recorded.rrd").stream()
    }
    assert {"/world/tools/arm0", "/world/tool_paths/arm0", "/world/cameras/head/actions"} <= set(recorded)
    # No commands are projected without kinematics: what is drawn is named, here and on the page of `inspect`.
    assert "tools and action maps: measured tool poses" in str(recorded["/description"].to_pylist())
    # Nobody describes this robot, so nothing tells where its tools are.
    unknown = {chunk.entity_path for chunk in RrdReader(tmp_path / "out/unknown.rrd").stream()}
    assert "/world/cameras/head/true" in unknown
    assert not any(path.startswith("/world/tool") for path in unknown)
    assert "unknown.rrd has no tool poses" in caplog.text


def test_controls_are_drawn_from_the_commands_where_tool_poses_are_recorded_too() -> None:
    """As in AgiBot World: joints with commands beside measured tool poses."""
    kinematics = ArmKinematics(load_embodiment("ur5e_pair"))
    state = np.linspace(-0.3, 0.3, 4 * 14, dtype=np.float32).reshape(4, 14)
    state[:, [6, 13]] = 0.5
    action = state + np.float32(0.1)
    measured, commanded = (
        kinematics.tools_of(kinematics.link_poses(np.asarray(values, dtype=np.float64))).numpy()
        for values in (state, action)
    )
    episode = Episode(
        episode_id="e", source="toy", embodiment="ur5e_pair", scene="s", task_family="lift", instruction="", outcome="unknown",
        split="train", fps=10.0, state=state, action=action, timestamps=np.arange(4) / 10, T_base_ee=measured,
        gripper=state[:, [6, 13]], cameras={"head": CameraTrack("head", np.diag([40.0, 41.0, 1.0]), np.eye(4)[None], 48, 32)},
    )  # fmt: skip
    tracks = shown_tracks(episode)
    assert tracks.controls == "action"
    assert np.allclose(tracks.T_base_tool, commanded, atol=1e-5)
    assert not np.allclose(tracks.T_base_tool, measured, atol=1e-3)
    without_commands = shown_tracks(replace(episode, action=state, conventions={"action": REPEATS_STATE}))
    assert np.allclose(without_commands.T_base_tool, measured, atol=1e-5)


def test_a_damaged_set_is_not_exported(linked: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(linked.parent / "curated", tmp_path / "set")
    write_manifest(folder, {"step": "curate"})
    video = next(folder.rglob("*.mp4"))
    content, facts = bytearray(video.read_bytes()), video.stat()
    content[len(content) // 2] ^= 1
    video.write_bytes(content)
    os.utime(video, ns=(facts.st_atime_ns, facts.st_mtime_ns))
    with pytest.raises(ArtifactError, match=rf"{video.name}: sha256"):
        export(folder, tmp_path / "out", ["lerobot"])


def test_what_cannot_be_exported(linked: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"(?s)Not a format of EpisodeSet.*lerobot, mcap, mcap-ros2, rrd.*mp4"):
        export(linked, tmp_path, ["mp4"])
    with pytest.raises(DataError, match=r"(?s)No such episode.*nothing"):
        export(linked, tmp_path, ["mcap"], episode_ids=["nothing"])


def test_demonstrations_alone_are_exported(linked: Path, tmp_path: Path) -> None:
    """Recordings that ended in success; their datasets have these episodes and no others."""
    (tmp_path / "mixed").mkdir()
    rows = [
        replace(row, dataset=f"{linked.parent}/mixed/../curated/datasets/toy", outcome=outcome)
        for row, outcome in zip(read_index(linked), ("success", "failure", "success"), strict=True)
    ]
    relative = [replace(row, dataset=os.path.relpath(row.dataset, tmp_path / "mixed")) for row in rows]
    write_index(tmp_path / "mixed", relative)
    export(tmp_path / "mixed", tmp_path / "out", ["lerobot"], outcome="success")
    assert [row.episode_id for row in EpisodeSet.open(tmp_path / "out").rows] == ["e0", "e2"]
    assert json.loads((tmp_path / "out/datasets/toy/meta/info.json").read_text())["total_episodes"] == 2
    with pytest.raises(DataError, match=r"(?s)No episode is exported.*failure.*success.*partial"):
        export(tmp_path / "mixed", tmp_path / "other", ["lerobot"], outcome="partial")
