"""Foxglove's schemas: protobuf by its published classes, video, and JSON."""

from __future__ import annotations

import json
from fractions import Fraction
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from google.protobuf.json_format import MessageToJson
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.reader import make_reader
from mcap.writer import Writer as RawWriter
from mcap_protobuf.writer import Writer

from tests.mcap import conftest as toy
from tests.mcap.conftest import load
from worldline_core.data.guards.rejection import RejectedInputError

NAMES = (
    "CameraCalibration", "CompressedImage", "CompressedVideo", "FrameTransform", "FrameTransforms", "JointStates",
    "PoseInFrame",
)  # fmt: skip


FOXGLOVE = {name: getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name) for name in NAMES}
"""Published message classes by name."""


def coloured(number: int) -> np.ndarray:
    """(48, 64, 3): grey steps that survive lossy coding."""
    return np.full((48, 64, 3), 20 + 3 * number, np.uint8)


def messages(codec: str, **parameters: str) -> tuple[list[bytes], list[int]]:
    """Sixty messages in the order of decoding, and the number of the picture in each."""
    encoder: Any = av.CodecContext.create(codec, "w")
    encoder.width, encoder.height, encoder.pix_fmt = 64, 48, "yuv420p"
    encoder.framerate, encoder.time_base = 30, Fraction(1, 30)
    encoder.options = {"crf": "10", **parameters}
    packets: list[Any] = []
    for number in range(60):
        frame = av.VideoFrame.from_ndarray(coloured(number), format="rgb24").reformat(format="yuv420p")
        frame.pts = number
        packets += encoder.encode(frame)
    packets += encoder.encode(None)
    return [bytes(packet) for packet in packets], [packet.pts for packet in packets]


@cache
def annex_b(codec: str = "libx264") -> list[bytes]:
    """One message a frame, without B-frames, as Foxglove wants it."""
    x265 = {"x265-params": "log-level=none:bframes=0:keyint=15"} if codec == "libx265" else {}
    return messages(codec, bf="0", g="15", tune="zerolatency", **x265)[0]


@cache
def with_b_frames(codec: str, parameters: str) -> tuple[list[bytes], list[int]]:
    name = codec.removeprefix("lib") + "-params"
    found, shown = messages(codec, **{name: f"keyint=15:min-keyint=15:scenecut=0:b-adapt=0:{parameters}"})
    assert sorted(shown) == list(range(60)) != shown
    return found, shown


