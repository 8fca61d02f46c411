"""ROS 2 recordings: known functions of time come back at the instants, with the errors that resampling really makes."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.mcap import conftest as toy
from tests.mcap.conftest import Sent, load, rejection, robot
from worldline_core.data.guards.rejection import RejectedInputError

HEAD, WRIST, STATES = "/head/image/compressed", "/wrist/image/compressed", "/joint_states"
Change = Callable[[list[Sent]], Iterable[Sent]]


def changed(folder: Path, changes: dict[str, Change], **options: Any) -> dict[str, Any]:
    """Write the robot's recording with other messages of some topics; returns the source's configuration."""
    recording = robot(**options)
    for topic, change in changes.items():
        recording.change(topic, change)
    recording.write(folder / "a.mcap")
    return toy.declared(folder)


def numbers(loaded: Any, view: str = "head") -> list[int]:
    return toy.number_of(loaded.frames(view)).tolist()


def test_known_functions_of_time_come_back(tmp_path: Path) -> None:
    loaded = load(changed(tmp_path, {}))
    episode, time = loaded.episode, loaded.episode.timestamps
    assert np.allclose(time, np.arange(90) / 30, atol=1e-8)
    # Linear between readings 10 ms (state) and 20 ms (command) apart: h^2 / 8 times the second derivative.
    assert np.abs(episode.state[:, :2] - toy.joints(time)).max() < 0.01**2 / 8 * 0.5 + 1e-7
    assert np.abs(episode.action[:, :2] - toy.joints(time) - 0.01).max() < 0.02**2 / 8 * 0.5 + 1e-5
    assert np.abs(episode.state[:, 2] - toy.finger(time) / 0.04).max() < 1e-5
    assert episode.state_names == ("right/a", "right/b", "right/gripper")
    for view in ("head", "right_wrist"):
        assert numbers(loaded, view) == list(range(90))
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


def test_a_calibration_file_takes_the_place_of_a_topic(tmp_path: Path) -> None:
    source, T = changed(tmp_path, {}), np.diag([1.0, -1.0, -1.0, 1.0])
    entry = {"width": 16, "height": 12, "K": [[9, 0, 7.5], [0, 9, 5.5], [0, 0, 1]]}
    entry |= {"maps": "camera_to_base", "axes": "opencv", "T": T.tolist()}
    (tmp_path / "cameras.json").write_text(json.dumps({"views": {"head": entry}}))
    cameras = load(source | {"calibration": "cameras.json"}).episode.cameras
    assert np.array_equal(cameras["head"].K, entry["K"])
    assert np.allclose(cameras["head"].T_base_camera, T[None])
    assert cameras["right_wrist"].moving  # by its topic, as before


def test_messages_out_of_order_are_sorted_and_those_sent_twice_count_once(tmp_path: Path) -> None:
    def swapped(sent: list[Sent]) -> list[Sent]:
        return [sent[i ^ 1] if i ^ 1 < len(sent) else sent[i] for i in range(len(sent))]

    twice = lambda sent: [each for s in sent for each in (s, s)]  # noqa: E731
    loaded = load(changed(tmp_path, {WRIST: twice, HEAD: swapped, STATES: swapped}))
    for view in loaded.views:
        assert numbers(loaded, view) == list(range(90))
    assert np.abs(loaded.episode.state[:, :2] - toy.joints(loaded.episode.timestamps)).max() < 1e-5


def test_a_few_lost_messages_are_counted_and_bridged(tmp_path: Path) -> None:
    lost = {HEAD: lambda sent: sent[:40] + sent[42:], STATES: lambda sent: sent[:40] + sent[55:]}
    loaded = load(changed(tmp_path, lost))
    assert numbers(loaded)[38:44] == [38, 39, 39, 42, 42, 43]
    assert np.abs(loaded.episode.state[:, :2] - toy.joints(loaded.episode.timestamps)).max() < 0.02


def test_clocks_that_disagree_are_measured_corrected_or_refused(tmp_path: Path) -> None:
    declared = changed(tmp_path, {WRIST: lambda sent: [toy.shifted(each, 0.5) for each in sent]})
    error = rejection(declared)
    assert error.reason == "clock_skew"
    assert error.evidence["skew_ms"] == pytest.approx(500)  # the head camera's images take 20 ms too
    assert numbers(load(declared | {"time_offsets_ms": {WRIST: -500.0}}), "right_wrist") == list(range(90))
    wrong = load(declared | {"max_clock_skew_ms": 600})  # believed: the images are half a second off
    assert numbers(wrong, "right_wrist")[0] - numbers(wrong)[0] == -15
    by_log = load(declared | {"time": "log"})
    assert numbers(by_log, "right_wrist") == numbers(by_log)


def test_a_simulated_clock_is_met_by_topics_without_one(tmp_path: Path) -> None:
    """Header times count from zero, log times are of the wall: commands have only the latter."""
    simulated = lambda sent: [toy.shifted(each, -toy.START_NS / 1e9 + 100) for each in sent]  # noqa: E731
    no_wrist = changed(tmp_path, dict.fromkeys((HEAD, WRIST, STATES), simulated))
    del no_wrist["views"]["right_wrist"]["calibration"]
    episode = load(no_wrist).episode
    assert np.abs(episode.action[:, :2] - toy.joints(episode.timestamps) - 0.01).max() < 1e-4


def test_a_clock_set_back_is_refused(tmp_path: Path) -> None:
    back = {STATES: lambda sent: sent[:300] + [toy.shifted(each, -2.5) for each in sent[300:]]}
    error = rejection(changed(tmp_path, back, seconds=4.0) | {"max_clock_skew_ms": 5000})
    assert (error.reason, error.evidence["message"]) == ("clock_jump", 300)
    assert error.evidence["jump_s"] == pytest.approx(2.49)


@pytest.mark.parametrize("topics", [("/tf",), (HEAD,), (STATES,), (STATES, WRIST)])
def test_stamps_of_zero_are_not_taken_for_times(tmp_path: Path, topics: tuple[str, ...]) -> None:
    def unstamped(sent: Sent) -> Sent:
        if sent.topic != "/tf":
            return toy.shifted(sent, 0, at_ns=0)
        (transform,) = sent.message["transforms"]
        unset = toy.header(0, transform["header"]["frame_id"])
        return replace(sent, message={"transforms": [{**transform, "header": unset}]})

    error = rejection(changed(tmp_path, dict.fromkeys(topics, lambda sent: map(unstamped, sent))))
    assert (error.reason, error.what) == ("clock_skew", "Messages have no header time")
    assert all(topic in str(error.where) for topic in topics)
    assert "set time: log" in str(error)


def test_a_slow_camera_is_refused(tmp_path: Path) -> None:
    declared = changed(tmp_path, {}, camera_fps=15)
    error = rejection(declared)
    assert (error.reason, error.evidence["measured_fps"]) == ("wrong_fps", pytest.approx(15))
    assert numbers(load(declared | {"fps": 7.5})) == list(range(0, 45, 2))


def test_commands_hold_or_are_declared_missing(tmp_path: Path) -> None:
    declared = changed(tmp_path, {})
    (arm,) = declared["arms"]
    for readings in arm["command"].values():
        readings["resample"] = "hold"
    held = load(declared).episode
    last = np.floor(held.timestamps * 50 + 1e-6) / 50
    assert np.abs(held.action[:, :2] - toy.joints(last) - 0.01).max() < 1e-6
    del arm["command"]
    with pytest.raises(ValueError, match="without_commands"):
        load(declared)
    repeated = load(declared | {"without_commands": "repeat_state"}).episode
    assert np.array_equal(repeated.action, repeated.state)
    assert str(repeated.conventions["action"]).startswith("repeats the state")


def test_degrees_and_tool_poses(tmp_path: Path) -> None:
    recording = robot()
    for number in range(150):
        place, quaternion = toy.wrist(number / 50)
        pose = {
            "position": dict(zip("xyz", (place + np.array([0, 0, 0.2])).tolist(), strict=True)),
            "orientation": dict(zip("xyzw", quaternion.tolist(), strict=True)),
        }
        recording.add("/tool", "geometry_msgs/msg/PoseStamped", number / 50, {"pose": pose}, frame="base_link")
    recording.transforms(0.0, toy.transform("wrist", "tool", 0.0, [0.0, 0.0, 0.2], [0.0, 0.0, 0.0, 1.0]))
    recording.in_log_order().write(tmp_path / "a.mcap")
    declared = toy.declared(tmp_path)
    (arm,) = declared["arms"]
    arm["state"]["joints"]["unit"] = "deg"
    by_topic, by_frame = (
        load(declared | {"arms": [arm | choice]}).episode for choice in ({"tool_pose": "/tool"}, {"tool_frame": "tool"})
    )
    assert by_topic.T_base_ee is not None and by_frame.T_base_ee is not None
    assert by_topic.T_base_ee.shape == (90, 1, 4, 4)
    assert np.abs(by_topic.T_base_ee - by_frame.T_base_ee).max() < 1e-9
    assert by_topic.T_base_ee[30, 0, :3, 3] == pytest.approx([0.3 + 0.05 * 1.0, 0.1, 0.6])
    assert np.array_equal(by_topic.gripper[:, 0].astype(np.float32), by_topic.state[:, 2])
    assert np.abs(np.rad2deg(by_topic.state[:, :2]) - toy.joints(by_topic.timestamps)).max() < 1e-4


def test_binning_region_rectification_and_lens(tmp_path: Path) -> None:
    def with_info(**changes: Any) -> dict[str, Any]:
        recording = robot(0.5)
        for view in ("head", "wrist"):
            recording.rewrite(f"/{view}/camera_info", **changes)
        recording.write(tmp_path / "a.mcap")
        return toy.declared(tmp_path)

    region = {"x_offset": 4, "y_offset": 6, "height": 24, "width": 32, "do_rectify": False}
    binned = load(with_info(height=48, width=64, binning_x=2, binning_y=2, roi=region)).episode.cameras["head"]
    assert (binned.height, binned.width) == (12, 16)
    # A point at full-resolution pixel (u, v) lands at ((u - 4 + 0.5) / 2 - 0.5, (v - 6 + 0.5) / 2 - 0.5).
    assert np.allclose(binned.K, [[10, 0, (7.5 - 4 + 0.5) / 2 - 0.5], [0, 10.5, (5.5 - 6 + 0.5) / 2 - 0.5], [0, 0, 1]])
    bent = with_info(d=[-0.1, 0.01, 0.0, 0.0, 0.0], p=[18.0, 0, 7.0, 0, 0, 18.0, 5.0, 0, 0, 0, 1, 0])
    assert str(load(bent).episode.conventions["undistorted"]).startswith("head: radtan [-0.1")
    for view in bent["views"].values():
        view["rectified"] = True
    straight = load(bent).episode
    assert np.array_equal(straight.cameras["head"].K, [[18, 0, 7], [0, 18, 5], [0, 0, 1]])
    assert "undistorted" not in straight.conventions
    assert "another image size" in rejection(with_info(height=24, width=32)).what


def test_images_are_read_one_by_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Decoded lazily and in order: asking for five frames decodes five."""
    import worldline_core.data.mcap.file as images

    loaded, decoded, original = load(changed(tmp_path, {})), [], images.decode_image
    monkeypatch.setattr(images, "decode_image", lambda *a, **k: decoded.append(1) or original(*a, **k))
    frames = loaded.images("head")
    assert toy.number_of(np.stack([next(frames) for _ in range(5)])).tolist() == [0, 1, 2, 3, 4]
    assert len(decoded) == 5


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8", "mono8", "16UC1"])
def test_raw_images_of_every_encoding(tmp_path: Path, encoding: str) -> None:
    expected = toy.picture(7)
    channels = {"bgr8": [2, 1, 0], "rgba8": [0, 1, 2, 0], "bgra8": [2, 1, 0, 0], "mono8": [0]}.get(encoding, [0, 1, 2])
    padded = np.pad(expected[..., channels].reshape(12, -1), ((0, 0), (0, 5)))  # rows may be longer than the image
    raw = {"height": 12, "width": 16, "encoding": encoding, "is_bigendian": 0, "step": padded.shape[1]}

    def as_raw(sent: Sent) -> Sent:
        message = {"header": sent.message["header"], **raw, "data": padded.tobytes()}
        return replace(sent, schema="sensor_msgs/msg/Image", message=message)

    loaded = load(changed(tmp_path, {HEAD: lambda sent: map(as_raw, sent)}, seconds=0.5))
    if encoding == "16UC1":
        with pytest.raises(RejectedInputError, match=r"(?s)depth.*16UC1"):
            loaded.frames("head")
    else:
        wanted = np.repeat(expected[..., :1], 3, -1) if encoding == "mono8" else expected
        assert np.array_equal(loaded.frames("head")[3], wanted)


