"""How a message of an MCAP file is written: JSON, protobuf, or ROS 2's CDR.

Messages are given in the fields of Foxglove's schemas, with image data as bytes. JSON and protobuf write them under these
schemas, with the descriptors that Foxglove publishes; CDR as the messages of ROS 2 that say the same: CompressedImage,
CameraInfo and JointState of sensor_msgs, and TFMessage of tf2_msgs.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping
from typing import Any, BinaryIO, Literal, Protocol

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from mcap.records import Schema
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema
from mcap_ros2.writer import Writer as Ros2Writer

Encoding = Literal["json", "protobuf", "ros2"]
Message = Mapping[str, Any]
FoxgloveSchema = Literal["CompressedImage", "CameraCalibration", "FrameTransform", "JointStates"]


class MessageFile(Protocol):
    """A file that takes messages; channels and schemas are registered when they are first used."""

    def write(self, topic: str, schema: FoxgloveSchema, message: Message, time_ns: int, sequence: int) -> None: ...

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None: ...

    def finish(self) -> None: ...


def message_file(stream: BinaryIO, encoding: Encoding) -> MessageFile:
    """A file in one of the encodings, which writes to the stream."""
    return _Ros2File(stream) if encoding == "ros2" else _FoxgloveFile(stream, encoding)


class _FoxgloveFile:
    def __init__(self, stream: BinaryIO, encoding: Literal["json", "protobuf"]) -> None:
        self._writer = Writer(stream, compression=CompressionType.ZSTD, enable_data_crcs=True)
        self._writer.start(profile="", library="worldline")
        self._encoding = encoding
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def write(self, topic: str, schema: FoxgloveSchema, message: Message, time_ns: int, sequence: int) -> None:
        if schema not in self._schemas:
            self._schemas[schema] = self._registered(schema)
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, self._encoding, self._schemas[schema])
        encode = _as_json if self._encoding == "json" else _as_protobuf
        data = encode(schema, message, divmod(time_ns, 10**9))
        self._writer.add_message(self._channels[topic], time_ns, data, time_ns, sequence)

    def _registered(self, schema: FoxgloveSchema) -> int:
        if self._encoding == "protobuf":
            return register_schema(self._writer, _PROTOBUF[schema])
        text = json.dumps(_JSON[schema], sort_keys=True).encode()
        return self._writer.register_schema(f"foxglove.{schema}", "jsonschema", text)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        self._writer.add_metadata(name, dict(values))

    def finish(self) -> None:
        self._writer.finish()


class _Ros2File:
    def __init__(self, stream: BinaryIO) -> None:
        self._writer = Ros2Writer(stream, compression=CompressionType.ZSTD)
        self._schemas: dict[str, Schema] = {}

    def write(self, topic: str, schema: FoxgloveSchema, message: Message, time_ns: int, sequence: int) -> None:
        name, content = _ROS2[schema]
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_msgdef(name.replace("/", "/msg/"), _definition(name))
        seconds, nanoseconds = divmod(time_ns, 10**9)
        values = content(message, {"sec": seconds, "nanosec": nanoseconds})
        self._writer.write_message(topic, self._schemas[name], values, time_ns, time_ns, sequence)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        self._writer.add_metadata(name, dict(values))

    def finish(self) -> None:
        self._writer.finish()


def _as_json(schema: FoxgloveSchema, message: Message, time: tuple[int, int]) -> bytes:
    values = {key: base64.b64encode(v).decode() if isinstance(v, bytes) else v for key, v in message.items()}
    stamp = {"sec": time[0], "nsec": time[1]}
    return json.dumps({"timestamp": stamp, **values}, separators=(",", ":"), allow_nan=False).encode()


_PROTOBUF: dict[FoxgloveSchema, Any] = {
    "CompressedImage": CompressedImage,
    "CameraCalibration": CameraCalibration,
    "FrameTransform": FrameTransform,
    "JointStates": JointStates,
}


def _as_protobuf(schema: FoxgloveSchema, message: Message, time: tuple[int, int]) -> bytes:
    return _PROTOBUF[schema](timestamp={"seconds": time[0], "nanos": time[1]}, **message).SerializeToString()


def _compressed_image(message: Message, stamp: Message) -> Message:
    return {**_headed(message, stamp), "format": message["format"], "data": message["data"]}


def _camera_info(message: Message, stamp: Message) -> Message:
    same = {name: message[name] for name in ("height", "width", "distortion_model")}
    matrices = {name.lower(): list(message[name]) for name in "DKRP"}
    return {**_headed(message, stamp), **same, **matrices, "binning_x": 0, "binning_y": 0, "roi": {}}


def _tf_message(message: Message, stamp: Message) -> Message:
    transform = {name: message[name] for name in ("translation", "rotation")}
    header = {"stamp": stamp, "frame_id": message["parent_frame_id"]}
    return {"transforms": [{"header": header, "child_frame_id": message["child_frame_id"], "transform": transform}]}


def _joint_state(message: Message, stamp: Message) -> Message:
    names, positions = ([joint[field] for joint in message["joints"]] for field in ("name", "position"))
    header = {"stamp": stamp, "frame_id": ""}
    return {"header": header, "name": names, "position": positions, "velocity": [], "effort": []}


def _headed(message: Message, stamp: Message) -> dict[str, Any]:
    return {"header": {"stamp": stamp, "frame_id": message["frame_id"]}}


_ROS2: dict[FoxgloveSchema, tuple[str, Callable[[Message, Message], Message]]] = {
    "CompressedImage": ("sensor_msgs/CompressedImage", _compressed_image),
    "CameraCalibration": ("sensor_msgs/CameraInfo", _camera_info),
    "FrameTransform": ("tf2_msgs/TFMessage", _tf_message),
    "JointStates": ("sensor_msgs/JointState", _joint_state),
}
# Fields as ROS 2's common_interfaces and geometry2 define them, without their comments.
_ROS2_FIELDS: dict[str, tuple[str, ...]] = {
    "builtin_interfaces/Time": ("int32 sec", "uint32 nanosec"),
    "std_msgs/Header": ("builtin_interfaces/Time stamp", "string frame_id"),
    "geometry_msgs/Vector3": ("float64 x", "float64 y", "float64 z"),
    "geometry_msgs/Quaternion": ("float64 x 0", "float64 y 0", "float64 z 0", "float64 w 1"),
    "geometry_msgs/Transform": ("geometry_msgs/Vector3 translation", "geometry_msgs/Quaternion rotation"),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header", "string child_frame_id", "geometry_msgs/Transform transform",
    ),
    "sensor_msgs/RegionOfInterest": (
        "uint32 x_offset", "uint32 y_offset", "uint32 height", "uint32 width", "bool do_rectify",
    ),
    "sensor_msgs/CompressedImage": ("std_msgs/Header header", "string format", "uint8[] data"),
    "sensor_msgs/CameraInfo": (
        "std_msgs/Header header", "uint32 height", "uint32 width", "string distortion_model", "float64[] d",
        "float64[9] k", "float64[9] r", "float64[12] p", "uint32 binning_x", "uint32 binning_y",
        "sensor_msgs/RegionOfInterest roi",
    ),
    "sensor_msgs/JointState": (
        "std_msgs/Header header", "string[] name", "float64[] position", "float64[] velocity", "float64[] effort",
    ),
    "tf2_msgs/TFMessage": ("geometry_msgs/TransformStamped[] transforms",),
}  # fmt: skip


def _definition(name: str) -> str:
    """The text of a message type: its fields, then the types that they are of, each once."""
    parts: dict[str, str] = {}

    def collect(found: str) -> None:
        parts.setdefault(found, "\n".join(_ROS2_FIELDS[found]))
        for field in _ROS2_FIELDS[found]:
            kind = field.split()[0].split("[")[0]
            if kind in _ROS2_FIELDS and kind not in parts:
                collect(kind)

    collect(name)
    own, *others = parts.items()
    return "".join([own[1], *(f"\n{'=' * 80}\nMSG: {kind}\n{fields}" for kind, fields in others)])


# Foxglove's published schemas, cut to the fields that are written.
_TIME: dict[str, Any] = {
    "type": "object",
    "title": "time",
    "properties": {
        "sec": {"type": "integer", "minimum": 0},
        "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999},
    },
}
_NUMBER: dict[str, Any] = {"type": "number"}
_NUMBERS: dict[str, Any] = {"type": "array", "items": _NUMBER}
_STRING: dict[str, Any] = {"type": "string"}


def _object(title: str, **properties: dict[str, Any]) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties, "required": list(properties)}


def _record(title: str, *names: str) -> dict[str, Any]:
    return _object(title, **dict.fromkeys(names, _NUMBER))


def _matrix(count: int) -> dict[str, Any]:
    return {**_NUMBERS, "minItems": count, "maxItems": count}


_JSON: dict[FoxgloveSchema, dict[str, Any]] = {
    "CompressedImage": _object(
        "foxglove.CompressedImage",
        timestamp=_TIME,
        frame_id=_STRING,
        data={"type": "string", "contentEncoding": "base64"},
        format=_STRING,
    ),
    "CameraCalibration": _object(
        "foxglove.CameraCalibration",
        timestamp=_TIME,
        frame_id=_STRING,
        width={"type": "integer", "minimum": 0},
        height={"type": "integer", "minimum": 0},
        distortion_model=_STRING,
        D=_NUMBERS,
        K=_matrix(9),
        R=_matrix(9),
        P=_matrix(12),
    ),
    "FrameTransform": _object(
        "foxglove.FrameTransform",
        timestamp=_TIME,
        parent_frame_id=_STRING,
        child_frame_id=_STRING,
        translation=_record("foxglove.Vector3", "x", "y", "z"),
        rotation=_record("foxglove.Quaternion", "x", "y", "z", "w"),
    ),
    "JointStates": _object(
        "foxglove.JointStates",
        timestamp=_TIME,
        joints={"type": "array", "items": _object("foxglove.JointState", name=_STRING, position=_NUMBER)},
    ),
}
