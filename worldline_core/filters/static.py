"""Static stretches: neither the robot nor the image moves."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from worldline_core.config.base import StrictModel
from worldline_core.filters.verdict import Verdict, runs


class StaticConfig(StrictModel):
    """A stretch is static when all three stay below their thresholds."""

    max_joint_speed_rad_s: float = Field(default=0.03, gt=0)
    max_gripper_speed_per_s: float = Field(default=0.05, gt=0)
    max_image_change: float = Field(default=0.6, gt=0, description="mean absolute change a frame, of 255")
    min_run_s: float = Field(default=1.5, gt=0, description="shorter pauses are part of manipulation")


def detect_static(
    joint_speed: np.ndarray, gripper_speed: np.ndarray, image_change: np.ndarray, fps: float, config: StaticConfig
) -> Verdict:
    """Frames of static stretches.

    Args:
        joint_speed: (n,) fastest joint [rad/s] (or tool [m/s] where poses are recorded), frame i against i - 1.
        gripper_speed: (n,) fastest gripper, openings a second.
        image_change: (n,) mean absolute change of the task-facing image, of 255.
    """
    still = (
        (joint_speed < config.max_joint_speed_rad_s)
        & (gripper_speed < config.max_gripper_speed_per_s)
        & (image_change < config.max_image_change)
    )
    bad = np.zeros(len(still), dtype=bool)
    longest = 0
    for start, stop in runs(still):
        longest = max(longest, stop - start)
        if stop - start >= config.min_run_s * fps:
            bad[start:stop] = True
    return Verdict(
        "static",
        not bad.all(),
        {
            "static_share": float(bad.mean()),
            "longest_still_s": longest / fps,
            "max_joint_speed_rad_s": float(joint_speed.max()),
            "max_image_change": float(image_change.max()),
            "threshold_run_s": config.min_run_s,
        },
        bad,
    )
