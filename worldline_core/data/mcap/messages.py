"""Contents of messages of ROS 2 and Foxglove schemas, decoded (CDR, protobuf, JSON) by the schemas that the file holds."""

from __future__ import annotations

import base64
import re
import struct
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr
from dataclasses import dataclass
from functools import lru_cache, partial
from io import StringIO
from types import SimpleNamespace
from typing import Any, Literal

from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoderFactory
from mcap_ros2._vendor.rosidl_adapter.parser import InvalidSpecification, InvalidValue
from mcap_ros2.decoder import DecoderFactory as Ros2DecoderFactory

from worldline_core.data.guards.plain_files import parse_json
from worldline_core.data.guards.rejection import RejectedInputError, check_columns

_EMPTY_ARRAY = re.compile(rb"\[\s*0+\s*\]")
"""A field of a ROS definition that takes no bytes, so that an array of such messages may have any length."""

Kind = Literal["image", "video", "raw_image", "calibration", "joints", "numbers", "transforms", "pose", "marker"]
IMAGE_KINDS: tuple[Kind, ...] = ("image", "video", "raw_image")

_SCHEMAS: dict[Kind, tuple[str, ...]] = {
    "image": ("sensor_msgs/CompressedImage", "foxglove.CompressedImage"),
    "video": ("foxglove.CompressedVideo",),
    "raw_image": ("sensor_msgs/Image", "foxglove.RawImage"),
    "calibration": ("sensor_msgs/CameraInfo", "foxglove.CameraCalibration"),
    "joints": ("sensor_msgs/JointState", "foxglove.JointStates"),
    "numbers": ("std_msgs/Float64MultiArray", "std_msgs/Float32MultiArray", "std_msgs/Float64", "std_msgs/Float32"),
    "transforms": (
        "tf2_msgs/TFMessage", "geometry_msgs/TransformStamped", "foxglove.FrameTransform", "foxglove.FrameTransforms",
    ),
    "pose": ("geometry_msgs/PoseStamped", "foxglove.PoseInFrame"),
    "marker": ("std_msgs/String", "std_msgs/Bool"),
}  # fmt: skip
_KINDS: dict[str, Kind] = {schema: kind for kind, schemas in _SCHEMAS.items() for schema in schemas}


def schema_kind(name: str) -> Kind | None:
    """Kind of the messages of `sensor_msgs/msg/Image`, `foxglove_msgs/msg/RawImage`, ...; None for a schema that is not read."""
    return _KINDS.get(name.replace("/msg/", "/").replace("foxglove_msgs/", "foxglove."))


VIDEO_CODECS = {"h264": "h264", "h265": "hevc"}
"""Foxglove's names of codecs, and FFmpeg's."""
_START_CODE = b"\0\0\1"


@dataclass(frozen=True, slots=True)
class EncodedImage:
    """A JPEG or PNG image, or one frame of a video in Annex B; `format` as in the message."""

    frame: str
    data: bytes
    format: str

    def units(self) -> Iterator[tuple[int, bytes]]:
        """(type, bytes with a start code) of a video message's NAL units (ITU-T H.264 and H.265, 7.3 and annex B)."""
        start = self.data.find(_START_CODE)
        while 0 <= start < len(self.data) - 3:
            stop, header = self.data.find(_START_CODE, start + 3), self.data[start + 3]
            kind = (header >> 1) & 0x3F if self.format == "h265" else header & 0x1F
            yield kind, self.data[start : stop if stop > 0 else None]
            start = stop

    @property
    def picture(self) -> Literal["key", "other"] | None:
        """Tells if decoding can begin with this picture: an IDR picture (H.264), or any random access point (H.265).

        None for a message of parameter sets alone. The first picture's NAL unit decides, not what comes before it.
        """
        pictures = range(32) if self.format == "h265" else range(1, 6)
        keys = range(16, 24) if self.format == "h265" else (5,)
        first = next((kind for kind, _ in self.units() if kind in pictures), None)
        return None if first is None else "key" if first in keys else "other"

    def parameter_sets(self) -> list[bytes]:
        """Sequence, picture and (H.265) video parameter sets of this message."""
        wanted = (32, 33, 34) if self.format == "h265" else (7, 8)
        return [unit for kind, unit in self.units() if kind in wanted]

    def check_video(self, where: str) -> None:
        """Raises: RejectedInputError (unknown_schema) for another codec than H.264 and H.265, or another form than Annex B."""
        refused = partial(RejectedInputError, "unknown_schema", where=where)
        if self.format not in VIDEO_CODECS:
            raise refused("Video codec is not supported", expected=" or ".join(VIDEO_CODECS), got=self.format)
        if not re.match(rb"\x00\x00+\x01", self.data):
            got = f"{self.data[:8].hex(' ')}, in AVCC the length of the unit"
            next_step = "write the packets through FFmpeg's bitstream filter h264_mp4toannexb or hevc_mp4toannexb"
            expected = "a start code (00 00 00 01) before every NAL unit"
            raise refused("Video messages are not in Annex B", expected=expected, got=got, next_step=next_step)


