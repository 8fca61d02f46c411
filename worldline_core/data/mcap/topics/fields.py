"""Fields of decoded messages, be they objects (ROS 2, protobuf) or mappings (JSON), as this project's messages."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping
from typing import Any

from worldline_core.data.mcap.topics.messages import Calibration, EncodedImage, Joints, Kind, Pose, RawImage, Transform


def _get(raw: Any, *names: str) -> Any:
    """The first of these fields that the message has, be it an object or a JSON mapping."""
    for name in names:
        if isinstance(raw, Mapping):
            if name in raw:
                return raw[name]
        elif hasattr(raw, name):
            return getattr(raw, name)
    raise KeyError(" or ".join(names))


def _has(raw: Any, name: str) -> bool:
    return name in raw if isinstance(raw, Mapping) else hasattr(raw, name)


def _is_set(raw: Any, name: str) -> bool:
    """Whether an optional field has a value; protobuf shows an unset number as 0."""
    return bool(raw.HasField(name)) if hasattr(raw, "HasField") else _has(raw, name)


def _nanoseconds(time: Any) -> int:
    return int(_get(time, "sec", "seconds")) * 10**9 + int(_get(time, "nanosec", "nsec", "nanos"))


def stated_time(raw: Any) -> int | None:
    """Header time [ns]; None where the schema has none."""
    if _has(raw, "header"):
        return _nanoseconds(_get(_get(raw, "header"), "stamp"))
    return _nanoseconds(_get(raw, "timestamp")) if _has(raw, "timestamp") else None


def _frame(raw: Any) -> str:
    return str(_get(_get(raw, "header"), "frame_id") if _has(raw, "header") else _get(raw, "frame_id"))


def _bytes(raw: Any) -> bytes:
    data = _get(raw, "data")
    return base64.b64decode(data, validate=True) if isinstance(data, str) else bytes(data)


def _numbers(values: Any) -> tuple[float, ...]:
    return tuple(float(value) for value in ([values] if isinstance(values, int | float) else values))


def _encoded(raw: Any) -> EncodedImage:
    return EncodedImage(_frame(raw), _bytes(raw), str(_get(raw, "format")))


def _raw_image(raw: Any) -> RawImage:
    return RawImage(
        _frame(raw),
        _bytes(raw),
        str(_get(raw, "encoding")),
        int(_get(raw, "width")),
        int(_get(raw, "height")),
        int(_get(raw, "step")),
    )


def _calibration(raw: Any) -> Calibration:
    binning, roi = (0, 0), (0, 0, 0, 0)
    if _has(raw, "binning_x"):
        binning = int(_get(raw, "binning_x")), int(_get(raw, "binning_y"))
        region = _get(raw, "roi")
        roi = tuple(int(_get(region, name)) for name in ("x_offset", "y_offset", "width", "height"))
    return Calibration(
        _frame(raw),
        int(_get(raw, "width")),
        int(_get(raw, "height")),
        str(_get(raw, "distortion_model")),
        _numbers(_get(raw, "D", "d")),
        _numbers(_get(raw, "K", "k")),
        _numbers(_get(raw, "P", "p")),
        binning,
        (roi[0], roi[1], roi[2], roi[3]),
    )


def _joints(raw: Any) -> Joints:
    if _has(raw, "joints"):  # foxglove.JointStates: one record a joint, its readings optional
        joints = list(_get(raw, "joints"))
        readings = {
            field: tuple(float(_get(joint, field)) if _is_set(joint, field) else float("nan") for joint in joints)
            for field in ("position", "velocity", "effort")
        }
        return Joints(tuple(str(_get(joint, "name")) for joint in joints), **readings)
    velocity, effort = (_numbers(_get(raw, field)) if _has(raw, field) else () for field in ("velocity", "effort"))
    names = tuple(str(name) for name in _get(raw, "name"))
    return Joints(names, _numbers(_get(raw, "position")), velocity, effort)


def _pose_values(position: Any, orientation: Any) -> tuple[float, ...]:
    return (*(float(_get(position, axis)) for axis in "xyz"), *(float(_get(orientation, axis)) for axis in "xyzw"))


def _transform(raw: Any) -> Transform:
    if _has(raw, "header"):  # geometry_msgs/TransformStamped
        inner, stamp = _get(raw, "transform"), stated_time(raw)
        parent = _frame(raw)
    else:
        inner, stamp, parent = raw, _nanoseconds(_get(raw, "timestamp")), str(_get(raw, "parent_frame_id"))
    values = _pose_values(_get(inner, "translation"), _get(inner, "rotation"))
    return Transform(parent.lstrip("/"), str(_get(raw, "child_frame_id")).lstrip("/"), stamp or 0, values)


def _transforms(raw: Any) -> tuple[Transform, ...]:
    return tuple(_transform(item) for item in (_get(raw, "transforms") if _has(raw, "transforms") else [raw]))


def _pose(raw: Any) -> Pose:
    pose = _get(raw, "pose")
    return Pose(_frame(raw).lstrip("/"), _pose_values(_get(pose, "position"), _get(pose, "orientation")))


def _marker(raw: Any) -> str:
    value = _get(raw, "data")
    return str(value).lower() if isinstance(value, bool) else str(value)


READERS: dict[Kind, Callable[[Any], Any]] = {
    "image": _encoded,
    "video": _encoded,
    "raw_image": _raw_image,
    "calibration": _calibration,
    "joints": _joints,
    "numbers": lambda raw: _numbers(_get(raw, "data")),
    "transforms": _transforms,
    "pose": _pose,
    "marker": _marker,
}
