"""Projection: the tool lies in the picture, and where it is said to move, the picture changes."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from worldline_core.config.base import StrictModel
from worldline_core.filters.verdict import Verdict


class ProjectionConfig(StrictModel):
    """Lengths in shares of the image width, so that they hold at any resolution."""

    min_inside_share: float = Field(
        default=0.5, gt=0, le=1, description="frames in which some arm's tool is in the task-facing view"
    )
    radius: float = Field(default=0.07, gt=0, description="disc around the tool in which change is looked for")
    min_step: float = Field(default=0.012, gt=0, description="projected motion a frame that must be visible")
    min_moving_frames: int = Field(default=5, ge=1, description="fewer prove nothing")
    min_contrast: float = Field(
        default=1.6, gt=0, description="change near the tool over change in the whole picture (median)"
    )


def local_contrast(
    gray: np.ndarray, uv: np.ndarray, inside: np.ndarray, radius_px: float, min_step_px: float
) -> np.ndarray:
    """Change near a projected point relative to the change of the whole image, for frames in which the point moves.

    Args:
        gray: uint8 (n, h, w). uv: (n, 2). inside: bool (n,).

    Returns: (m,) ratios, m <= n - 1.
    """
    value = gray.astype(np.float32)
    height, width = gray.shape[1:]
    rows, columns = np.mgrid[:height, :width]
    ratios = []
    for i in range(1, len(gray)):
        if not (inside[i] and inside[i - 1]) or np.linalg.norm(uv[i] - uv[i - 1]) < min_step_px:
            continue
        change = np.abs(value[i] - value[i - 1])
        near = np.zeros((height, width), dtype=bool)
        for u, v in uv[i - 1 : i + 1]:
            near |= (columns - u) ** 2 + (rows - v) ** 2 <= radius_px**2
        ratios.append(change[near].mean() / max(float(change.mean()), 0.05))
    return np.asarray(ratios)


def detect_projection(gray: np.ndarray, uv: np.ndarray, inside: np.ndarray, config: ProjectionConfig) -> Verdict:
    """Whether tools project where the picture shows motion.

    Args:
        gray: uint8 (n, h, w) of a view that stands still.
        uv: (n, a, 2) projected tools. inside: bool (n, a).
    """
    width = gray.shape[2]
    share = float(inside.any(axis=1).mean())
    ratios = [
        local_contrast(gray, uv[:, arm], inside[:, arm], config.radius * width, config.min_step * width)
        for arm in range(uv.shape[1])
    ]
    pooled = np.concatenate(ratios) if ratios else np.zeros(0)
    contrast = float(np.median(pooled)) if len(pooled) >= config.min_moving_frames else None
    return Verdict(
        "projection",
        share >= config.min_inside_share and (contrast is None or contrast >= config.min_contrast),
        {
            "inside_share": share,
            "motion_contrast": contrast,
            "moving_frames": len(pooled),
            "threshold_inside_share": config.min_inside_share,
            "threshold_contrast": config.min_contrast,
        },
    )
