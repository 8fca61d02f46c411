"""ROS 2 recordings: known functions of time come back at the instants, with the errors that resampling really makes."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.sources.open import open_source
from worldline_core.errors import DataError


def load(declared: dict[str, Any], episode: str = "toy-a") -> LoadedEpisode:
    config = CurateConfig.model_validate({"sources": [declared]}).sources[0]
    return open_source(config, config.path).load(episode)


def rejection(declared: dict[str, Any], episode: str = "toy-a") -> RejectedInputError:
    with pytest.raises(RejectedInputError, match=r"\S") as caught:
        loaded = load(declared, episode)
        for view in loaded.views:
            loaded.frames(view)
    return caught.value


def test_known_functions_of_time_come_back(tmp_path: Path, toy: Any) -> None:
    toy.robot().write(tmp_path / "a.mcap")
    loaded = load(toy.declared(tmp_path))
    episode = loaded.episode
    time = episode.timestamps
    assert np.allclose(time, np.arange(90) / 30, atol=1e-8)
    # Linear between readings 10 ms (state) and 20 ms (command) apart: h^2 / 8 times the second derivative.
    assert np.abs(episode.state[:, :2] - toy.joints(time)).max() < 0.01**2 / 8 * 0.5 + 1e-7
    assert np.abs(episode.action[:, :2] - toy.joints(time) - 0.01).max() < 0.02**2 / 8 * 0.5 + 1e-5
    assert np.abs(episode.state[:, 2] - toy.finger(time) / 0.04).max() < 1e-5
    assert episode.state_names == ("right/a", "right/b", "right/gripper")
    for view in ("head", "right_wrist"):
        assert np.array_equal(toy.number_of(loaded.frames(view)), np.arange(90))
    head, wrist = episode.cameras["head"], episode.cameras["right_wrist"]
    assert not head.moving
    assert np.allclose(head.T_base_camera[0], [[1, 0, 0, 1], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]])
    for i in (0, 17, 89):
        place, (_, _, sine, cosine) = toy.wrist(time[i])
        angle = 2 * np.arctan2(sine, cosine)
        expected = np.eye(4)
        expected[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        expected[:3, 3] = place + np.array([0, 0, 0.1])
        assert np.abs(wrist.T_base_camera[i] - expected).max() < 1e-6  # place and angle are linear: nothing is lost
    assert np.array_equal(head.K, [[20, 0, 7.5], [0, 21, 5.5], [0, 0, 1]])


def test_the_error_of_resampling_is_measured(tmp_path: Path, toy: Any) -> None:
    recording = toy.robot(jitter_s=0.004, seed=3)
    recording.write(tmp_path / "a.mcap")
    loaded = load(toy.declared(tmp_path))
    # Counted again here, from the times that were sent; pictures were numbered in order of time.
    times = {
        topic: np.sort([sent.time_ns or sent.log_ns - 2_000_000 for sent in recording.sent if sent.topic == topic])
        for topic in ("/head/image/compressed", "/wrist/image/compressed", "/joint_states", "/command", "/tf")
    }
    numbers = {view: toy.number_of(loaded.frames(view)) for view in loaded.views}
    begin = times["/head/image/compressed"][numbers["head"][0]]
    grid = begin + np.round(np.arange(loaded.episode.num_frames) * 1e9 / 30).astype(np.int64)
    distances = {topic: np.abs(sent[None] - grid[:, None]) for topic, sent in times.items()}
    for view, topic in (("head", "/head/image/compressed"), ("right_wrist", "/wrist/image/compressed")):
        assert np.array_equal(numbers[view], distances[topic].argmin(axis=1))
    largest = max(distance.min(axis=1).max() for distance in distances.values()) / 1e6
    assert loaded.episode.conventions["resampling_max_ms"] == pytest.approx(largest, abs=1e-5)


def test_messages_out_of_order_are_sorted_and_those_sent_twice_count_once(tmp_path: Path, toy: Any) -> None:
    recording = toy.robot()
    recording.change("/wrist/image/compressed", lambda sent: [each for s in sent for each in (s, s)])
    for topic in ("/head/image/compressed", "/joint_states"):
        recording.change(topic, lambda sent: [sent[i ^ 1] if i ^ 1 < len(sent) else sent[i] for i in range(len(sent))])
    recording.write(tmp_path / "a.mcap")
    loaded = load(toy.declared(tmp_path))
    for view in loaded.views:
        assert np.array_equal(toy.number_of(loaded.frames(view)), np.arange(90))
    assert np.abs(loaded.episode.state[:, :2] - toy.joints(loaded.episode.timestamps)).max() < 1e-5


@pytest.mark.parametrize(("topic", "lost"), [("/head/image/compressed", 2), ("/joint_states", 15)])
def test_a_few_lost_messages_are_counted_and_bridged(tmp_path: Path, toy: Any, topic: str, lost: int) -> None:
    recording = toy.robot()
    recording.change(topic, lambda sent: sent[:40] + sent[40 + lost :])
    recording.write(tmp_path / "a.mcap")
    loaded = load(toy.declared(tmp_path))
    if topic.endswith("compressed"):
        assert toy.number_of(loaded.frames("head"))[38:44].tolist() == [38, 39, 39, 42, 42, 43]
    else:
        assert np.abs(loaded.episode.state[:, :2] - toy.joints(loaded.episode.timestamps)).max() < 0.02


@pytest.mark.parametrize(
    ("topic", "keep", "what"),
    [
        ("/head/image/compressed", lambda sent: sent[:40] + sent[45:], "Images are missing"),
        ("/joint_states", lambda sent: sent[:100] + sent[125:], "Messages are missing"),
        ("/command", lambda sent: sent[:50] + sent[70:], "Messages are missing"),
        ("/tf", lambda sent: sent[:50] + sent[70:], "Messages are missing"),
        ("/wrist/image/compressed", lambda sent: sent[:40], "Topic ends too early"),
        ("/joint_states", lambda sent: sent[150:], "Topic begins too late"),
    ],
)
def test_gaps_are_refused(tmp_path: Path, toy: Any, topic: str, keep: Any, what: str) -> None:
    recording = toy.robot()
    recording.change(topic, keep)
    recording.write(tmp_path / "a.mcap")
    error = rejection(toy.declared(tmp_path))
    assert (error.reason, error.what) == ("time_gap", what)
    assert topic in str(error) or topic == "/tf"
    gap = float(error.evidence["gap_s"])
    # 5 images of 33 ms, 25 readings of 10 ms, 20 commands or transforms of 20 ms are missing; 40 of 90 images; 1.5 of 3 s.
    expected = {"Images are missing": 0.2, "Topic ends too early": 1.66, "Topic begins too late": 1.5}
    assert gap == pytest.approx(expected.get(what, 0.26 if topic == "/joint_states" else 0.42), abs=0.04)


def test_clocks_that_disagree_are_measured_corrected_or_refused(tmp_path: Path, toy: Any) -> None:
    recording = toy.robot()
    topic = "/wrist/image/compressed"
    recording.change(topic, lambda sent: [toy.shifted(each, 0.5) for each in sent])
    recording.write(tmp_path / "a.mcap")
    error = rejection(toy.declared(tmp_path))
    assert error.reason == "clock_skew"
    assert error.evidence["skew_ms"] == pytest.approx(500)  # the head camera's images take 20 ms too
    repaired = load(toy.declared(tmp_path, time_offsets_ms={topic: -500.0}))
    assert np.array_equal(toy.number_of(repaired.frames("right_wrist")), np.arange(90))
    wrong = load(toy.declared(tmp_path, max_clock_skew_ms=600))  # believed: the images are half a second off
    assert toy.number_of(wrong.frames("right_wrist"))[0] - toy.number_of(wrong.frames("head"))[0] == -15
    by_log = load(toy.declared(tmp_path, time="log"))
    assert np.array_equal(toy.number_of(by_log.frames("right_wrist")), toy.number_of(by_log.frames("head")))


def test_a_simulated_clock_is_met_by_topics_without_one(tmp_path: Path, toy: Any) -> None:
    """Header times count from zero, log times are of the wall: commands have only the latter."""
    recording = toy.robot()
    for topic in ("/head/image/compressed", "/wrist/image/compressed", "/joint_states"):
        recording.change(topic, lambda sent: [toy.shifted(each, -toy.START_NS / 1e9 + 100) for each in sent])
    no_wrist = toy.declared(tmp_path)
    del no_wrist["views"]["right_wrist"]["calibration"]
    recording.write(tmp_path / "a.mcap")
    loaded = load(no_wrist)
    time = loaded.episode.timestamps
    assert np.abs(loaded.episode.action[:, :2] - toy.joints(time) - 0.01).max() < 1e-4


def test_a_clock_set_back_is_refused(tmp_path: Path, toy: Any) -> None:
    recording = toy.robot(4.0)
    recording.change("/joint_states", lambda sent: sent[:300] + [toy.shifted(each, -2.5) for each in sent[300:]])
    recording.write(tmp_path / "a.mcap")
    error = rejection(toy.declared(tmp_path, max_clock_skew_ms=5000))
    assert (error.reason, error.evidence["message"]) == ("clock_jump", 300)
    assert error.evidence["jump_s"] == pytest.approx(2.49)


def test_missing_header_times_are_not_taken_for_times(tmp_path: Path, toy: Any) -> None:
    recording = toy.robot()
    recording.change("/joint_states", lambda sent: [toy.shifted(each, 0, at_ns=0) for each in sent])
    recording.write(tmp_path / "a.mcap")
    with pytest.raises(DataError, match=r"(?s)no header time.*0 in 300 of 300.*time: log"):
        load(toy.declared(tmp_path))


@pytest.mark.parametrize(
    ("joint", "value", "seconds", "kept"),
    [(2, np.nan, 1.0, False), (1, np.inf, 1.51, False), (0, np.nan, 2.0, False), (2, np.nan, 9.0, True)],
)
def test_readings_between_the_frames_are_finite_too(
    tmp_path: Path, toy: Any, joint: int, value: float, seconds: float, kept: bool
) -> None:
    def change(sent: list[Any]) -> list[Any]:
        number = min(int(seconds * 100), len(sent) - 1)
        position = [value if i == joint else each for i, each in enumerate(sent[number].message["position"])]
        sent[number] = replace(sent[number], message={**sent[number].message, "position": position})
        return sent

    recording = toy.robot()
    recording.change("/joint_states", change)
    recording.write(tmp_path / "a.mcap")
    if kept:  # after the last frame's neighbours
        assert np.isfinite(load(toy.declared(tmp_path, fps=10)).episode.state).all()
        return
    error = rejection(toy.declared(tmp_path))
    assert error.reason == "nan_state"
    assert error.evidence["at_s"] == pytest.approx(seconds, abs=0.02)


def test_a_slow_camera_is_refused(tmp_path: Path, toy: Any) -> None:
    toy.robot(camera_fps=15).write(tmp_path / "a.mcap")
    error = rejection(toy.declared(tmp_path))
    assert (error.reason, error.evidence["measured_fps"]) == ("wrong_fps", pytest.approx(15))
    loaded = load(toy.declared(tmp_path, fps=7.5))
    assert np.array_equal(toy.number_of(loaded.frames("head")), np.arange(0, 45, 2))


def test_commands_hold_or_are_declared_missing(tmp_path: Path, toy: Any) -> None:
    toy.robot().write(tmp_path / "a.mcap")
    declared = toy.declared(tmp_path)
    arm = declared["arms"][0]
    for readings in arm["command"].values():
        readings["resample"] = "hold"
    held = load(declared).episode
    last = np.floor(held.timestamps * 50 + 1e-6) / 50
    assert np.abs(held.action[:, :2] - toy.joints(last) - 0.01).max() < 1e-6
    del arm["command"]
    with pytest.raises(ValueError, match="give their topics, or say without_commands"):
        load(declared)
    repeated = load({**declared, "without_commands": "repeat_state"}).episode
    assert np.array_equal(repeated.action, repeated.state)
    assert str(repeated.conventions["action"]).startswith("repeats the state")


def test_degrees_and_tool_poses(tmp_path: Path, toy: Any) -> None:
    recording = toy.robot()
    for number in range(150):
        time = number / 50
        place, quaternion = toy.wrist(time)
        pose = {
            "position": dict(zip("xyz", (place + np.array([0, 0, 0.2])).tolist(), strict=True)),
            "orientation": dict(zip("xyzw", quaternion.tolist(), strict=True)),
        }
        recording.add("/tool", "geometry_msgs/msg/PoseStamped", time, {"pose": pose}, frame="base_link")
    static = toy.transform("wrist", "tool", 0.0, [0.0, 0.0, 0.2], [0.0, 0.0, 0.0, 1.0])
    recording.add("/tf_static", "tf2_msgs/msg/TFMessage", 0.0, {"transforms": [static]}, headed=False)
    recording.in_log_order().write(tmp_path / "a.mcap")
    declared = toy.declared(tmp_path)
    declared["arms"][0]["state"]["joints"]["unit"] = "deg"
    by_topic, by_frame = (
        load({**declared, "arms": [{**declared["arms"][0], **choice}]}).episode
        for choice in ({"tool_pose": "/tool"}, {"tool_frame": "tool"})
    )
    assert by_topic.T_base_ee is not None and by_frame.T_base_ee is not None
    assert by_topic.T_base_ee.shape == (90, 1, 4, 4)
    assert np.abs(by_topic.T_base_ee - by_frame.T_base_ee).max() < 1e-9
    assert by_topic.T_base_ee[30, 0, :3, 3] == pytest.approx([0.3 + 0.05 * 1.0, 0.1, 0.6])
    assert np.array_equal(by_topic.gripper[:, 0].astype(np.float32), by_topic.state[:, 2])
    assert np.abs(np.rad2deg(by_topic.state[:, :2]) - toy.joints(by_topic.timestamps)).max() < 1e-4


def test_binning_region_rectification_and_lens(tmp_path: Path, toy: Any) -> None:
    def with_info(**changes: Any) -> Any:
        recording = toy.robot()
        for view in ("head", "wrist"):
            recording.change(
                f"/{view}/camera_info",
                lambda sent: [replace(s, message={**s.message, **changes}) for s in sent],
            )
        recording.write(tmp_path / "a.mcap")
        return load(toy.declared(tmp_path))

    region = {"x_offset": 4, "y_offset": 6, "height": 24, "width": 32, "do_rectify": False}
    binned = with_info(height=48, width=64, binning_x=2, binning_y=2, roi=region).episode.cameras["head"]
    assert (binned.height, binned.width) == (12, 16)
    # A point at full-resolution pixel (u, v) lands at ((u - 4 + 0.5) / 2 - 0.5, (v - 6 + 0.5) / 2 - 0.5).
    assert np.allclose(binned.K, [[10, 0, (7.5 - 4 + 0.5) / 2 - 0.5], [0, 10.5, (5.5 - 6 + 0.5) / 2 - 0.5], [0, 0, 1]])
    P = [18.0, 0, 7.0, 0, 0, 18.0, 5.0, 0, 0, 0, 1, 0]
    lens = {"d": [-0.1, 0.01, 0.0, 0.0, 0.0], "p": P}
    bent = with_info(**lens)
    assert str(bent.episode.conventions["undistorted"]).startswith("head: radtan [-0.1")
    toy_declared = toy.declared(tmp_path)
    for view in toy_declared["views"].values():
        view["rectified"] = True
    straight = load(toy_declared).episode
    assert np.array_equal(straight.cameras["head"].K, [[18, 0, 7], [0, 18, 5], [0, 0, 1]])
    assert "undistorted" not in straight.conventions
    with pytest.raises(RejectedInputError, match="Calibration belongs to another image size"):
        with_info(height=24, width=32).frames("head")


def test_images_are_read_one_by_one(tmp_path: Path, toy: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Decoded lazily and in order: asking for five frames decodes five."""
    import worldline_core.data.mcap.file as images

    toy.robot().write(tmp_path / "a.mcap")
    loaded = load(toy.declared(tmp_path))
    decoded = []
    original = images.decode_image
    monkeypatch.setattr(images, "decode_image", lambda *a, **k: decoded.append(1) or original(*a, **k))
    frames = loaded.images("head")
    first = [next(frames) for _ in range(5)]
    assert len(decoded) == 5
    assert toy.number_of(np.stack(first)).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8", "mono8", "16UC1"])
