"""How much a recording may declare before it is refused unread, and which files may be opened at all.

A header of some bytes can claim 30,000 x 30,000 pixels, 10^9 frames or 10^12 numbers. Readers compare what a file declares
with these limits before they decode or allocate; none of them stands in the way of a real recording.
"""

from __future__ import annotations

import stat
from collections.abc import Sequence
from pathlib import Path

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, local_file

MAX_SIDE_PX = 16_384
MAX_PIXELS = 40_000_000
"""One image; 8K video has 33 million pixels."""
MAX_FRAMES = 4_000_000
"""One video file: 18 hours at 60 Hz. LeRobot joins episodes into files of some 100 MB, far below."""
MAX_ROWS = 50_000_000
"""One table."""
MAX_TABLE_BYTES = 4 << 30
"""One table in memory."""
MAX_ARRAY_BYTES = 1 << 30
"""One array: an hour at 30 Hz of 100 float64 columns is 0.1 GB."""
MAX_TEXT_BYTES = 512 << 20
"""One JSON or JSON lines file; 10^6 episodes of LeRobot v2.1 are about 150 MB."""
MAX_CHUNK_BYTES = 256 << 20
"""One compressed chunk of an MCAP file once unpacked; recorders write 1 to 10 MB."""


def too_large(what: str, *, where: object, limit: int, got: int, unit: str) -> RejectedInputError:
    """The rejection of something that declares more than a limit."""
    return RejectedInputError(
        "too_large",
        what,
        where=where,
        expected=f"at most {limit:,} {unit}",
        got=f"{got:,} {unit}",
        next_step="the file is damaged or hostile; if it is neither, cut the recording into shorter ones",
        evidence={"declared": int(got), "limit": int(limit), "unit": unit},
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


def regular_file(path: AnyPath, what: str = "File") -> Path:
    """The file to open for `path` (see `local_file`), when it can be read to an end: a pipe would wait for ever, a device
    never ends.

    Raises: RejectedInputError: missing_file, special_file, and what `local_file` raises.
    """
    try:
        local = local_file(path)
        mode = local.stat().st_mode
    except (OSError, ValueError) as error:  # ValueError: a name with a null byte
        raise RejectedInputError(
            "missing_file",
            f"{what} is missing",
            where=str(path),
            got=None if isinstance(error, FileNotFoundError) else str(error),
            next_step="restore the file or drop the episode",
        ) from error
    if not stat.S_ISREG(mode):
        raise RejectedInputError(
            "special_file", f"{what} is no regular file", where=str(path), expected="a regular file", got=_kind(mode)
        )
    return local


def _kind(mode: int) -> str:
    kinds = {
        stat.S_IFDIR: "a folder",
        stat.S_IFIFO: "a pipe",
        stat.S_IFSOCK: "a socket",
        stat.S_IFCHR: "a device",
        stat.S_IFBLK: "a device",
    }
    return kinds.get(stat.S_IFMT(mode), "something else")
