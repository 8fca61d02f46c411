"""Resets: the robot jumps back to where it began, as when two attempts were recorded into one file."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from worldline_core.config.base import StrictModel
from worldline_core.filters.verdict import Verdict


class ResetConfig(StrictModel):
    """A reset covers most of the way back to the first pose within one frame, faster than the episode moves otherwise."""

    min_jump_rad: float = Field(default=0.15, gt=0, description="smaller steps are jitter")
    home_share: float = Field(
        default=0.2, gt=0, lt=1, description="distance to the first pose after, relative to before the jump"
    )
    min_relative_step: float = Field(
        default=1.15, ge=1, description="jump relative to the episode's other steps (90th percentile)"
    )


def detect_reset(joints: np.ndarray, config: ResetConfig) -> Verdict:
    """Frames from the first jump home on.

    Args:
        joints: (n, j) joint positions [rad], without grippers.
    """
    steps = np.abs(np.diff(joints, axis=0)).max(axis=1) if len(joints) > 1 else np.zeros(0)
    from_home = np.abs(joints - joints[0]).max(axis=1)
    homeward = []
    for i in np.flatnonzero(steps > config.min_jump_rad):
        others = np.delete(steps, i)
        usual = float(np.percentile(others, 90)) if len(others) else 0.0
        if from_home[i + 1] < config.home_share * from_home[i] and steps[i] > config.min_relative_step * usual:
            homeward.append(int(i))
    bad = np.zeros(len(joints), dtype=bool)
    if homeward:
        bad[homeward[0] + 1 :] = True
    return Verdict(
        "reset",
        True,  # the attempt before the jump stays, if it is long enough
        {
            "largest_step_rad": float(steps.max()) if len(steps) else 0.0,
            "threshold_step_rad": config.min_jump_rad,
            "reset_frame": homeward[0] + 1 if homeward else None,
            "jump_rad": float(steps[homeward[0]]) if homeward else None,
        },
        bad,
    )
