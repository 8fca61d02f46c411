"""Reason codes of the filters, each in one sentence; docs/filters.md says more."""

from __future__ import annotations

REASONS: dict[str, str] = {
    "static": "Neither the robot nor the picture moves for longer than a pause of manipulation.",
    "reset": "The robot goes back to its first pose at once; what follows is another attempt.",
    "corrupted": "Pictures are blank, noise, garbled, or the same while the robot moves.",
    "too_dark": "Pictures are black or too dark to see anything in.",
    "overexposed": "Much of the sensor is saturated.",
    "blur": "Pictures have lost the finest detail.",
    "base_motion": "Nearly the whole picture changes: the chassis drives.",
    "joint_jump": "A joint reading jumps from one frame to the next.",
    "joint_speed": "A joint is faster than its motor can be.",
    "too_short": "Fewer usable frames than the shortest clip.",
    "unreadable": "The stored images or values cannot be read.",
    "missing_view": "A view that Stage II needs is not there.",
    "missing_calibration": "A view that Stage II needs has no calibration.",
    "missing_kinematics": "Neither tool poses nor the robot's description are known.",
    "missing_actions": "The source has pictures only.",
    "calibration": "K or camera poses cannot be right, or a usual mistake explains the recording better.",
    "calibration_unexplained": "Tools and pictures disagree, and no usual mistake explains it.",
    "projection": "Tools do not lie where the picture moves.",
    "time_alignment": "Pictures, camera poses and states show different instants.",
}
"""By code; a missing one is a code of curation or of a later version."""
