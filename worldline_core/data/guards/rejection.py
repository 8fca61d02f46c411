"""Reasons why an input does not get through, as codes that are counted in the quarantine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args

from worldline_core.errors import DataError

Reason = Literal[
    "truncated_video",
    "missing_file",
    "missing_column",
    "missing_view",
    "missing_calibration",
    "unreadable",
    "path_traversal",
    "special_file",
    "too_large",
    "changed_while_reading",
    "invalid_id",
    "nan_state",
    "joint_out_of_range",
    "invalid_gripper",
    "singular_intrinsics",
    "invalid_extrinsics",
    "invalid_distortion",
    "invalid_tool_pose",
    "convention_not_applicable",
    "wrong_fps",
    "length_mismatch",
    "missing_topic",
    "unknown_schema",
    "missing_marker",
    "time_gap",
    "clock_jump",
    "clock_skew",
    "changing_calibration",
    "too_short",
    "duplicate",
    "near_duplicate",
    "scene_leak",
    "duplicate_id",
    "crashed",
]
REASONS: tuple[str, ...] = get_args(Reason)


class RejectedInputError(DataError):
    """A DataError that names the quarantine reason and carries the numbers that show it."""

    def __init__(
        self,
        reason: Reason,
        what: str,
        *,
        where: object | None = None,
        expected: object | None = None,
        got: object | None = None,
        next_step: str | None = None,
        evidence: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(what, where=where, expected=expected, got=got, next_step=next_step)
        self.reason: str = reason
        self.evidence: dict[str, Any] = dict(evidence or {})

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild, (
            self.reason,
            self.what,
            self.where,
            self.expected,
            self.got,
            self.next_step,
            self.evidence,
        )


def _rebuild(
    reason: Reason,
    what: str,
    where: object,
    expected: object,
    got: object,
    next_step: str | None,
    evidence: dict[str, Any],
) -> RejectedInputError:
    return RejectedInputError(
        reason, what, where=where, expected=expected, got=got, next_step=next_step, evidence=evidence
    )
