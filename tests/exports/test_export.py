"""Exports: LeRobot's own class and tools, MCAP and Rerun readers open them, and find what was put in."""

from __future__ import annotations

import io
import json
import os
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.reader import read_ros2_messages
from PIL import Image
from rerun.chunk import RrdReader

from tests.data.conftest import make_sample  # pyright: ignore[reportMissingImports]
from tests.exports.conftest import COUNT  # pyright: ignore[reportMissingImports]
from worldline_core.data.episodes.episode import REPEATS_STATE, VIEWS
from worldline_core.data.episodes.episode_index import read_index, write_index
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.mcap.exported import read_exported_episode
from worldline_core.data.mcap.file import McapFile
from worldline_core.errors import ConfigError, DataError
from worldline_core.exports.export import export, shown_tracks, write_prediction_mcap
from worldline_core.exports.rerun_recording import RecordingContent, write_rerun_recording
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.publishing import set_files

FRAMES = 20


@pytest.fixture(scope="module")
def linked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set like a filter's: segments of episodes whose datasets lie in another artifact, with that one's licences."""
    root = tmp_path_factory.mktemp("sets")
    with EpisodeSetWriter(root / "curated") as writer:
        for number in range(3):
            named = {"episode_id": f"e{number}", "embodiment": "toy", "instruction": f"lift {number}"}
            rate = {"fps": 10.0, "timestamps": np.arange(FRAMES) / 10}
            writer.add(*make_sample(number, num_frames=FRAMES, views=("head",), **named, **rate))
    (root / "curated/sources.json").write_text(json.dumps([{"label": "toy", "license": "MIT"}]))
    (root / "filtered").mkdir()
    rows = [replace(row, dataset=f"../curated/{row.dataset}") for row in read_index(root / "curated")]
    segment = replace(rows[1], episode_id="e1#5-15", start=5, stop=15, num_frames=10, video_frames=10)
    write_index(root / "filtered", [rows[0], segment, rows[2]])
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
    reader = RrdReader(tmp_path / f"{stem}.rrd")
    assert len(reader.blueprints()) == 1
    assert {"/world/cameras/head/true", "/signals/action/right_gripper"} <= {c.entity_path for c in reader.stream()}


def test_a_rerun_export_holds_the_tools_and_names_what_they_are(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    poses = np.tile(np.diag([1.0, -1, -1, 1]), (6, 1, 1, 1))
    poses[:, 0, :3, 3] = np.linspace([-0.2, 0, 0.8], [0.2, 0.1, 0.6], 6)
    state = np.linspace(0, 1, 12, dtype=np.float32).reshape(6, 2)
    arm = {"embodiment": "nobody", "state": state, "action": state, "state_names": ("right/a", "right/gripper")}
    with EpisodeSetWriter(tmp_path / "set") as writer:
        for name, tools in (("recorded", {"T_base_ee": poses, "gripper": state[:, 1:]}), ("unknown", {})):
            writer.add(*make_sample(num_frames=6, views=("head",), episode_id=name, **arm, **tools)[:2])
    export(tmp_path / "set", tmp_path / "out", ["rrd"])
    recorded, unknown = (
        {chunk.entity_path: chunk.to_record_batch() for chunk in RrdReader(tmp_path / f"out/{name}.rrd").stream()}
        for name in ("recorded", "unknown")
    )
    assert {"/world/tools/arm0", "/world/tool_paths/arm0", "/world/cameras/head/actions"} <= set(recorded)
    # No commands are projected without kinematics: what is drawn is named, here and on the page of `inspect`.
    assert "tools and action maps: measured tool poses" in str(recorded["/description"].to_pylist())
    # Nobody describes this robot, so nothing tells where its tools are.
    assert "/world/cameras/head/true" in unknown
    assert not any(path.startswith("/world/tool") for path in unknown)
    assert "unknown.rrd has no tool poses" in caplog.text


def test_controls_are_drawn_from_the_commands_where_tool_poses_are_recorded_too() -> None:
    """As in AgiBot World: joints with commands beside measured tool poses."""
    kinematics = ArmKinematics(load_embodiment("ur5e_pair"))
    state = make_sample()[0].state
    action = state + np.float32(0.1)
    measured, commanded = (
        kinematics.tools_of(kinematics.link_poses(values.astype(np.float64))).numpy() for values in (state, action)
    )
    episode = make_sample(action=action, T_base_ee=measured, gripper=state[:, [6, 13]])[0]
    tracks = shown_tracks(episode)
    assert tracks.controls == "action"
    assert np.allclose(tracks.T_base_tool, commanded, atol=1e-5)
    assert not np.allclose(tracks.T_base_tool, measured, atol=1e-3)
    without_commands = shown_tracks(replace(episode, action=state, conventions={"action": REPEATS_STATE}))
    assert np.allclose(without_commands.T_base_tool, measured, atol=1e-5)


def test_what_is_not_exported_is_named(linked: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"(?s)Not a format of EpisodeSet.*lerobot, mcap, mcap-ros2, rrd.*mp4"):
        export(linked, tmp_path, ["mp4"])
    with pytest.raises(DataError, match=r"(?s)No such episode.*nothing"):
        export(linked, tmp_path, ["mcap"], episode_ids=["nothing"])


def test_demonstrations_alone_are_exported(linked: Path, tmp_path: Path) -> None:
    """Recordings that ended in success; their datasets have these episodes and no others."""
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    dataset = os.path.relpath(linked.parent / "curated/datasets/toy", mixed)
    outcomes = ("success", "failure", "success")
    rows = [replace(row, dataset=dataset, outcome=o) for row, o in zip(read_index(linked), outcomes, strict=True)]
    write_index(mixed, rows)
    export(mixed, tmp_path / "out", ["lerobot"], outcome="success")
    assert [row.episode_id for row in EpisodeSet.open(tmp_path / "out").rows] == ["e0", "e2"]
    assert json.loads((tmp_path / "out/datasets/toy/meta/info.json").read_text())["total_episodes"] == 2
    with pytest.raises(DataError, match=r"(?s)No episode is exported.*failure.*success.*partial"):
        export(mixed, tmp_path / "other", ["lerobot"], outcome="partial")


@pytest.fixture(scope="module")
def chunks(content: RecordingContent, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list]:
    """Record batches by entity, read by Rerun's own reader."""
    path = tmp_path_factory.mktemp("rerun") / "episode.rrd"
    write_rerun_recording(path, content)
    reader = RrdReader(path)
    assert len(reader.blueprints()) == 1
    found: dict[str, list] = {}
    for chunk in reader.stream():
        found.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return found


