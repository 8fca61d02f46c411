"""Damaged, foreign and misdeclared files; several episodes in a file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as RawWriter

from tests.data.curating import run
from tests.mcap import conftest as toy
from tests.mcap.conftest import load, rejection, source


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
def test_wrong_checksums_are_found(tmp_path: Path, compression: CompressionType) -> None:
    path = toy.robot(1.0).write(tmp_path / "a.mcap", compression=compression)
    assert load(toy.declared(tmp_path)).episode.num_frames == 30
    with path.open("rb") as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[3]  # type: ignore[union-attr]
    content = bytearray(path.read_bytes())
    content[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0xFF
    path.write_bytes(content)
    assert rejection(toy.declared(tmp_path)).reason == "unreadable"


def test_files_without_chunks_or_summary_are_read(tmp_path: Path) -> None:
    path = toy.robot(1.0).write(tmp_path / "source.mcap").rename(tmp_path / "source")
    states = []
    for options in (
        {}, {"use_chunking": False}, {"use_summary_offsets": False, "use_statistics": False, "repeat_channels": False},
    ):  # fmt: skip
        with path.open("rb") as stream, (tmp_path / "a.mcap").open("wb") as target:
            writer = RawWriter(target, chunk_size=4096, **options)
            writer.start()
            schemas, channels = {}, {}
            for schema, channel, message in make_reader(stream).iter_messages(log_time_order=False):
                if schema.id not in schemas:
                    schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
                if channel.id not in channels:
                    channels[channel.id] = writer.register_channel(channel.topic, "cdr", schemas[schema.id])
                writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
            writer.finish()
        loaded = load(toy.declared(tmp_path))
        states.append(loaded.episode.state.tobytes())
        assert np.array_equal(toy.number_of(loaded.frames("head")), np.arange(30))
    assert len(set(states)) == 1


def write_split(folder: Path, listed: str) -> None:
    """The robot's recording as rosbag2 splits it: what is sent once, such as /tf_static, is in the first part only."""
    sent = toy.robot().sent
    for number, part in enumerate((sent[:200], sent[200:500], sent[500:])):
        # Channels and schemas are numbered as they first appear, so differently in each part.
        toy.Recording(part if number else [*part[::-1]]).write(folder / f"run_{number}.mcap")
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  version: 5\n  {listed}\n")


@pytest.mark.parametrize(("place", "prefix"), [("bags/run", ""), (".", "run/")])
def test_a_split_bag_is_one_recording(tmp_path: Path, place: str, prefix: str) -> None:
    toy.robot().write(tmp_path / "whole" / "a.mcap")
    root = tmp_path / "split"
    write_split(root / place, f"relative_file_paths: [{', '.join(f'{prefix}run_{n}.mcap' for n in range(3))}]")
    toy.robot(1.0).write(root / place / "other.mcap")  # the list does not name it
    opened, whole = source(toy.declared(root)), load(toy.declared(tmp_path / "whole"))
    name = "toy-bags/run" if place != "." else "toy-split"
    assert name in opened.episode_ids()
    assert len(opened.episode_ids()) == 2
    loaded = opened.load(name)
    assert np.array_equal(loaded.episode.state, whole.episode.state)
    found, expected = (each.episode.cameras["right_wrist"].T_base_camera for each in (loaded, whole))
    assert np.array_equal(found, expected)
    assert np.array_equal(toy.number_of(loaded.frames("head")), np.arange(90))
    ranges = toy.declared(root, episodes={"by": "ranges", "ranges": [{"name": "x", "start_s": 1.0, "stop_s": 2.0}]})
    assert source(ranges).load(f"{name}-x").episode.num_frames == pytest.approx(30, abs=1)


@pytest.mark.parametrize(
    ("listed", "reason", "named"),
    [
        ("relative_file_paths: [run_0.mcap, run_1.mcap, run_3.mcap]", "missing_file", "run_3.mcap"),
        ("relative_file_paths: 7", "unreadable", "relative_file_paths"),
        ("relative_file_paths: [1, 2]", "unreadable", "relative_file_paths"),
        ("relative_file_paths: [a, a", "unreadable", "ros2 bag reindex"),
        ("files: []", "unreadable", "relative_file_paths"),
    ],
)
def test_lists_of_parts_that_cannot_be_used_are_named(tmp_path: Path, listed: str, reason: str, named: str) -> None:
    write_split(tmp_path / "bag", listed)
    error = rejection(toy.declared(tmp_path), "toy-bag")
    assert error.reason == reason
    assert named in str(error)


