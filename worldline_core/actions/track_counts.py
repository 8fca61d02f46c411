"""What was masked, clipped or out of range while tracks were computed: counts that add up over episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypedDict

import torch
from jaxtyping import Float, Int
from torch import Tensor

from worldline_core.actions.tool_projection import CAUSES


class GripperOvershoot(TypedDict):
    """Openings of one arm beyond 0..1: how many were clipped, and the largest distance from the range."""

    clipped: int
    largest: float


class TrackCounts(TypedDict):
    """Counts of one episode, or of several.

    A sample is one frame, view and arm; views that an episode lacks have none. valid + behind_camera + outside_image
    + invalid_calibration = samples. `gripper_clipped` counts frames and arms, `outside_joint_limits` frames and
    joints, `gripper_overshoot` is by arm.
    """

    episodes: int
    samples: int
    valid: int
    behind_camera: int
    outside_image: int
    invalid_calibration: int
    outside_joint_limits: int
    gripper_clipped: int
    gripper_overshoot: dict[str, GripperOvershoot]


def count_samples(
    cause: Int[Tensor, "n v a"], opening: Float[Tensor, "n a"], arms: Sequence[str], outside_joint_limits: int
) -> TrackCounts:
    """Counts of one episode.

    Args:
        cause: of the views that the episode has.
        opening: gripper opening before it is clipped.
    """
    by_cause = torch.bincount(cause.flatten(), minlength=len(CAUSES)).tolist()
    beyond = torch.maximum(-opening, opening - 1).clamp_min(0)
    overshoot: dict[str, GripperOvershoot] = {
        arm: {"clipped": int((beyond[:, a] > 0).sum()), "largest": float(beyond[:, a].max())}
        for a, arm in enumerate(arms)
    }
    return {
        "episodes": 1,
        "samples": cause.numel(),
        "valid": by_cause[0],
        "behind_camera": by_cause[1],
        "outside_image": by_cause[2],
        "invalid_calibration": by_cause[3],
        "outside_joint_limits": outside_joint_limits,
        "gripper_clipped": sum(arm["clipped"] for arm in overshoot.values()),
        "gripper_overshoot": overshoot,
    }


def add_counts(parts: Sequence[TrackCounts]) -> TrackCounts:
    """Counts of several episodes together: numbers add, the largest overshoot of an arm is the largest of all."""
    overshoot: dict[str, GripperOvershoot] = {}
    for part in parts:
        for arm, one in part["gripper_overshoot"].items():
            before = overshoot.get(arm, {"clipped": 0, "largest": 0.0})
            overshoot[arm] = {
                "clipped": before["clipped"] + one["clipped"],
                "largest": max(before["largest"], one["largest"]),
            }
    return {
        "episodes": sum(part["episodes"] for part in parts),
        "samples": sum(part["samples"] for part in parts),
        "valid": sum(part["valid"] for part in parts),
        "behind_camera": sum(part["behind_camera"] for part in parts),
        "outside_image": sum(part["outside_image"] for part in parts),
        "invalid_calibration": sum(part["invalid_calibration"] for part in parts),
        "outside_joint_limits": sum(part["outside_joint_limits"] for part in parts),
        "gripper_clipped": sum(part["gripper_clipped"] for part in parts),
        "gripper_overshoot": dict(sorted(overshoot.items())),
    }