def test_raw_images_of_every_encoding(tmp_path: Path, toy: Any, encoding: str) -> None:
    expected = toy.picture(7)
    channels = {"bgr8": [2, 1, 0], "rgba8": [0, 1, 2, 0], "bgra8": [2, 1, 0, 0], "mono8": [0]}.get(encoding, [0, 1, 2])
    padded = np.pad(expected[..., channels].reshape(12, -1), ((0, 0), (0, 5)))  # rows may be longer than the image
    size = {"height": 12, "width": 16, "encoding": encoding, "is_bigendian": 0, "step": padded.shape[1]}

    def as_raw(sent: Any) -> Any:
        message = {"header": sent.message["header"], **size, "data": padded.tobytes()}
        return replace(sent, schema="sensor_msgs/msg/Image", message=message)

    recording = toy.robot(0.5)
    recording.change("/head/image/compressed", lambda sent: map(as_raw, sent))
    recording.write(tmp_path / "a.mcap")
    loaded = load(toy.declared(tmp_path))
    if encoding == "16UC1":
        with pytest.raises(RejectedInputError, match=r"(?s)Images are depth.*rgb8.*16UC1.*colour images"):
            loaded.frames("head")
    else:
        wanted = np.repeat(expected[..., :1], 3, -1) if encoding == "mono8" else expected
        assert np.array_equal(loaded.frames("head")[3], wanted)


