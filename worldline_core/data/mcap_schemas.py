"""JSON schemas of the MCAP messages: Foxglove's own where it has one, cut to the fields that are written."""

from __future__ import annotations

from typing import Any

_TIME: dict[str, Any] = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer", "minimum": 0}, "nsec": {"type": "integer", "minimum": 0}},
}
_NUMBER: dict[str, Any] = {"type": "number"}
_NUMBERS: dict[str, Any] = {"type": "array", "items": _NUMBER}
_STRING: dict[str, Any] = {"type": "string"}


def _object(title: str, **properties: dict[str, Any]) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties}


def _record(*names: str) -> dict[str, Any]:
    return {"type": "object", "properties": dict.fromkeys(names, _NUMBER)}


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
        K=_NUMBERS,
        R=_NUMBERS,
        P=_NUMBERS,
    ),
    "foxglove.FrameTransform": _object(
        "foxglove.FrameTransform",
        timestamp=_TIME,
        parent_frame_id=_STRING,
        child_frame_id=_STRING,
        translation=_record("x", "y", "z"),
        rotation=_record("x", "y", "z", "w"),
    ),
    "worldline.JointStates": _object(
        "worldline.JointStates",
        timestamp=_TIME,
        name={"type": "array", "items": _STRING},
        position=_NUMBERS,
    ),
}
