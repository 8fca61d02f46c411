"""Reasons why an input does not get through, as codes that are counted in the quarantine.

The ids that sources list, made unique and storable: they come from file names and metadata that nobody has checked.
"""

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


MAX_LENGTH = 512


def storable(episode_id: str) -> str:
    """The id as text that every table and terminal can hold; one that already is stays as it is.

    Bytes that are no UTF-8 and control characters are written as escapes, and the middle of a very long id is left out.
    """
    text = episode_id.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
    half = MAX_LENGTH // 2 - 2
    return text if len(text) <= MAX_LENGTH else f"{text[:half]}...{text[-half:]}"


def unique_identity(episode_id: str, source: int, taken: set[str]) -> str:
    """A storable id that is not taken yet: a repeated one gets the number of its source, and of its repetition there."""
    plain = identity = storable(episode_id) or f"unnamed#source.{source}"
    count = 0
    while identity in taken:
        count += 1
        identity = f"{plain}#source.{source}" + (f".{count}" if count > 1 else "")
    return identity


def check_id(episode_id: str, source: str) -> None:
    """Raises: RejectedInputError (invalid_id) for an id that cannot be stored as it is."""
    if storable(episode_id) != episode_id or not episode_id:
        raise RejectedInputError(
            "invalid_id",
            "Episode id cannot be stored",
            where=source,
            expected=f"1 to {MAX_LENGTH} printable characters of valid UTF-8",
            got=ascii(episode_id[:200]),
            next_step="rename the file or folder, or correct the metadata",
            evidence={"characters": len(episode_id)},
        )
