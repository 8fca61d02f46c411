"""Every metric of predicted videos: one entry each. Tables, the report, the nightly comparison, the documentation and the
tests go through these entries. No torch in here.

A metric with ``compute`` is measured only where ``evaluate_video.metrics`` names it; the others always are.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from worldline_core.errors import ConfigError

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
        what: one sentence for readers.
        source: where the formula comes from.
        perfect: its value for a prediction that equals the recording.
        margin: a smaller loss is no regression of a night, whatever its interval says.
        needs, compute: of metrics on request: its arguments, and the name of its function in `evaluation.metrics`.
    """

    name: str
    title: str
    what: str
    source: str
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
        """The function that computes a metric on request."""
        return getattr(importlib.import_module("worldline_core.evaluation.metrics"), f"{self.compute}")


_PAPER = "the paper, appendix"
_EWMBENCH = "after EWMBench (arXiv 2505.09694)"
_METRICS = (
    Metric(
        "robot_iou_exact", "Robot IoU, exact",
        "Intersection over union of the segmenter's mask of the predicted robot and the recording's exact mask.",
        f"{_PAPER} “Robot-mask IoU”, with exact masks for the truth", perfect=1.0, margin=0.005,
    ),
    Metric(
        "robot_iou", "Robot IoU, segmenter",
        "The same, one segmenter masking the true and the predicted video independently of each other.",
        f"{_PAPER} “Robot-mask IoU”", perfect=1.0, margin=0.005,
    ),
    Metric(
        "robot_iou_uncovered", "Robot IoU, uncovered",
        "As the exact one, on pixels that the recording shows free of the robot at some time, without the given first frame.",
        "this project", perfect=1.0, margin=0.01,
    ),
    Metric(
        "robot_iou_difference", "Robot IoU, difference",
        "IoU of what differs from the recording's own background in the predicted frame and the exact mask, on such pixels where never a"
        " thing is; no network.",
        "this project", perfect=1.0, margin=0.01,
    ),
    Metric(
        "object_iou_exact", "Object IoU, exact",
        "IoU of what the task moves, found by the colour that the instruction names, in the frames in which it has moved.",
        "this project", perfect=1.0, margin=0.01,
    ),
    Metric(
        "invented_motion", "Invented motion",
        "Share of the pixels of things that stay where they are which the prediction shows changed.",
        "this project", perfect=0.0, margin=0.01, lower_is_better=True,
    ),
    Metric(
        "sharpness", "Sharpness",
        "Edges of the predicted frame over those of the recorded one (mean absolute Laplacian), or the reciprocal above 1.",
        "this project", perfect=1.0, margin=0.01,
    ),
    Metric(
        "ssim", "SSIM", "Structural similarity of each frame.", "Wang et al. 2004", perfect=1.0, margin=0.003,
    ),
    Metric(
        "psnr", "PSNR", "Peak signal-to-noise ratio of each frame.", f"{_PAPER} “Full-frame metrics”",
        perfect=58.9, margin=0.1, digits=2, unit="dB",
    ),
    Metric(
        "lpips", "LPIPS", "Learned perceptual distance of each frame (AlexNet), where its weights are at hand.",
        "Zhang et al. 2018 (arXiv 1801.03924)", perfect=0.0, margin=0.005, lower_is_better=True,
    ),
    Metric(
        "end_effector_error_px", "Tool error",
        "How far from the true place the picture around a tool is found in the predicted frame; without a camera, around what has moved most.",
        "this project", perfect=0.0, margin=0.1, digits=2, unit="px", lower_is_better=True,
    ),
    Metric(
        "hsd", "HSD", "Reciprocal of the symmetric Hausdorff distance of the true and the found path of each arm that moves.",
        _EWMBENCH, perfect=1.0, margin=0.01, needs="tool_paths", compute="hausdorff_score",
    ),
    Metric(
        "ndtw", "nDTW",
        "Reciprocal of the distance of both paths under dynamic time warping, per step of the true path, of each arm that"
        " moves.",
        _EWMBENCH, perfect=1.0, margin=0.01, needs="tool_paths", compute="time_warping_score",
    ),
    Metric(
        "dyn", "DYN",
        "Agreement of the distributions of speeds and accelerations of each arm that moves, by their Wasserstein distances.",
        f"{_EWMBENCH}, distances relative to the true path's own motion", perfect=1.0, margin=0.01, needs="tool_paths",
        compute="dynamics_score",
    ),
    Metric(
        "scene_consistency", "Scene consistency",
        "SSIM of the predicted head view with its own first frame, where the recording stays as it was and no robot is.",
        "this project, after EWMBench's scene consistency, which compares features", perfect=1.0, margin=0.003,
        needs="frames", compute="scene_consistency",
    ),
    Metric(
        "action_following", "Action following",
        "d' / (d + d'): mean distance of the tools from their true places under the true controls (d) and under changed"
        " ones (d'); 0.5 where the controls do not matter.",
        "this project", perfect=1.0, margin=0.01, needs="changed_controls", compute="action_following",
    ),
    Metric(
        "counterfactual_direction", "Counterfactual direction",
        "Share of frames in which the difference of two predictions of one start under two controls points the way that"
        " the controls say; 0.5 by chance.",
        "this project", perfect=1.0, margin=0.01, needs="changed_controls",
        compute="counterfactual_direction",
    ),
)  # fmt: skip
METRICS: dict[str, Metric] = {metric.name: metric for metric in _METRICS}
"""In the order of the report's columns."""
ON_REQUEST = tuple(metric.name for metric in _METRICS if metric.needs)


def metric_of(name: str) -> Metric | None:
    """The entry behind a name of a table: ``robot_iou[colour]@head`` is of ``robot_iou``; None for what is no video metric."""
    return METRICS.get(name.partition("@")[0].partition("[")[0])


def requested(names: tuple[str, ...]) -> dict[str, Metric]:
    """The entries of metrics that are asked for.

    Raises: ConfigError for a name that is no metric on request.
    """
    unknown = [name for name in names if name not in ON_REQUEST]
    if unknown or len(set(names)) != len(names):
        raise ConfigError("No metrics on request", expected=f"some of {', '.join(ON_REQUEST)}, each once", got=names)
    return {name: METRICS[name] for name in names}