@dataclass(frozen=True, slots=True)
class RawImage:
    """Uncompressed pixels, row after row of `step` bytes."""

    frame: str
    data: bytes
    encoding: str
    width: int
    height: int
    step: int


@dataclass(frozen=True, slots=True)
class Calibration:
    """K and P row by row, the lens, binning and region of interest (x, y, width, height; zeros: the whole image)."""

    frame: str
    width: int
    height: int
    model: str
    D: tuple[float, ...]
    K: tuple[float, ...]
    P: tuple[float, ...]
    binning: tuple[int, int] = (0, 0)
    roi: tuple[int, int, int, int] = (0, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class Joints:
    """Positions by joint; NaN where a message leaves one out, empty where it has none."""

    names: tuple[str, ...]
    position: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Transform:
    """Pose of `child` in `parent`: x, y, z [m], qx, qy, qz, qw. A message of a single pose names no child."""

    parent: str
    child: str
    stamp_ns: int
    values: tuple[float, ...]


def _field(raw: Any, *names: str) -> Any:
    """The first of these fields that the message has; ROS 2, protobuf and JSON spell some of them differently."""
    return getattr(raw, next((name for name in names if hasattr(raw, name)), names[0]))


def _nanoseconds(time: Any) -> int:
    return int(_field(time, "sec", "seconds")) * 10**9 + int(_field(time, "nanosec", "nsec", "nanos"))


def _header_time(raw: Any) -> int | None:
    """[ns]; None where the schema has none."""
    if hasattr(raw, "header"):
        return _nanoseconds(raw.header.stamp)
    return _nanoseconds(raw.timestamp) if hasattr(raw, "timestamp") else None


def _frame(raw: Any) -> str:
    return str((raw.header if hasattr(raw, "header") else raw).frame_id)


def _bytes(data: Any) -> bytes:
    return base64.b64decode(data, validate=True) if isinstance(data, str) else bytes(data)


def _numbers(values: Any) -> tuple[float, ...]:
    return tuple(float(value) for value in ([values] if isinstance(values, int | float) else values))


def _calibration(raw: Any) -> Calibration:
    binning, roi = (0, 0), (0, 0, 0, 0)
    if hasattr(raw, "binning_x"):
        binning, region = (int(raw.binning_x), int(raw.binning_y)), raw.roi
        roi = int(region.x_offset), int(region.y_offset), int(region.width), int(region.height)
    D, K, P = (_numbers(_field(raw, name, name.lower())) for name in "DKP")
    return Calibration(_frame(raw), int(raw.width), int(raw.height), str(raw.distortion_model), D, K, P, binning, roi)


def _joints(raw: Any) -> Joints:
    if not hasattr(raw, "joints"):
        return Joints(tuple(map(str, raw.name)), _numbers(raw.position))
    # foxglove.JointStates: a record for each joint with optional readings; protobuf returns 0 for an unset number.
    joints = list(raw.joints)
    unset = [not (j.HasField if hasattr(j, "HasField") else partial(hasattr, j))("position") for j in joints]
    values = (float("nan") if empty else float(j.position) for j, empty in zip(joints, unset, strict=True))
    return Joints(tuple(str(joint.name) for joint in joints), tuple(values))


def _pose_values(position: Any, orientation: Any) -> tuple[float, ...]:
    both = [*(getattr(position, axis) for axis in "xyz"), *(getattr(orientation, axis) for axis in "xyzw")]
    return tuple(map(float, both))


def _transform(raw: Any) -> Transform:
    # geometry_msgs/TransformStamped, or foxglove.FrameTransform
    inner, parent = (raw.transform, _frame(raw)) if hasattr(raw, "header") else (raw, str(raw.parent_frame_id))
    values = _pose_values(inner.translation, inner.rotation)
    return Transform(parent.lstrip("/"), str(raw.child_frame_id).lstrip("/"), _header_time(raw) or 0, values)


def _pose(raw: Any) -> Transform:
    values = _pose_values(raw.pose.position, raw.pose.orientation)
    return Transform(_frame(raw).lstrip("/"), "", _header_time(raw) or 0, values)


_READERS: dict[Kind, Callable[[Any], Any]] = {
    **dict.fromkeys(("image", "video"), lambda raw: EncodedImage(_frame(raw), _bytes(raw.data), str(raw.format))),
    "raw_image": lambda raw: RawImage(
        _frame(raw), _bytes(raw.data), str(raw.encoding), int(raw.width), int(raw.height), int(raw.step)
    ),
    "calibration": _calibration,
    "joints": _joints,
    "numbers": lambda raw: _numbers(raw.data),
    "transforms": lambda raw: tuple(map(_transform, raw.transforms if hasattr(raw, "transforms") else [raw])),
    "pose": _pose,
    "marker": lambda raw: str(raw.data).lower() if isinstance(raw.data, bool) else str(raw.data),
}


def _as_object(value: Any) -> Any:
    """Parsed JSON with mappings as objects, to be read like the other encodings."""
    if isinstance(value, dict):
        return SimpleNamespace(**{name: _as_object(field) for name, field in value.items()})
    return [_as_object(item) for item in value] if isinstance(value, list) else value


# What the decoders and the parser of ROS 2 definitions raise for bytes and texts that are none of theirs.
_FAULTS = (
    McapError, DecodeError, ValueError, TypeError, LookupError, AttributeError, EOFError, RuntimeError, struct.error,
    InvalidSpecification, InvalidValue, NameError, AssertionError,
)  # fmt: skip


def decode(channel: Channel, schema: Schema | None, data: bytes, where: str) -> tuple[Kind, int | None, Any]:
    """Kind of a message, its header time [ns] (None where the schema has none), and its content.

    Raises: RejectedInputError: unknown_schema, unreadable, too_large.
    """
    # Numbers of channels and schemas mean something within one file of a split recording only.
    defined = None if schema is None else (schema.name, schema.encoding, schema.data)
    kind, decoded = _decoder(channel.message_encoding, defined, where)
    try:
        raw = decoded(data)
        stamp_ns, value = _header_time(raw), _READERS[kind](raw)
    except _FAULTS as error:
        what = "Message cannot be decoded"
        raise RejectedInputError("unreadable", what, where=where, got=repr(error)[:200]) from error
    if kind in ("joints", "numbers"):
        check_columns(len(value.names if isinstance(value, Joints) else value), where)
    return kind, stamp_ns, value


@lru_cache(maxsize=256)
def _decoder(encoding: str, defined: tuple[str, str, bytes] | None, where: str) -> tuple[Kind, Callable[[bytes], Any]]:
    """Kind of a channel's messages, and what decodes them into objects; `defined`: name, encoding and text of the schema."""
    refused = partial(RejectedInputError, "unknown_schema", where=where)
    name, language, text = defined or ("", "no schema", b"")
    kind = schema_kind(name)
    if kind is not None:
        if encoding == "json":
            return kind, lambda data: _as_object(parse_json(data, where))
        if encoding in ("cdr", "protobuf") and not text.strip():
            next_step = "record where the message's package is installed, or there: ros2 bag convert"
            raise refused("The file holds no definition of its messages", got=name, next_step=next_step)
        if language == "ros2msg" and _EMPTY_ARRAY.search(text):
            raise refused("Schema definition has arrays of length 0, which no message needs", got=name)
        factory = Ros2DecoderFactory() if encoding == "cdr" else ProtobufDecoderFactory()
        try:
            with redirect_stderr(StringIO()):  # the ROS 2 parser prints the line at fault as it is
                decoded = factory.decoder_for(encoding, Schema(1, text, language, name))
        except _FAULTS as error:
            raise refused("Schema definition cannot be read", got=repr(error)[:200]) from error
        if decoded is not None:
            return kind, decoded
    raise refused(
        "Messages of this schema are not understood",
        expected="CDR with ros2msg, protobuf or JSON of " + ", ".join(_KINDS),
        got=f"{name or 'no schema'} ({encoding or 'no encoding'}, {language})",
        next_step="name another topic, or convert the recording",
    )
