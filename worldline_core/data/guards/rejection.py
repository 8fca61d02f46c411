"""Reasons to refuse an input, as codes that the quarantine counts, and the checks of meaning that all readers share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal, cast, get_args

import numpy as np

from worldline_core.config import MAX_PIXELS
from worldline_core.errors import DataError
from worldline_core.store.remote import is_transient
from worldline_core.untrusted_text import unusable_text

Reason = Literal[
    "truncated_video",
    "missing_file",
    "missing_column",
    "missing_view",
    "missing_calibration",
    "not_colour",
    "unreadable",
    "path_traversal",
    "special_file",
    "too_large",
    "changed_while_reading",
    "invalid_id",
    "invalid_text",
    "nan_state",
    "joint_out_of_range",
    "invalid_gripper",
    "contradicting_tracks",
    "singular_intrinsics",
    "invalid_extrinsics",
    "invalid_distortion",
    "invalid_tool_pose",
    "convention_not_applicable",
    "unknown_embodiment",
    "wrong_fps",
    "length_mismatch",
    "missing_topic",
    "unknown_schema",
    "missing_marker",
    "time_gap",
    "clock_jump",
    "clock_skew",
    "conflicting_messages",
    "changing_calibration",
    "too_short",
    "duplicate",
    "near_duplicate",
    "scene_leak",
    "duplicate_id",
    "out_of_time",
    "out_of_memory",
    "crashed",
]
REASONS: tuple[str, ...] = get_args(Reason)

_RATE_TOLERANCE = 1e-2
"""Largest deviation of a video's rate, as a share of the stated one: containers round times."""
MAX_SIDE_PX = 16_384
MAX_COLUMNS = 1_000
"""Columns of one track of a robot, which has some hundreds at most."""
MAX_CHUNK_BYTES = 256 << 20
"""One record of an MCAP file; recorders write chunks of 1 to 10 MB."""


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


@contextmanager
def collect_faults(faults: list[RejectedInputError]) -> Iterator[None]:
    """Append a rejection raised inside of the context to `faults`, to report several at once (`all_of`).

    Raises: a rejection with a transient cause (a network, a busy store).
    """
    try:
        yield
    except RejectedInputError as error:
        if is_transient(error):
            raise
        faults.append(error)


def all_of(faults: Sequence[RejectedInputError], where: object) -> RejectedInputError:
    """One rejection for all faults of a recording, at least one: the first one's reason and numbers, all that they say."""
    first, *others = faults
    if not others:
        return first
    texts = "".join(f"\n    {fault.reason}: " + str(fault).replace("\n", "\n    ") for fault in faults)
    evidence = {**first.evidence, "reasons": [fault.reason for fault in faults]}
    return RejectedInputError(
        cast(Reason, first.reason), f"{len(faults)} things are wrong", where=where, got=texts, evidence=evidence
    )


@contextmanager
def unreadable(
    what: str,
    where: object,
    faults: tuple[type[Exception], ...],
    next_step: str = "copy the file again; it may be damaged",
) -> Iterator[None]:
    """Turns what a library raises for a damaged file into a rejection.

    Raises: RejectedInputError (unreadable; out_of_memory where the library was refused memory).
    """
    try:
        yield
    except (MemoryError, *faults) as error:
        refused = isinstance(error, MemoryError) or "memory" in str(error).lower()
        raise RejectedInputError(
            "out_of_memory" if refused else "unreadable",
            what,
            where=where,
            got=str(error),
            next_step=next_step,
        ) from error


def depth_picture(where: object, got: object) -> RejectedInputError:
    """The rejection of depth where pictures in colour are expected."""
    return RejectedInputError(
        "not_colour",
        "View holds depth, not colour",
        where=where,
        expected="pictures of 8 bits, or in colour",
        got=got,
        next_step="name the camera's colour stream instead",
    )


def too_large(what: str, *, where: object, limit: int, got: int | str, unit: str = "") -> RejectedInputError:
    """The rejection of something that declares more than a limit."""
    return RejectedInputError(
        "too_large",
        what,
        where=where,
        expected=f"at most {limit:,} {unit}".rstrip(),
        got=f"{got:,} {unit}".rstrip() if isinstance(got, int) else got,
        next_step="the file is damaged or hostile; if it is neither, cut the recording into shorter ones",
        evidence={"declared": got, "limit": limit, "unit": unit},
    )