@pytest.mark.parametrize(
    ("name", "begins", "next_step"),
    [
        ("a.mcap.zstd", b"\x28\xb5\x2f\xfd", "zstd -d"),
        ("a.mcap", b"\x28\xb5\x2f\xfd", "zstd -d"),
        ("a.mcap", b"\x1f\x8b", "gunzip"),
        ("a.db3", b"SQLite format 3\0", "mcap convert"),
        ("a.bag", b"#ROSBAG V2.0\n", "rosbags-convert"),
    ],
)
def test_other_bags_are_named_with_their_next_step(tmp_path: Path, name: str, begins: bytes, next_step: str) -> None:
    (tmp_path / name).write_bytes(begins.ljust(200, b"\0"))
    error = rejection(toy.declared(tmp_path), f"toy-{name.removesuffix('.mcap')}")
    assert (error.reason, next_step in str(error.next_step)) == ("unreadable", True)


def test_missing_topics_are_named_beside_those_there_are_and_those_of_images_cost_their_view(tmp_path: Path) -> None:
    toy.robot().write(tmp_path / "a.mcap")
    declared = toy.declared(tmp_path, primary_view="head")
    declared["views"]["head"]["image"] = "/top/image"
    loaded = load(declared)
    assert loaded.views == ("right_wrist",)
    error = loaded.absent["head"]
    assert (error.reason, error.expected) == ("missing_topic", "/top/image")
    assert "/head/image/compressed (sensor_msgs/msg/CompressedImage)" in str(error.got)
    declared["arms"][0]["state"]["gripper"]["topic"] = "/finger"
    assert rejection(declared).expected == "/finger, /top/image"  # all that is missing
    declared = toy.declared(tmp_path)
    for view in declared["views"].values():
        view["image"] = "/none"
    assert rejection(declared).expected == "/none"


def test_pictures_alone_need_no_arms(tmp_path: Path) -> None:
    toy.robot(0.5).write(tmp_path / "a.mcap")
    declared = toy.declared(tmp_path)
    cameras = set(load(declared).episode.cameras)
    del declared["arms"]
    episode = load(declared).episode
    assert (episode.state_kind, episode.state.shape[1], episode.commanded) == ("none", 0, False)
    assert set(episode.cameras) == cameras


def test_schemas_that_do_not_fit_and_joints_that_no_message_has(tmp_path: Path) -> None:
    recording = toy.robot(0.5)
    recording.add("/imu", "sensor_msgs/msg/Imu", 0.1, {})
    recording.write(tmp_path / "a.mcap")
    declared = toy.declared(tmp_path)
    for topic, what in (("/imu", "not understood"), ("/head/camera_info", "another kind")):
        error = rejection(declared | {"views": {"head": {"image": topic}}})
        assert (error.reason, what in error.what, topic in str(error.where)) == ("unknown_schema", True, True)
    declared["arms"][0]["state"]["joints"]["names"] = ["a", "elbow"]
    error = rejection(declared)
    assert (error.reason, error.expected, error.got) == ("missing_column", "a, elbow", "a, b, finger")


def test_drivers_that_share_a_topic(tmp_path: Path) -> None:
    """Arm and gripper publish their own joints on one topic, at their own rates."""
    recording = toy.robot()

    def split(sent: list[Any]) -> Iterator[Any]:
        for number, each in enumerate(sent):
            for part in (slice(0, 1), slice(1, 3)):
                if part.start == 1 or number % 2 == 0:
                    values = {name: each.message[name][part] for name in ("name", "position")}
                    yield replace(each, message=each.message | values)

    recording.change("/joint_states", split)
    recording.write(tmp_path / "a.mcap")
    episode = load(toy.declared(tmp_path)).episode
    time = episode.timestamps
    assert np.abs(episode.state[:, :2] - toy.joints(time)).max() < 1e-5
    assert np.abs(episode.state[:, 2] - toy.finger(time) / 0.04).max() < 1e-4