@pytest.mark.parametrize(
    ("data_format", "header", "bits"),
    [
        ("16UC1; png compressed ", b"", 16),
        ("16UC1; compressedDepth png", bytes(12), 16),
        ("32FC1; compressedDepth", bytes(12), 16),
        ("16UC1; compressedDepth rvl", bytes(12), 0),
        ("png", b"", 16),  # the format says nothing, the picture does
        ("png", bytes(12), 16),
        ("16UC1; jpeg compressed", b"", 8),
    ],
)
def test_depth_in_compressed_images_is_refused_by_name(
    tmp_path: Path, toy: Any, data_format: str, header: bytes, bits: int
) -> None:
    depth = np.arange(12 * 16).reshape(12, 16) * 20
    content = header + bytes(64)
    if bits:
        content = header + cv2.imencode(".png", depth.astype(np.uint16 if bits == 16 else np.uint8))[1].tobytes()
    recording = toy.robot(0.5)
    message = {"format": data_format, "data": content}
    recording.change(
        "/head/image/compressed", lambda sent: [replace(s, message={**s.message, **message}) for s in sent]
    )
    recording.write(tmp_path / "a.mcap")
    error = rejection(toy.declared(tmp_path))
    assert (error.reason, "depth" in error.what) == ("unknown_schema", True)
    assert "colour images" in str(error) and "/head/image/compressed" in str(error)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"k": [0.0] * 9, "p": [0.0] * 12}, "K is all zeros"),
        ({"height": 0, "width": 0}, "image size is 0x0"),
        ({"k": [0.0] * 9, "height": 0, "width": 0, "distortion_model": "", "d": []}, "K is all zeros"),
        ({"distortion_model": "equidistant", "d": [0.0] * 4}, "D of a equidistant lens is all zeros"),
        ({"distortion_model": "Inverse Brown Conrady"}, None),
        ({"distortion_model": "rational_polynomial", "d": [0.0] * 14}, None),
        ({"distortion_model": "", "d": [0.0] * 5}, None),
        ({"distortion_model": "plumb_bob", "d": [0.0] * 12}, None),
    ],
)
def test_an_empty_calibration_costs_the_view_its_camera_only(
    tmp_path: Path, toy: Any, changes: dict[str, Any], why: str | None
) -> None:
    recording = toy.robot(0.5)
    recording.change("/head/camera_info", lambda sent: [replace(s, message={**s.message, **changes}) for s in sent])
    if why is not None:  # nor is its frame needed
        recording.change("/tf_static", lambda sent: [
            replace(s, message={"transforms": s.message["transforms"][1:]}) for s in sent
        ])  # fmt: skip
    recording.write(tmp_path / "a.mcap")
    loaded = load(toy.declared(tmp_path))
    assert loaded.views == ("head", "right_wrist")
    assert set(loaded.episode.cameras) == ({"right_wrist"} if why else {"head", "right_wrist"})
    assert why is None or f"head: {'' if why[0] in 'KD' else 'its '}{why}" == loaded.episode.conventions["uncalibrated"]
    assert ("uncalibrated" in loaded.episode.conventions) is (why is not None)
    assert not loaded.distortions
    assert np.array_equal(toy.number_of(loaded.frames("head")), np.arange(loaded.episode.num_frames))


