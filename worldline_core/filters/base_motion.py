"""Base motion: the whole picture of a fixed camera moves because the chassis drives, not because the arms move."""

from __future__ import annotations

import cv2
import numpy as np
from pydantic import Field

from worldline_core.config.base import StrictModel
from worldline_core.filters.verdict import Verdict

# Fewer pixels of one direction prove nothing.
_MIN_PIXELS = 60


class BaseMotionConfig(StrictModel):
    """Measured on images 96 pixels wide. While arms move, some edges of table and objects stand still; when the base
    moves, none does."""

    quantile: float = Field(
        default=0.15, gt=0, lt=1, description="share of textured pixels that may stand still in base motion"
    )
    min_gradient: float = Field(default=8.0, gt=0, description="grey levels a pixel; flatter regions show no motion")
    min_background_flow_px: float = Field(
        default=0.15, gt=0, description="flow at that quantile, px a step; more is base motion"
    )
    step_s: float = Field(default=0.125, gt=0, description="time between the compared frames")
    max_moving_share: float = Field(
        default=0.88, gt=0, le=1, description="share of frames with base motion that condemns"
    )


def background_flow(gray: np.ndarray, quantile: float, min_gradient: float, step: int = 1) -> np.ndarray:
    """(n,) flow across edges [px] that all but the stillest `quantile` of textured pixels exceed, frame i against i - step.

    Flow across an edge is |dI/dt| / |dI/dx| (the normal flow of the brightness constancy equation): no matching that
    could fail on plain tables.

    Args:
        gray: uint8 (n, h, w).
    """
    flow = np.zeros(len(gray))
    # The equation needs gradients that reach as far as the motion.
    value = np.stack([cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.0) for image in gray])
    for i in range(step, len(gray)):
        middle = (value[i - step] + value[i]) / 2
        across = cv2.Sobel(middle, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
        down = cv2.Sobel(middle, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
        gradient = np.hypot(across, down)
        normal_flow = np.abs(value[i] - value[i - step]) / np.maximum(gradient, 1e-3)
        # Upright and level edges apart: driving sideways leaves the level edges of a table where they are.
        upright = np.abs(across) > 2 * np.abs(down)
        level = np.abs(down) > 2 * np.abs(across)
        for direction in (upright, level):
            textured = direction & (gradient > min_gradient)
            if textured.sum() >= _MIN_PIXELS:
                flow[i] = max(flow[i], float(np.quantile(normal_flow[textured], quantile)))
    return flow


def detect_base_motion(flow: np.ndarray, config: BaseMotionConfig) -> Verdict:
    """Whether the background moves in more frames than arms in front of it explain.

    Args:
        flow: (n,) from `background_flow` of a camera that stands still in the base frame.
    """
    share = float((flow[1:] > config.min_background_flow_px).mean()) if len(flow) > 1 else 0.0
    return Verdict(
        "base_motion",
        share <= config.max_moving_share,
        {
            "moving_share": share,
            "median_flow_px": float(np.median(flow)),
            "max_flow_px": float(flow.max()),
            "threshold_flow_px": config.min_background_flow_px,
            "threshold_share": config.max_moving_share,
        },
    )