def test_frames_that_do_not_hang_together_and_a_calibration_that_changes(tmp_path: Path) -> None:
    def with_transform(*transform: Any) -> Any:
        recording = toy.robot(0.5)
        recording.transforms(0.1, toy.transform(*transform))
        recording.write(tmp_path / "a.mcap")
        return rejection(toy.declared(tmp_path))

    error = with_transform("wrist", "head_optical_frame", 0.0, [0, 0, 0], [0, 0, 0, 1])
    assert (error.reason, error.what) == ("invalid_extrinsics", "A frame has two parents")
    assert "without direction" in with_transform("wrist", "wrist_optical_frame", 0.0, [0, 0, 0], [0, 0, 0, 0]).what
    recording = toy.robot(0.5)
    recording.write(tmp_path / "a.mcap")
    error = rejection(toy.declared(tmp_path, base_frame="torso"))
    assert (error.reason, "base_link -> wrist" in str(error.got)) == ("missing_calibration", True)
    other = toy.camera_info(k=[25.0, 0, 7.5, 0, 25.0, 5.5, 0, 0, 1.0])
    recording.add("/head/camera_info", "sensor_msgs/msg/CameraInfo", 0.2, other, frame="head_optical_frame")
    recording.write(tmp_path / "a.mcap")
    assert rejection(toy.declared(tmp_path)).reason == "changing_calibration"


def test_time_ranges_cut_a_long_file(tmp_path: Path) -> None:
    """The calibration and the static transforms were sent before; images are read around the range only."""
    toy.robot(6.0).write(tmp_path / "long" / "a.mcap")
    ranges = [
        {"name": "first", "start_s": 1.0, "stop_s": 2.0},
        {"name": "second", "start_s": 4.0, "stop_s": 5.5, "instruction": "wave twice"},
    ]
    declared = toy.declared(tmp_path, episodes={"by": "ranges", "ranges": ranges}, instruction="wave")
    opened = source(declared)
    assert opened.episode_ids() == ["toy-long/a-first", "toy-long/a-second"]
    for name, begin, count, text in (("first", 1.0, 30, "wave"), ("second", 4.0, 45, "wave twice")):
        loaded = opened.load(f"toy-long/a-{name}")
        episode = loaded.episode
        numbers = toy.number_of(loaded.frames("head"))
        assert abs(episode.num_frames - count) <= 1
        assert np.array_equal(numbers, numbers[0] + np.arange(episode.num_frames))
        assert abs(numbers[0] / 30 - begin) < 0.04
        assert np.abs(episode.state[:, :2] - toy.joints(numbers[0] / 30 + episode.timestamps)).max() < 1e-5
        assert (episode.instruction, episode.scene) == (text, "toy-long/a")
    with pytest.raises(ValueError, match="ends before it starts"):
        source(toy.declared(tmp_path, episodes={"by": "ranges", "ranges": [{"name": "x", "start_s": 2, "stop_s": 1}]}))


@pytest.mark.slow
def test_markers_bound_episodes(tmp_path: Path) -> None:
    recording = toy.robot(8.0)
    texts = {
        0.5: "start: pick the cup", 1.5: "operator coughs", 2.5: "stop: success",
        3.0: "start", 4.0: "start: put it down", 5.5: "stop: failure", 6.0: "stop", 7.0: "start",
    }  # fmt: skip
    for time, text in texts.items():
        recording.add("/episode", "std_msgs/msg/String", time, {"data": text}, headed=False, delay_s=0.002)
    recording.in_log_order().write(tmp_path / "raw" / "a.mcap")
    declared = toy.declared(tmp_path / "raw", episodes={"by": "markers", "topic": "/episode"})
    counts, _ = run(tmp_path, declared)
    assert (counts["found"], counts["kept"], counts["reasons"]) == (5, 2, {"missing_marker": 3})
    first, second = (load(declared, f"toy-a-000{number}").episode for number in (0, 2))
    assert (first.instruction, first.outcome) == ("pick the cup", "success")
    assert (second.instruction, second.outcome) == ("put it down", "failure")
    assert first.num_frames == pytest.approx(60, abs=1)
    assert second.num_frames == pytest.approx(45, abs=1)
    for episode in ("toy-a-0001", "toy-a-0003", "toy-a-0004"):
        assert rejection(declared, episode).reason == "missing_marker"
    elsewhere = toy.declared(tmp_path / "raw", episodes={"by": "markers", "topic": "/marks"})
    assert source(elsewhere).episode_ids() == ["toy-a"]
    assert rejection(elsewhere).reason == "missing_topic"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"arms": [], "embodiment": "so101"}, "the arms of so101 are not declared"),
        ({"primary_view": "top"}, "primary_view top is none of head, right_wrist"),
        ({"transforms": ["/joint_states"]}, "declared both as readings and as transforms"),
    ],
)
def test_the_configuration_is_strict(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        source(toy.declared(tmp_path, **changes))