def check_shape(what: str, where: object, found: Sequence[int], wanted: Sequence[int | None]) -> None:
    """Raises: RejectedInputError (length_mismatch) for an array of another shape; None stands for any size but 0."""
    fits = len(found) == len(wanted) and all(
        size > 0 if want is None else size == want for size, want in zip(found, wanted, strict=True)
    )
    if not fits:
        raise RejectedInputError(
            "length_mismatch",
            f"{what} has a wrong shape",
            where=where,
            expected=tuple("N" if want is None else want for want in wanted),
            got=tuple(found),
            evidence={"shape": list(found)},
        )


def check_columns(count: int, where: object) -> None:
    """Raises: RejectedInputError (too_large) for a track, or a message, with more columns than any robot has."""
    if count > MAX_COLUMNS:
        what = "Track has more columns than a robot"
        raise too_large(what, where=where, limit=MAX_COLUMNS, got=count, unit="columns")


def check_texts(texts: Mapping[str, object], where: object) -> None:
    """Raises: RejectedInputError (invalid_text) naming the first entry whose text is no valid Unicode."""
    for name, value in texts.items():
        found = unusable_text(value)
        if found is not None:
            raise RejectedInputError(
                "invalid_text",
                f"Text of {name} cannot be stored",
                where=where,
                expected="valid Unicode, without halves of surrogate pairs",
                got=found,
                next_step="correct the text in the recording's metadata",
                evidence={"field": name},
            )


def check_finite(name: str, values: np.ndarray, where: object) -> None:
    """Raises: RejectedInputError (nan_state) naming the first frame where (N, ...) numbers are not finite."""
    bad = ~np.isfinite(values)
    if bad.any():
        frame, count = int(np.argwhere(bad)[0][0]), int(bad.sum())
        raise RejectedInputError(
            "nan_state",
            f"{name} is not finite",
            where=f"{where}, frame {frame}",
            expected="finite numbers",
            got=f"{count} values that are not",
            evidence={"track": name, "first_frame": frame, "values": count},
        )


def check_image_size(width: int, height: int, where: object) -> None:
    """Raises: RejectedInputError: too_large, or unreadable for an image without pixels."""
    if width < 1 or height < 1:
        raise RejectedInputError(
            "unreadable", "Image has no pixels", where=where, expected="at least 1x1", got=f"{width}x{height}"
        )
    if max(width, height) > MAX_SIDE_PX:
        raise too_large(
            "Image side is too long", where=where, limit=MAX_SIDE_PX, got=max(width, height), unit="pixels a side"
        )
    if width * height > MAX_PIXELS:
        raise too_large("Image has too many pixels", where=where, limit=MAX_PIXELS, got=width * height, unit="pixels")


def check_length(what: str, where: object, *, states: int, unit: str, found: int) -> None:
    """Raises: RejectedInputError (length_mismatch) where there are not as many (images, rows, ...) as states."""
    if found != states:
        raise RejectedInputError(
            "length_mismatch",
            f"{what} and states differ in length",
            where=where,
            expected=f"{states} {unit}",
            got=f"{found} {unit}",
            next_step="copy the recording again, or drop it; videos one frame longer or shorter than the states are kept by "
            "curate.trim: common",
            evidence={"states": states, unit: found},
        )


def check_rate(
    rate: float, wanted: float, where: object, *, tolerance: float | None = None, what: str = "Video"
) -> None:
    """Raises: RejectedInputError (wrong_fps) where a rate is further than `tolerance` [fps] (by default what containers round)
    from the wanted one."""
    if not abs(rate - wanted) <= (_RATE_TOLERANCE * wanted if tolerance is None else tolerance):
        raise RejectedInputError(
            "wrong_fps",
            f"{what} has another frame rate than its recording",
            where=where,
            expected=f"{wanted} fps",
            got=f"{rate} fps",
            evidence={"expected_fps": wanted, "found_fps": rate},
        )
