"""What messages of ROS 2 and Foxglove schemas say, whatever they are encoded in (CDR, protobuf, JSON)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

Kind = Literal["image", "video", "raw_image", "calibration", "joints", "numbers", "transforms", "pose", "marker"]
IMAGE_KINDS: tuple[Kind, ...] = ("image", "video", "raw_image")

SCHEMA_KINDS: dict[str, Kind] = {
    "sensor_msgs/CompressedImage": "image",
    "sensor_msgs/Image": "raw_image",
    "sensor_msgs/CameraInfo": "calibration",
    "sensor_msgs/JointState": "joints",
    "tf2_msgs/TFMessage": "transforms",
    "geometry_msgs/TransformStamped": "transforms",
    "geometry_msgs/PoseStamped": "pose",
    "std_msgs/Float64MultiArray": "numbers",
    "std_msgs/Float32MultiArray": "numbers",
    "std_msgs/Float64": "numbers",
    "std_msgs/Float32": "numbers",
    "std_msgs/String": "marker",
    "std_msgs/Bool": "marker",
    "foxglove.CompressedImage": "image",
    "foxglove.CompressedVideo": "video",
    "foxglove.RawImage": "raw_image",
    "foxglove.CameraCalibration": "calibration",
    "foxglove.FrameTransform": "transforms",
    "foxglove.FrameTransforms": "transforms",
    "foxglove.PoseInFrame": "pose",
    "foxglove.JointStates": "joints",
    "worldline.JointStates": "joints",
}
"""Schema, without `/msg`, of every message that is understood; Foxglove's may also come as `foxglove_msgs`."""


@dataclass(frozen=True, slots=True)
class EncodedImage:
    """A JPEG or PNG image, or one frame of a video in Annex B; `format` as the message states it."""

    frame: str
    data: bytes
    format: str


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
    """Readings by joint; a field that a message leaves empty is empty here."""

    names: tuple[str, ...]
    position: tuple[float, ...]
    velocity: tuple[float, ...]
    effort: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Transform:
    """Pose of `child` in `parent` [m], quaternion xyzw; the time is its own."""

    parent: str
    child: str
    stamp_ns: int
    values: tuple[float, ...]
    """x, y, z, qx, qy, qz, qw."""


@dataclass(frozen=True, slots=True)
class Pose:
    """x, y, z [m], qx, qy, qz, qw in `frame`."""

    frame: str
    values: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Message:
    """One message: the time that it states itself (None: its schema has no place for one) and what it says."""

    stamp_ns: int | None
    value: Any


def schema_name(name: str) -> str:
    """`sensor_msgs/msg/Image` and `foxglove_msgs/msg/RawImage` as `SCHEMA_KINDS` lists them."""
    short = name.replace("/msg/", "/")
    return short.replace("foxglove_msgs/", "foxglove.")