def test_turned_stills_of_a_camera_are_refused(tmp_path: Path, toy: Any) -> None:
    buffer, exif = io.BytesIO(), Image.Exif()
    exif[0x0112] = 3
    Image.fromarray(toy.picture(7)).save(buffer, "JPEG", exif=exif)
    recording = toy.robot(1.0)
    recording.change(
        "/head/image/compressed",
        lambda sent: (replace(s, message={**s.message, "format": "jpeg", "data": buffer.getvalue()}) for s in sent),
    )
    recording.write(tmp_path / "a.mcap")
    error = rejection(toy.declared(tmp_path))
    assert (error.reason, "orientation 3" in str(error)) == ("missing_calibration", True)


def zeroed(sent: Any) -> Any:
    """The message of a second publisher, which has heard nothing yet."""
    key = "position" if "position" in sent.message else "data"
    return replace(sent, message={**sent.message, key: [0.0] * len(sent.message[key])})


@pytest.mark.parametrize(
    ("topic", "among", "what"),
    [
        ("/joint_states", lambda sent, toy: [x for s in sent for x in (s, zeroed(s))], "Messages of one time"),
        ("/joint_states", lambda sent, toy: [x for s in sent for x in (s, toy.shifted(zeroed(s), 0.005))], "to and fro"),
        ("/joint_states", lambda sent, toy: [zeroed(s) if i % 4 == 1 else s for i, s in enumerate(sent)], "to and fro"),
        ("/joint_states", lambda sent, toy: [zeroed(s) if i % 4 > 1 else s for i, s in enumerate(sent)], "to and fro"),
        ("/command", lambda sent, toy: [zeroed(s) if i % 2 else s for i, s in enumerate(sent)], "to and fro"),
        ("/command", lambda sent, toy: [zeroed(s) if i % 9 == 3 else s for i, s in enumerate(sent)], "to and fro"),
        ("/joint_states", lambda sent, toy: [
            replace(s, message={**s.message, "position": [0.0, 0.0, 2.0]}) if i == 150 else s for i, s in enumerate(sent)
        ], "cannot be interpolated"),
    ],
)  # fmt: skip
def test_two_publishers_of_one_topic_are_refused(tmp_path: Path, toy: Any, topic: str, among: Any, what: str) -> None:
    recording = toy.robot()
    recording.change(topic, lambda sent: among(sent, toy))
    recording.write(tmp_path / "a.mcap")
    error = rejection(toy.declared(tmp_path))
    assert (error.reason, what in error.what) == ("conflicting_messages", True), str(error)
    assert topic in str(error)


