"""The estimated cameras as a calibration file that sources read (`data.sources.calibration_file`)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from worldline_core.calibration.estimate.verdict import ViewEstimate

DIGITS = 6


def camera_file(estimates: Iterable[ViewEstimate]) -> dict[str, Any]:
    """Content of the file: the views whose camera is sure."""
    return {"views": {each.view: _entry(each) for each in estimates if each.verdict == "sure"}}


def _entry(estimate: ViewEstimate) -> dict[str, Any]:
    camera = estimate.camera
    if camera is None:
        raise ValueError(f"a sure estimate without a camera: {estimate.view}")
    pose = camera.T_base_camera[0].round(DIGITS).tolist()
    common = {"width": camera.width, "height": camera.height, "K": camera.K.round(DIGITS).tolist()}
    if estimate.wrist:
        return common | {"T_tool_camera": pose}
    return common | {"maps": "camera_to_base", "axes": "opencv", "T": pose}