def turned() -> bytes:
    buffer, exif = io.BytesIO(), Image.Exif()
    exif[0x0112] = 3
    Image.fromarray(toy.picture(7)).save(buffer, "JPEG", exif=exif)
    return buffer.getvalue()


DEPTH = np.arange(12 * 16, dtype=np.uint16).reshape(12, 16) * 20
PNG16, PNG8 = (cv2.imencode(".png", image)[1].tobytes() for image in (DEPTH, DEPTH.astype(np.uint8)))


@pytest.mark.parametrize(
    ("data_format", "data", "reason", "said"),
    [
        ("16UC1; png compressed ", PNG16, "not_colour", "depth"),
        ("16UC1; compressedDepth png", bytes(12) + PNG16, "not_colour", "depth"),
        ("32FC1; compressedDepth", bytes(12) + PNG16, "not_colour", "depth"),
        ("16UC1; compressedDepth rvl", bytes(76), "not_colour", "depth"),
        ("png", PNG16, "not_colour", "depth"),  # the format says nothing, the picture does
        ("png", bytes(12) + PNG16, "not_colour", "depth"),
        ("16UC1; jpeg compressed", PNG8, "not_colour", "depth"),
        ("jpeg", turned(), "missing_calibration", "orientation 3"),
    ],
)
def test_depth_and_turned_stills_of_a_camera_are_refused(
    tmp_path: Path, data_format: str, data: bytes, reason: str, said: str
) -> None:
    recording = robot(0.5)
    recording.rewrite(HEAD, format=data_format, data=data)
    recording.write(tmp_path / "a.mcap")
    error = rejection(toy.declared(tmp_path))
    assert (error.reason, said in str(error), HEAD in str(error)) == (reason, True, True)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"k": [0.0] * 9, "p": [0.0] * 12}, "K is all zeros"),
        ({"height": 0, "width": 0}, "its image size is 0x0"),
        ({"k": [0.0] * 9, "height": 0, "width": 0, "distortion_model": "", "d": []}, "K is all zeros"),
        ({"distortion_model": "equidistant", "d": [0.0] * 4}, "D of a equidistant lens is all zeros"),
        ({"distortion_model": "Inverse Brown Conrady"}, None),
        ({"distortion_model": "rational_polynomial", "d": [0.0] * 14}, None),
        ({"distortion_model": "", "d": [0.0] * 5}, None),
        ({"distortion_model": "plumb_bob", "d": [0.0] * 12}, None),
    ],
)
def test_an_empty_calibration_costs_its_camera_only(tmp_path: Path, changes: Any, why: str | None) -> None:
    recording = robot(0.5)
    recording.rewrite("/head/camera_info", **changes)
    if why is not None:  # nor is its frame needed
        (static,) = [sent for sent in recording.sent if sent.topic == "/tf_static"]
        recording.rewrite("/tf_static", transforms=static.message["transforms"][1:])
    recording.write(tmp_path / "a.mcap")
    loaded = load(toy.declared(tmp_path))
    assert loaded.views == ("head", "right_wrist")
    assert set(loaded.episode.cameras) == ({"right_wrist"} if why else {"head", "right_wrist"})
    assert loaded.episode.conventions.get("uncalibrated") == (why and f"head: {why}")
    assert not loaded.distortions
    assert numbers(loaded) == list(range(loaded.episode.num_frames))