def test_two_publishers_of_one_transform_are_refused(tmp_path: Path, toy: Any) -> None:
    recording = toy.robot()

    def stale(sent: Any) -> Any:
        (transform,) = sent.message["transforms"]
        return replace(sent, message={"transforms": [{**transform, "transform": first}]})

    first = next(s for s in recording.sent if s.topic == "/tf").message["transforms"][0]["transform"]
    recording.change("/tf", lambda sent: [stale(s) if i % 2 else s for i, s in enumerate(sent)])
    recording.write(tmp_path / "a.mcap")
    error = rejection(toy.declared(tmp_path))
    assert (error.reason, "base_link -> wrist" in str(error)) == ("conflicting_messages", True)


def test_one_publisher_is_not_taken_for_two(tmp_path: Path, toy: Any) -> None:
    """Noise, repeated messages, commands that step, and grippers that are switched."""
    rng = np.random.default_rng(2)

    def noisy(sent: Any) -> Any:
        position = (np.array(sent.message["position"]) + rng.normal(0, 0.002, 3)).tolist()
        return replace(sent, message={**sent.message, "position": position})

    recording = toy.robot()
    recording.change("/joint_states", lambda sent: [x for s in map(noisy, sent) for x in (s, s)])
    steps = [[0.6 * (i // 25 % 2), 0.1, 0.04 * (i // 10 % 2)] for i in range(150)]
    recording.change(
        "/command",
        lambda sent: [replace(s, message={**s.message, "data": d}) for s, d in zip(sent, steps, strict=True)],
    )
    recording.write(tmp_path / "a.mcap")
    assert load(toy.declared(tmp_path)).episode.num_frames == 90


@pytest.mark.parametrize(
    "topics", [("/tf",), ("/head/image/compressed",), ("/joint_states", "/wrist/image/compressed")]
)
def test_stamps_of_zero_name_their_topics(tmp_path: Path, toy: Any, topics: tuple[str, ...]) -> None:
    def unstamped(sent: Any) -> Any:
        if sent.topic != "/tf":
            return toy.shifted(sent, 0, at_ns=0)
        (transform,) = sent.message["transforms"]
        header = {**transform["header"], "stamp": {"sec": 0, "nanosec": 0}}
        return replace(sent, message={"transforms": [{**transform, "header": header}]})

    recording = toy.robot()
    for topic in topics:
        recording.change(topic, lambda sent: map(unstamped, sent))
    recording.write(tmp_path / "a.mcap")
    error = rejection(toy.declared(tmp_path))
    assert (error.reason, error.what) == ("clock_skew", "Messages have no header time")
    assert all(topic in str(error.where) for topic in topics)
    assert "set time: log" in str(error)
