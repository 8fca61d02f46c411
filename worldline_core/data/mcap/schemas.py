"""JSON schemas of the MCAP messages: Foxglove's published ones, cut to the fields that are written."""

from __future__ import annotations

from typing import Any

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


SCHEMAS: dict[str, dict[str, Any]] = {
    "foxglove.CompressedImage": _object(
        "foxglove.CompressedImage",
        timestamp=_TIME,
        frame_id=_STRING,
        data={"type": "string", "contentEncoding": "base64"},
        format=_STRING,
    ),
    "foxglove.CameraCalibration": _object(
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
    "foxglove.FrameTransform": _object(
        "foxglove.FrameTransform",
        timestamp=_TIME,
        parent_frame_id=_STRING,
        child_frame_id=_STRING,
        translation=_record("foxglove.Vector3", "x", "y", "z"),
        rotation=_record("foxglove.Quaternion", "x", "y", "z", "w"),
    ),
    "foxglove.JointStates": _object(
        "foxglove.JointStates",
        timestamp=_TIME,
        joints={"type": "array", "items": _object("foxglove.JointState", name=_STRING, position=_NUMBER)},
    ),
}
