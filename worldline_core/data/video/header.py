"""What a video file claims about itself, read from its boxes before FFmpeg sees it.

FFmpeg builds an index entry for every sample that an mp4 claims (2 GB for a header of 89 million samples), and takes
a playlist named .mp4 for a list of other files to open. Here only containers that hold their own frames get through,
and only with counts that their size can back. Boxes: ISO/IEC 14496-12.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from worldline_core.data.guards.rejection import MAX_FRAMES, RejectedInputError, check_image_size, too_large
from worldline_core.data.guards.source_paths import AnyPath, regular_file

_QUICKTIME = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot", b"styp")
_MATROSKA = b"\x1aE\xdf\xa3"
# Entries of other kinds of tracks have no size at this place; for codecs not named here FFmpeg's own limit holds.
_VIDEO_CODECS = (b"avc1", b"avc3", b"hvc1", b"hev1", b"av01", b"vp08", b"vp09", b"mp4v", b"jpeg", b"mjpa", b"png ")
_NESTED = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"moof", b"traf")
_MAX_BOXES = 100_000
_MAX_EDITS = 10_000


def check_video_header(path: AnyPath) -> Path:
    """The file to open, when its header is credible.

    Raises: RejectedInputError: missing_file, special_file, truncated_video (empty, or boxes that break off),
    unreadable (no mp4, QuickTime, Matroska, WebM or AVI file), too_large.
    """
    file = regular_file(path, "Video file")
    try:
        with file.open("rb") as stream:
            size = file.stat().st_size
            head = stream.read(12)
            if size == 0:
                raise undecodable(path, "0 bytes")
            if head[4:8] in _QUICKTIME:
                walk = _Walk(path, size)
                for kind, start, stop in _boxes(stream, 0, size, walk):
                    _check_box(stream, kind, start, stop, walk)
            elif not (head.startswith(_MATROSKA) or (head.startswith(b"RIFF") and head[8:12] == b"AVI ")):
                raise RejectedInputError(
                    "unreadable",
                    "File is no video container",
                    where=path,
                    expected="mp4, QuickTime, Matroska, WebM or AVI",
                    got=f"{size} bytes that begin with {head.hex()}",
                )
    except (struct.error, OSError) as error:
        raise undecodable(path, f"a header that breaks off: {error}") from error
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


@dataclass
class _Walk:
    """What was counted on the way through one file."""

    path: AnyPath
    size: int
    boxes: int = 0
    samples: int = 0

    def count_samples(self, samples: int) -> None:
        self.samples += samples
        for limit, what in ((MAX_FRAMES, "too many frames"), (self.size, "more frames than it has bytes")):
            if self.samples > limit:
                raise too_large(f"Video claims {what}", where=self.path, limit=limit, got=self.samples, unit="frames")


def _boxes(stream: BinaryIO, start: int, stop: int, walk: _Walk) -> Iterator[tuple[bytes, int, int]]:
    """(kind, first and last byte of the content) of the boxes between two places, nested ones included."""
    position = start
    while position + 8 <= stop:
        walk.boxes += 1
        if walk.boxes > _MAX_BOXES:
            raise too_large("Video has too many boxes", where=walk.path, limit=_MAX_BOXES, got=walk.boxes, unit="boxes")
        stream.seek(position)
        length, kind = struct.unpack(">I4s", stream.read(8))
        content = position + 8
        if length == 1:
            length, content = struct.unpack(">Q", stream.read(8))[0], position + 16
        end = stop if length == 0 else position + length
        if end < content or end > stop:
            return  # cut off or senseless: FFmpeg decides what of it can be decoded
        if kind in _NESTED:
            yield from _boxes(stream, content, end, walk)
        else:
            yield kind, content, end
        position = end


def _check_box(stream: BinaryIO, kind: bytes, start: int, stop: int, walk: _Walk) -> None:
    def read(offset: int, layout: str) -> tuple[Any, ...]:
        stream.seek(start + offset)
        return struct.unpack(layout, stream.read(struct.calcsize(layout)))

    if kind == b"stsz" and stop - start >= 12:
        walk.count_samples(*read(8, ">I"))
    elif kind == b"trun" and stop - start >= 8:
        walk.count_samples(*read(4, ">I"))
    elif kind == b"elst" and stop - start >= 8:
        (edits,) = read(4, ">I")
        if edits > _MAX_EDITS:
            raise too_large("Video has too many edits", where=walk.path, limit=_MAX_EDITS, got=edits, unit="edits")
    elif kind == b"stsd" and stop - start >= 8 + 16 + 20:
        _, codec = read(8, ">I4s")
        width, height = read(8 + 32, ">HH")
        if codec in _VIDEO_CODECS:
            check_image_size(width, height, walk.path)