def write(
    path: Path, packets: list[bytes] | None, *, leave_out: tuple[int, ...] = (), format_name: str = "h264",
    shown: list[int] | None = None,
) -> None:  # fmt: skip
    """Two seconds: a head camera (PNG or video), joints with an unset velocity, a moving head, a tool pose."""

    def at(seconds: float) -> tuple[int, Any]:
        time_ns = toy.START_NS + round(seconds * 1e9)
        return time_ns, Timestamp(seconds=time_ns // 10**9, nanos=time_ns % 10**9).SerializeToString()

    def stamped(name: str, seconds: float, **values: Any) -> Any:
        message = FOXGLOVE[name](**values)
        message.timestamp.ParseFromString(at(seconds)[1])
        return message

    def pose_of(seconds: float) -> tuple[dict[str, Any], dict[str, Any]]:
        place, quaternion = toy.wrist(seconds)
        return dict(zip("xyz", place, strict=True)), dict(zip("xyzw", quaternion, strict=True))

    path.parent.mkdir(parents=True, exist_ok=True)
    sent: list[tuple[float, str, Any]] = []
    K = [80.0, 0, 31.5, 0, 80.0, 23.5, 0, 0, 1]
    calibration = {"frame_id": "camera", "width": 64, "height": 48, "K": K, "distortion_model": "", "D": []}
    sent.append((0.0, "/calibration", stamped("CameraCalibration", 0.0, **calibration)))
    for number in range(60):
        if number in leave_out:
            continue
        if packets is None:
            data = {"data": toy.png(coloured(number)), "format": "png"}
            message = stamped("CompressedImage", number / 30, frame_id="camera", **data)
        else:
            stamp = (shown[number] if shown else number) / 30
            message = stamped("CompressedVideo", stamp, frame_id="camera", data=packets[number], format=format_name)
        # B-frames reach the recorder when the last picture that they lean on was encoded.
        behind = max(n - i for i, n in enumerate(shown)) if shown else 0
        sent.append(((number + behind) / 30, "/image", message))
    for number in range(200):
        time = number / 100
        joints = [{"name": name, "position": value} for name, value in zip("ab", toy.joints(time), strict=True)]
        joints += [{"name": "finger", "position": float(toy.finger(time))}, {"name": "silent"}]
        sent.append((time, "/joints", stamped("JointStates", time, joints=joints)))
    for number in range(100):
        time = number / 50
        translation, rotation = pose_of(time)
        frames = {"parent_frame_id": "base_link", "child_frame_id": "camera"}
        moving = stamped("FrameTransform", time, **frames, translation=translation, rotation=rotation)
        sent.append((time, "/tf", FOXGLOVE["FrameTransforms"](transforms=[moving])))
        tool = {"position": translation, "orientation": rotation}
        sent.append((time, "/tool", stamped("PoseInFrame", time, frame_id="base_link", pose=tool)))
    with path.open("wb") as stream:
        writer = Writer(stream)
        for seconds, topic, message in sorted(sent, key=lambda each: each[0]):
            writer.write_message(topic, message, at(seconds)[0] + 10**6, at(seconds)[0])
        writer.finish()


def declared(path: Path, **changes: Any) -> dict[str, Any]:
    state = {
        "joints": {"topic": "/joints", "names": ["a", "b"]},
        "gripper": {"topic": "/joints", "names": ["finger"], "range": {"closed": 0.0, "open": 0.04}},
    }
    own = {
        "views": {"head": {"image": "/image", "calibration": "/calibration"}},
        "arms": [{"name": "right", "state": state, "tool_pose": "/tool"}], "without_commands": "repeat_state",
    }  # fmt: skip
    return toy.declared(path, **own, **changes)


LATE = {"by": "ranges", "ranges": [{"name": "late", "start_s": 1.3, "stop_s": 1.8}]}


def shades(loaded: Any) -> np.ndarray:
    """Numbers of the pictures, as fractions: coding is lossy."""
    return (loaded.frames("head").mean(axis=(1, 2, 3)) - 20) / 3


def test_protobuf_messages_come_back(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", None)
    loaded = load(declared(tmp_path))
    episode = loaded.episode
    assert np.array_equal(loaded.frames("head"), np.stack([coloured(n) for n in range(episode.num_frames)]))
    assert np.abs(episode.state[:, :2] - toy.joints(episode.timestamps)).max() < 1e-5
    assert np.array_equal(episode.cameras["head"].K, [[80, 0, 31.5], [0, 80, 23.5], [0, 0, 1]])
    assert episode.cameras["head"].moving
    assert np.abs(episode.T_base_ee[:, 0] - episode.cameras["head"].T_base_camera).max() < 1e-9
    silent = declared(tmp_path)
    silent["arms"][0]["state"]["joints"]["names"] = ["a", "silent"]  # not set in any message, and not 0
    with pytest.raises(RejectedInputError, match="not finite") as caught:
        load(silent)
    assert caught.value.reason == "nan_state"


def test_json_messages_are_read_like_protobuf(tmp_path: Path) -> None:
    write(tmp_path / "protobuf" / "a.mcap", None)
    (tmp_path / "json").mkdir()
    with (tmp_path / "protobuf" / "a.mcap").open("rb") as source, (tmp_path / "json" / "a.mcap").open("wb") as target:
        writer = RawWriter(target)
        writer.start()
        channels: dict[str, int] = {}
        for schema, channel, sent in make_reader(source).iter_messages(log_time_order=False):
            message = FOXGLOVE[schema.name.removeprefix("foxglove.")].FromString(sent.data)
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, "jsonschema", b"{}")
                channels[channel.topic] = writer.register_channel(channel.topic, "json", number)
            text = json.dumps(in_json(message)).encode()
            writer.add_message(channels[channel.topic], sent.log_time, text, sent.publish_time)
        writer.finish()
    expected, found = (load(declared(tmp_path / kind)) for kind in ("protobuf", "json"))
    assert np.array_equal(found.frames("head"), expected.frames("head"))
    for name in ("state", "T_base_ee", "timestamps"):
        assert np.array_equal(getattr(found.episode, name), getattr(expected.episode, name))
    assert np.array_equal(found.episode.cameras["head"].K, expected.episode.cameras["head"].K)


def in_json(message: Any) -> dict[str, Any]:
    """Foxglove's JSON of a message: times as sec and nsec, bytes in base64."""

    def timed(values: dict[str, Any]) -> dict[str, Any]:
        if "timestamp" in values:
            time = Timestamp()
            time.FromJsonString(values["timestamp"])
            values["timestamp"] = {"sec": time.seconds, "nsec": time.nanos}
        return values

    text = MessageToJson(message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True)
    return json.loads(text, object_hook=timed)


CODECS = pytest.mark.parametrize(("codec", "name"), [("libx264", "h264"), ("libx265", "h265")])


def test_a_lost_video_message_is_not_concealed(tmp_path: Path) -> None:
    """Key frames are 0, 15, 30, 45; frame 20 shows image 19 or 21; a lost key frame spoils up to the next one."""

    def loss(packets: list[bytes], left_out: int, shown: list[int] | None = None) -> dict[str, Any]:
        write(tmp_path / "a.mcap", packets, leave_out=(left_out,), shown=shown)
        with pytest.raises(RejectedInputError, match="depend on a message that is missing") as caught:
            load(declared(tmp_path))
        assert caught.value.reason == "truncated_video"
        return caught.value.evidence

    packets = annex_b()
    assert loss(packets, 20)["frames"] in (9, 10)
    assert loss(packets, 30)["frames"] in (14, 15)
    write(tmp_path / "a.mcap", packets, leave_out=(29,))  # the last one before a key frame: nothing depends on it
    assert shades(load(declared(tmp_path)))[30] == pytest.approx(30, abs=0.5)
    packets, shown = with_b_frames("libx264", "bframes=3:b-pyramid=none")
    for lost in (21, 23, 24):  # B-frames before it are spoiled too
        assert loss(packets, shown.index(lost), shown)["first_frame"] <= lost - 3


VIDEOS = [
    ("libx264", "h264", None), ("libx265", "h265", None),
    ("libx264", "h264", "bframes=3:b-pyramid=none"), ("libx264", "h264", "bframes=7:b-pyramid=normal"),
    ("libx264", "h264", "bframes=2:open-gop=1"),
    ("libx265", "h265", "bframes=3:log-level=none"), ("libx265", "h265", "bframes=4:open-gop=1:log-level=none"),
]  # fmt: skip


@pytest.mark.parametrize(("codec", "name", "b_frames"), VIDEOS)
def test_pictures_are_decoded_and_ordered_by_their_stamps(
    tmp_path: Path, codec: str, name: str, b_frames: str | None
) -> None:
    packets, shown = (annex_b(codec), None) if b_frames is None else with_b_frames(codec, b_frames)
    write(tmp_path / "a.mcap", packets, format_name=name, shown=shown)
    found = shades(load(declared(tmp_path)))
    assert np.abs(found - np.arange(60)).max() < 0.5
    if b_frames != "bframes=2:open-gop=1":  # x264 writes its one IDR picture at the beginning then
        late = shades(load(declared(tmp_path, episodes=LATE), "toy-a-late"))
        # Not a key frame: decoding began at an earlier one.
        assert round(late[0]) in (39, 40) if b_frames is None else late[0] == pytest.approx(39, abs=1.7)
        assert np.abs(late - round(late[0]) - np.arange(len(late))).max() < 0.5
    if b_frames is None:
        return
    with pytest.raises(RejectedInputError, match=r"(?s)another order than their times.*set time: header") as caught:
        load(declared(tmp_path, time="log")).frames("head")
    assert caught.value.reason == "clock_skew"


def avcc(packet: bytes, size: int = 4) -> bytes:
    """Annex B as in mp4."""
    units = [unit.rstrip(b"\0") for unit in packet.replace(b"\0\0\0\1", b"\0\0\1").split(b"\0\0\1")[1:]]
    return b"".join(len(unit).to_bytes(size) + unit for unit in units)


@pytest.mark.parametrize(
    ("codec", "name", "delimiter"), [("libx264", "h264", b"\x09"), ("libx265", "h265", b"\x46\x01")]
)
def test_video_that_does_not_decode_is_refused(tmp_path: Path, codec: str, name: str, delimiter: bytes) -> None:
    packets = annex_b(codec)
    for content, said, message in (
        ([*packets[:20], b"\x00\x00\x01" + delimiter, *packets[21:]], name, "depend on a message that is missing"),
        (packets, "vp9", r"(?s)codec is not supported.*h264 or h265.*vp9"),
        ([packet for packet in packets[1:15] for _ in range(5)][:60], name, "No key frame comes before"),
        *(([avcc(packet, size) for packet in packets], name, r"(?s)Annex B.*AVCC.*mp4toannexb") for size in (4, 2)),
    ):
        write(tmp_path / "a.mcap", content, format_name=said)
        with pytest.raises(RejectedInputError, match=message):
            load(declared(tmp_path)).frames("head")


def without_sets(packet: bytes, name: str) -> tuple[bytes, bytes]:
    """A message's parameter sets, and the rest."""
    parts: tuple[list[bytes], list[bytes]] = [], []
    for unit in packet.replace(b"\0\0\0\1", b"\0\0\1").split(b"\0\0\1")[1:]:
        kind = (unit[0] >> 1) & 0x3F if name == "h265" else unit[0] & 0x1F
        parts[kind not in ((32, 33, 34) if name == "h265" else (7, 8))].append(b"\0\0\0\1" + unit)
    return b"".join(parts[0]), b"".join(parts[1])


@CODECS
@pytest.mark.parametrize("separate", [False, True])
def test_parameter_sets_before_the_episode_are_used(tmp_path: Path, codec: str, name: str, separate: bool) -> None:
    """They come once, with the file's first picture or in a message before it."""
    packets = annex_b(codec)
    (sets, first), *rest = [without_sets(packet, name) for packet in packets]
    assert sets
    packets, shown = [packets[0], *(packet for _, packet in rest)], None
    if separate:
        packets, shown = [sets, first, *packets[1:59]], [0, *range(59)]
    write(tmp_path / "a.mcap", packets, format_name=name, shown=shown)
    for each, identity in ((declared(tmp_path), "toy-a"), (declared(tmp_path, episodes=LATE), "toy-a-late")):
        found = shades(load(each, identity))
        assert np.abs(found - found[0] - np.arange(len(found))).max() < 0.5
        assert identity != "toy-a" or found[0] == pytest.approx(0, abs=0.5)
    nowhere = [without_sets(packet, name)[1] or first for packet in packets]
    write(tmp_path / "a.mcap", nowhere, format_name=name, shown=shown)
    with pytest.raises(RejectedInputError, match=r"Video|frames") as caught:
        load(declared(tmp_path)).frames("head")
    assert caught.value.reason == "truncated_video"