def column(batches: list, name: str) -> list:
    return [row for batch in batches if name in batch.schema.names for row in batch.column(name).to_pylist()]


def test_rerun_holds_frames_of_every_view_and_method(chunks: dict[str, list], content: RecordingContent) -> None:
    for view in VIEWS:
        for entity in (f"/world/cameras/{view}/true", f"/world/cameras/{view}/actions", f"/predicted/stage2/{view}"):
            assert len(column(chunks[entity], "EncodedImage:blob")) == COUNT
    blob = column(chunks["/world/cameras/head/true"], "EncodedImage:blob")[2][0]
    with Image.open(io.BytesIO(bytes(blob))) as picture:
        error = np.abs(np.asarray(picture, dtype=int) - content.true_frames["head"][2]).mean()
    assert error < 12  # JPEG of noise


def test_rerun_poses_are_those_of_the_cameras(chunks: dict[str, list], content: RecordingContent) -> None:
    for view, count in (("head", 1), ("left_wrist", COUNT)):
        batches, expected = chunks[f"/world/cameras/{view}"], content.episode.cameras[view].T_base_camera
        stored = np.array(column(batches, "Transform3D:mat3x3")).reshape(count, 3, 3).transpose(0, 2, 1)  # column-major
        places = np.array(column(batches, "Transform3D:translation")).reshape(count, 3)
        assert np.allclose(stored, expected[:, :3, :3], atol=1e-6)
        assert np.allclose(places, expected[:, :3, 3], atol=1e-6)
    pinhole = np.array(column(chunks["/world/cameras/head"], "Pinhole:image_from_camera")).reshape(3, 3).T
    assert pinhole[:2, 2] == pytest.approx([24.0, 16.0])  # counted from the corner, not from the first pixel's centre


def test_rerun_signals_are_named_and_timed_and_the_robot_lies_along_its_capsules(
    chunks: dict[str, list], content: RecordingContent
) -> None:
    values = np.array(column(chunks["/signals/action/right_gripper"], "Scalars:scalars"))[:, 0]
    assert np.allclose(values, content.episode.action[:, 13])
    times = column(chunks["/signals/state/left_j0"], "time")
    assert [time.total_seconds() for time in times] == pytest.approx([0, 0.125, 0.25, 0.375, 0.5])
    strips = column(chunks["/world/robot"], "LineStrips3D:strips")
    assert len(strips) == COUNT
    assert np.allclose(strips[2][0], content.tracks.capsules[2, 0])
    assert column(chunks["/world/robot"], "LineStrips3D:radii")[0] == pytest.approx([0.01])


def test_mcap_holds_images_calibration_and_transforms(content: RecordingContent, tmp_path: Path) -> None:
    path, again, ros2 = (tmp_path / f"{name}.mcap" for name in ("episode", "again", "ros2"))
    for file in (path, again):
        write_prediction_mcap(file, content, "protobuf")
    with path.open("rb") as stream:
        reader = make_reader(stream)
        found = [(channel.topic, message.log_time) for _, channel, message in reader.iter_messages()]
        facts = next(m.metadata for m in reader.iter_metadata() if m.name == "worldline.rollout")
    topics = {f"/{v}/{name}": count for v in VIEWS for name, count in (("image", COUNT), ("calibration", 1))}
    assert Counter(topic for topic, _ in found) == topics | {"/tf": 1 + 2 * COUNT + 2 * COUNT}
    assert found[-1][1] == round((COUNT - 1) / 8.0 * 1e9)
    assert json.loads(facts["method"]) == "stage2"
    assert again.read_bytes() == path.read_bytes()
    write_prediction_mcap(ros2, content, "ros2")
    counts = Counter(message.channel.topic for message in read_ros2_messages(str(ros2)))
    assert counts == topics | {"/tf": 4 * COUNT, "/tf_static": 1}
