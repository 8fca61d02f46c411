"""Every metric of predicted videos: one entry each, by which tables, the report and the nightly comparison go. docs/evaluation.md says
what each one is and where its formula comes from. No torch in here.

A metric with ``compute`` is measured only where ``evaluate_video.metrics`` names it; the others always are.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

Needs = Literal["tool_paths", "frames", "changed_controls"]
"""Arguments of a metric on request (`compute`):

- ``tool_paths``: (true, found) places of the tools (n, arms, 2) in hundredths of the frame's height;
- ``frames``: some frames in a row, a `SceneFrames`;
- ``changed_controls``: predictions of one start under true and changed controls, a `ControlledPair`.
"""


@dataclass(frozen=True)
class Metric:
    """One metric.

    Attributes:
        title: heading of its column.
        perfect: its value for a prediction that equals the recording.
        margin: a smaller loss is no regression of a night, whatever its interval says.
        needs, compute: of metrics on request: its arguments, and the name of its function in `evaluation.metrics`.
    """

    name: str
    title: str
    perfect: float
    margin: float
    digits: int = 3
    unit: str = ""
    lower_is_better: bool = False
    needs: Needs | None = None
    compute: str | None = None

    @property
    def heading(self) -> str:
        """Title, unit, and an arrow that points where predictions are better."""
        unit = f", {self.unit}" if self.unit else ""
        return f"{self.title}{unit}\u00a0{'↓' if self.lower_is_better else '↑'}"

    def load(self) -> Callable[..., Any]:
        return getattr(importlib.import_module("worldline_core.evaluation.metrics"), f"{self.compute}")


_METRICS = (
    Metric("robot_iou_exact", "Robot IoU, exact", perfect=1.0, margin=0.005),
    Metric("robot_iou", "Robot IoU, segmenter", perfect=1.0, margin=0.005),
    Metric("robot_iou_uncovered", "Robot IoU, uncovered", perfect=1.0, margin=0.01),
    Metric("robot_iou_difference", "Robot IoU, difference", perfect=1.0, margin=0.01),
    Metric("object_iou_exact", "Object IoU, exact", perfect=1.0, margin=0.01),
    Metric("invented_motion", "Invented motion", perfect=0.0, margin=0.01, lower_is_better=True),
    Metric("sharpness", "Sharpness", perfect=1.0, margin=0.01),
    Metric("ssim", "SSIM", perfect=1.0, margin=0.003),
    Metric("psnr", "PSNR", perfect=58.9, margin=0.1, digits=2, unit="dB"),
    Metric("lpips", "LPIPS", perfect=0.0, margin=0.005, lower_is_better=True),
    Metric("end_effector_error_px", "Tool error", perfect=0.0, margin=0.1, digits=2, unit="px", lower_is_better=True),
    Metric("hsd", "HSD", perfect=1.0, margin=0.01, needs="tool_paths", compute="hausdorff_score"),
    Metric("ndtw", "nDTW", perfect=1.0, margin=0.01, needs="tool_paths", compute="time_warping_score"),
    Metric("dyn", "DYN", perfect=1.0, margin=0.01, needs="tool_paths", compute="dynamics_score"),
    Metric(
        "scene_consistency", "Scene consistency", perfect=1.0, margin=0.003, needs="frames", compute="scene_consistency"
    ),
    Metric(
        "action_following",
        "Action following",
        perfect=1.0,
        margin=0.01,
        needs="changed_controls",
        compute="action_following",
    ),
    Metric(
        "counterfactual_direction",
        "Counterfactual direction",
        perfect=1.0,
        margin=0.01,
        needs="changed_controls",
        compute="counterfactual_direction",
    ),
)
METRICS: dict[str, Metric] = {metric.name: metric for metric in _METRICS}
"""In the order of the report's columns."""
ON_REQUEST = tuple(metric.name for metric in _METRICS if metric.needs)


def metric_of(name: str) -> Metric | None:
    """The entry behind a name of a table: ``robot_iou[colour]@head`` is of ``robot_iou``; None for what is no video metric."""
    return METRICS.get(name.partition("@")[0].partition("[")[0])
