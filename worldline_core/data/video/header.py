"""Which files are videos: containers that hold their own frames. FFmpeg takes a playlist named .mp4 for a list of other
files to open."""

from __future__ import annotations

from pathlib import Path

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, regular_file

_QUICKTIME = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot", b"styp")
_MATROSKA = b"\x1aE\xdf\xa3"


def check_video_header(path: AnyPath) -> Path:
    """The file to open.

    Raises: RejectedInputError: missing_file, special_file, truncated_video (empty), unreadable (no mp4, QuickTime, Matroska,
        WebM or AVI file).
    """
    file = regular_file(path, "Video file")
    try:
        with file.open("rb") as stream:
            head = stream.read(12)
    except OSError as error:
        raise undecodable(path, error) from error
    if not head:
        raise undecodable(path, "0 bytes")
    if not (head[4:8] in _QUICKTIME or head.startswith(_MATROSKA) or (head[:4] == b"RIFF" and head[8:] == b"AVI ")):
        raise RejectedInputError(
            "unreadable",
            "File is no video container",
            where=path,
            expected="mp4, QuickTime, Matroska, WebM or AVI",
            got=f"a file that begins with {head.hex()}",
        )
    return file


def undecodable(path: AnyPath, got: object) -> RejectedInputError:
    """The rejection of a video that breaks off."""
    return RejectedInputError(
        "truncated_video",
        "Video cannot be decoded",
        where=path,
        expected="a complete video file",
        got=got,
        next_step="copy the file again; it may be truncated",
    )