def zeroed(sent: Sent) -> Sent:
    """The message of a second publisher, which has heard nothing yet."""
    key = "position" if "position" in sent.message else "data"
    return replace(sent, message={**sent.message, key: [0.0] * len(sent.message[key])})


def zeroed_where(chosen: Callable[[int], bool]) -> Change:
    return lambda sent: [zeroed(s) if chosen(i) else s for i, s in enumerate(sent)]


def jumping(sent: list[Sent]) -> list[Sent]:
    sent[150].message["position"][:] = [0.0, 0.0, 2.0]
    return sent


def stale(sent: list[Sent]) -> list[Sent]:
    """Every second transform repeats the first."""
    first = sent[0].message["transforms"][0]["transform"]
    for each in sent[1::2]:
        each.message["transforms"][0]["transform"] = first
    return sent


def reading(joint: int, value: float, seconds: float) -> Change:
    """One joint's reading at a time is another."""

    def change(sent: list[Sent]) -> list[Sent]:
        sent[min(int(seconds * 100), len(sent) - 1)].message["position"][joint] = value
        return sent

    return change


GAP, TWO = "time_gap", "conflicting_messages"


@pytest.mark.parametrize(
    ("topic", "change", "reason", "what", "numbers"),
    [
        (HEAD, lambda sent: sent[:40] + sent[45:], GAP, "Images are missing", {"gap_s": 0.2}),
        (STATES, lambda sent: sent[:100] + sent[125:], GAP, "Messages are missing", {"gap_s": 0.26}),
        ("/command", lambda sent: sent[:50] + sent[70:], GAP, "Messages are missing", {"gap_s": 0.42}),
        ("/tf", lambda sent: sent[:50] + sent[70:], GAP, "Messages are missing", {"gap_s": 0.42}),
        (WRIST, lambda sent: sent[:40], GAP, "Topic ends too early", {"gap_s": 1.66}),
        (STATES, lambda sent: sent[150:], GAP, "Topic begins too late", {"gap_s": 1.5}),
        (STATES, reading(2, np.nan, 1.0), "nan_state", "not finite", {"at_s": 1.0}),
        (STATES, reading(1, np.inf, 1.51), "nan_state", "not finite", {"at_s": 1.51}),
        (STATES, reading(0, np.nan, 2.0), "nan_state", "not finite", {"at_s": 2.0}),
        # Two publishers of one topic.
        (STATES, lambda sent: [x for s in sent for x in (s, zeroed(s))], TWO, "Messages of one time", {}),
        (STATES, lambda sent: [x for s in sent for x in (s, toy.shifted(zeroed(s), 0.005))], TWO, "to and fro", {}),
        (STATES, zeroed_where(lambda i: i % 4 == 1), TWO, "to and fro", {}),
        (STATES, zeroed_where(lambda i: i % 4 > 1), TWO, "to and fro", {}),
        ("/command", zeroed_where(lambda i: i % 2 == 1), TWO, "to and fro", {}),
        ("/command", zeroed_where(lambda i: i % 9 == 3), TWO, "to and fro", {}),
        (STATES, jumping, TWO, "cannot be interpolated", {}),
        ("/tf", stale, TWO, "", {}),
    ],
)
def test_what_cannot_be_brought_to_instants_is_refused(
    tmp_path: Path, topic: str, change: Change, reason: str, what: str, numbers: dict[str, float]
) -> None:
    error = rejection(changed(tmp_path, {topic: change}))
    assert (error.reason, what in error.what) == (reason, True), str(error)
    assert ("base_link -> wrist" if topic == "/tf" else topic) in str(error)
    assert {name: error.evidence[name] for name in numbers} == pytest.approx(
        numbers, abs=0.04 if "gap_s" in numbers else 0.02
    )


def test_readings_after_the_last_frame_need_not_be_finite(tmp_path: Path) -> None:
    declared = changed(tmp_path, {STATES: reading(2, np.nan, 9.0)})
    assert np.isfinite(load(declared | {"fps": 10}).episode.state).all()


def test_one_publisher_is_not_taken_for_two(tmp_path: Path) -> None:
    """Noise, repeated messages, commands that step, and grippers that are switched."""
    rng = np.random.default_rng(2)

    def noisy(sent: list[Sent]) -> list[Sent]:
        for each in sent:
            each.message["position"][:] = (np.array(each.message["position"]) + rng.normal(0, 0.002, 3)).tolist()
        return [x for s in sent for x in (s, s)]

    def stepping(sent: list[Sent]) -> list[Sent]:
        for i, each in enumerate(sent):
            each.message["data"][:] = [0.6 * (i // 25 % 2), 0.1, 0.04 * (i // 10 % 2)]
        return sent

    assert load(changed(tmp_path, {STATES: noisy, "/command": stepping})).episode.num_frames == 90
