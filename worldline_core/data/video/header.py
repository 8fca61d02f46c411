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
from typing import BinaryIO

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
                raise RejectedInputError(
                    "truncated_video",
                    "Video file is empty",
                    where=str(path),
                    expected="a complete video file",
                    got="0 bytes",
                    next_step="copy the file again; it may be truncated",
                    evidence={"bytes": 0},
                )
            if head[4:8] in _QUICKTIME:
                walk = _Walk(path, size)
                for kind, start, stop in _boxes(stream, 0, size, walk):
                    _check_box(stream, kind, start, stop, walk)
            elif not (head.startswith(_MATROSKA) or (head.startswith(b"RIFF") and head[8:12] == b"AVI ")):
                raise RejectedInputError(
                    "unreadable",
                    "File is no video container",
                    where=str(path),
                    expected="mp4, QuickTime, Matroska, WebM or AVI",
                    got=f"{size} bytes that begin with {head.hex()}",
                )
    except (struct.error, OSError) as error:
        raise RejectedInputError(
            "truncated_video",
            "Video header breaks off",
            where=str(path),
            expected="a complete video file",
            got=str(error),
            next_step="copy the file again; it may be truncated",
        ) from error
    return file


@dataclass
class _Walk:
    """What was counted on the way through one file."""

    path: AnyPath
    size: int
    boxes: int = 0
    samples: int = 0

    def count_samples(self, samples: int) -> None:
        self.samples += samples
        if self.samples > MAX_FRAMES:
            raise too_large(
                "Video claims too many frames",
                where=str(self.path),
                limit=MAX_FRAMES,
                got=self.samples,
                unit="frames",
            )
        if self.samples > self.size:
            raise too_large(
                "Video claims more frames than it has bytes",
                where=str(self.path),
                limit=self.size,
                got=self.samples,
                unit="frames",
            )


def _boxes(stream: BinaryIO, start: int, stop: int, walk: _Walk) -> Iterator[tuple[bytes, int, int]]:
    """(kind, first and last byte of the content) of the boxes between two places, nested ones included."""
    position = start
    while position + 8 <= stop:
        walk.boxes += 1
        if walk.boxes > _MAX_BOXES:
            raise too_large(
                "Video has too many boxes", where=str(walk.path), limit=_MAX_BOXES, got=walk.boxes, unit="boxes"
            )
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
    if kind == b"stsz" and stop - start >= 12:
        stream.seek(start + 8)
        walk.count_samples(struct.unpack(">I", stream.read(4))[0])
    elif kind == b"trun" and stop - start >= 8:
        stream.seek(start + 4)
        walk.count_samples(struct.unpack(">I", stream.read(4))[0])
    elif kind == b"elst" and stop - start >= 8:
        stream.seek(start + 4)
        edits = struct.unpack(">I", stream.read(4))[0]
        if edits > _MAX_EDITS:
            raise too_large("Video has too many edits", where=str(walk.path), limit=_MAX_EDITS, got=edits, unit="edits")
    elif kind == b"stsd" and stop - start >= 8 + 16 + 20:
        stream.seek(start + 8)
        _, codec = struct.unpack(">I4s", stream.read(8))
        stream.seek(start + 8 + 32)
        width, height = struct.unpack(">HH", stream.read(4))
        if codec in _VIDEO_CODECS:
            check_image_size(width, height, str(walk.path))
