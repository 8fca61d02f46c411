"""Joint motion that no arm can make: readings that jump, and speeds beyond what the motors reach."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from pydantic import Field

from worldline_core.config.base import StrictModel
from worldline_core.filters.verdict import Curve, Numbers, Verdict, runs

_WINDOW = 4
# A reading that jumps away and back makes two large steps; a third makes it motion.
_LARGE_STEPS = 2


class JointMotionConfig(StrictModel):
    """Joint positions in radians. Arms of this size reach 2 to 4 rad/s (Panda 2.6, UR5e and xArm 3.1, ViperX 3.1)."""

    min_jump_rad: float = Field(default=0.3, gt=0, description="smaller steps from frame to frame are no jump")
    min_relative_step: float = Field(
        default=3.0, gt=1, description="a jump, of the largest other step of the joint within four frames"
    )
    max_speed_rad_s: float = Field(default=7.0, gt=0, description="faster is no motion of an arm")


def jump_steps(joints: np.ndarray, config: JointMotionConfig) -> np.ndarray:
    """bool (n - 1, j): steps that stand alone among small ones.

    Args:
        joints: (n, j) [rad].
    """
    steps = np.abs(np.diff(joints, axis=0))
    candidates = np.argwhere(steps > config.min_jump_rad)
    jumps = np.zeros(steps.shape, dtype=bool)
    for i, joint in candidates:
        around = np.sort(steps[max(0, i - _WINDOW) : i + _WINDOW + 1, joint])
        others = around[: len(around) - _LARGE_STEPS]
        usual = float(others[-1]) if len(others) else 0.0
        jumps[i, joint] = steps[i, joint] > config.min_relative_step * usual
    return jumps


def detect_joint_jump(joints: np.ndarray, config: JointMotionConfig) -> Verdict:
    """Frames at which a reading jumps, and those between a jump and its way back.

    Args:
        joints: (n, j) joint positions [rad], without grippers.
    """
    bad = np.zeros(len(joints), dtype=bool)
    steps = np.abs(np.diff(joints, axis=0))
    jumps = jump_steps(joints, config) if len(joints) > 1 else np.zeros((0, joints.shape[1]), dtype=bool)
    for joint in np.flatnonzero(jumps.any(axis=0)):
        at = np.flatnonzero(jumps[:, joint])
        bad[at + 1] = True
        for first, second in pairwise(at):
            returned = abs(joints[second + 1, joint] - joints[first, joint]) < 0.5 * steps[first, joint]
            if returned and second - first <= _WINDOW:
                bad[first + 1 : second + 1] = True
    numbers: Numbers = {
        "jumps": int(jumps.sum()),
        "largest_jump_rad": float(steps[jumps].max()) if jumps.any() else 0.0,
        "threshold_jump_rad": config.min_jump_rad,
    }
    curve = np.concatenate([[0.0], steps.max(axis=1)]) if len(steps) else np.zeros(len(joints))
    return Verdict("joint_jump", True, numbers, bad, {"largest_step_rad": Curve(curve, config.min_jump_rad)})


def detect_joint_speed(joints: np.ndarray, fps: float, config: JointMotionConfig) -> Verdict:
    """Stretches of two frames or more above the speed limit; a single step is a jump, if anything.

    Args:
        joints: (n, j) joint positions [rad], without grippers.
    """
    speed = np.abs(np.diff(joints, axis=0)).max(axis=1) * fps if len(joints) > 1 else np.zeros(0)
    bad = np.zeros(len(joints), dtype=bool)
    jumps = jump_steps(joints, config).any(axis=1) if len(joints) > 1 else np.zeros(0, dtype=bool)
    for start, stop in runs((speed > config.max_speed_rad_s) & ~jumps):
        if stop - start >= 2:
            bad[start + 1 : stop + 1] = True
    return Verdict(
        "joint_speed",
        True,  # the rest of the episode stays, if it is long enough
        {
            "max_joint_speed_rad_s": float(speed.max()) if len(speed) else 0.0,
            "frames_over": int(bad.sum()),
            "threshold_rad_s": config.max_speed_rad_s,
        },
        bad,
        {"joint_speed_rad_s": Curve(np.concatenate([[0.0], speed]), config.max_speed_rad_s)},
    )
