"""Static stretches: neither the robot nor the image moves."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from worldline_core.config.base import StrictModel
from worldline_core.filters.verdict import Curve, Verdict, runs

SPEED_WINDOW_S = 0.5


class StaticConfig(StrictModel):
    """A stretch is static when all three stay below their thresholds."""

    max_joint_speed_rad_s: float = Field(
        default=0.03, gt=0, description="range of a joint within half a second, a second: encoder noise hardly counts"
    )
    max_gripper_speed_per_s: float = Field(default=0.05, gt=0)
    max_image_change: float = Field(
        default=0.6, gt=0, description="mean absolute change a frame of the coarse image, of 255"
    )
    min_run_s: float = Field(default=1.5, gt=0, description="shorter pauses are part of manipulation")


def range_speed(values: np.ndarray, fps: float) -> np.ndarray:
    """(n,) largest range of a column within SPEED_WINDOW_S around each frame, per second.

    A difference of neighbours would multiply encoder noise by the frame rate.

    Args:
        values: (n, j).
    """
    count = len(values)
    if values.shape[1] == 0 or count < 2:
        return np.zeros(count)
    reach = max(1, round(SPEED_WINDOW_S * fps / 2))
    padded = np.pad(values, ((reach, reach), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=0)
    return (windows.max(axis=-1) - windows.min(axis=-1)).max(axis=1) * fps / (2 * reach)


def detect_static(
    joint_speed: np.ndarray, gripper_speed: np.ndarray, image_change: np.ndarray, fps: float, config: StaticConfig
) -> Verdict:
    """Frames of static stretches.

    Args:
        joint_speed: (n,) `range_speed` of the joints [rad/s] (or tools [m/s] where poses are recorded).
        gripper_speed: (n,) the same of the grippers, openings a second.
        image_change: (n,) mean absolute change of the coarse task-facing image, of 255.
    """
    still = (joint_speed < config.max_joint_speed_rad_s) & (gripper_speed < config.max_gripper_speed_per_s)
    # Half a window at either end saw the motion beside the stretch.
    still = _widened(still, max(1, round(SPEED_WINDOW_S * fps / 2)))
    still &= image_change < config.max_image_change
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
        {
            "joint_range_rad_s": Curve(joint_speed, config.max_joint_speed_rad_s),
            "coarse_image_change": Curve(image_change, config.max_image_change),
        },
    )


def _widened(flags: np.ndarray, by: int) -> np.ndarray:
    wide = flags.copy()
    for start, stop in runs(flags):
        wide[max(0, start - by) : stop + by] = True
    return wide
