"""What the chunks of an MCAP file unpack to, checked before any is unpacked.

The reader believes a chunk: it allocates what a zstd frame claims, and unpacks an lz4 frame to its end, 255 bytes for one.
Records: https://mcap.dev/spec. An opcode, a length of 8 bytes, then the record.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap.exceptions import McapError

from worldline_core.data.guards.limits import MAX_CHUNK_BYTES, too_large
from worldline_core.data.guards.rejection import RejectedInputError

# What the reader raises for a damaged file: its own errors, and those of the decompressors and parsers below it.
DAMAGE = (
    McapError,
    zstandard.ZstdError,
    EOFError,
    ValueError,
    RuntimeError,
    KeyError,
    IndexError,
    struct.error,
    OverflowError,
    MemoryError,
)
_MAGIC = b"\x89MCAP0\r\n"
_CHUNK = 0x06
_DATA_END = 0x0F
_LZ4_RATIO = 255


def check_chunks(path: Path, where: object) -> None:
    """Every chunk up to the end of the data section.

    Raises: RejectedInputError: too_large, or unreadable for what is no MCAP file or breaks off.
    """
    size = path.stat().st_size
    try:
        with path.open("rb") as stream:
            if stream.read(len(_MAGIC)) != _MAGIC:
                raise _damaged(where, "another beginning than that of an MCAP file")
            position = len(_MAGIC)
            while position < size:
                stream.seek(position)
                opcode, length = struct.unpack("<BQ", stream.read(9))
                position += 9 + length
                if opcode == _DATA_END:
                    return
                if position > size:
                    raise _damaged(where, f"a record of {length} bytes where {size - position + length} are left")
                if opcode == _CHUNK:
                    _check_chunk(stream, length, where)
    except (struct.error, OSError) as error:
        raise _damaged(where, str(error)) from error


def _check_chunk(stream: BinaryIO, length: int, where: object) -> None:
    *_, declared, _, name_length = struct.unpack("<QQQII", stream.read(32))
    if declared > MAX_CHUNK_BYTES:
        raise too_large("MCAP chunk is too large", where=where, limit=MAX_CHUNK_BYTES, got=declared, unit="bytes")
    if name_length > 32:
        raise _damaged(where, f"a name of a compression of {name_length} bytes")
    compression = stream.read(name_length)
    packed_length = struct.unpack("<Q", stream.read(8))[0]
    if packed_length > length:
        raise _damaged(where, f"a chunk of {packed_length} bytes in a record of {length}")
    head = stream.read(min(packed_length, 32))
    unpacked = declared
    if compression == b"zstd":
        try:
            unpacked = max(0, zstandard.frame_content_size(head))  # -1: not stated, `declared` is then the bound
        except zstandard.ZstdError as error:
            raise _damaged(where, str(error)) from error
    elif compression == b"lz4" and packed_length * _LZ4_RATIO > MAX_CHUNK_BYTES:
        # Its stated size binds nobody; only when it is this long can it unpack to too much.
        stream.seek(-len(head), 1)
        unpacked = _lz4_size(stream.read(packed_length), where)
    if unpacked > MAX_CHUNK_BYTES:
        raise too_large("MCAP chunk is too large", where=where, limit=MAX_CHUNK_BYTES, got=unpacked, unit="bytes")


def _lz4_size(packed: bytes, where: object) -> int:
    """Bytes that a frame unpacks to, at most one more than allowed."""
    try:
        return len(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=MAX_CHUNK_BYTES + 1))
    except RuntimeError as error:
        raise _damaged(where, str(error)) from error


def _damaged(where: object, got: str) -> RejectedInputError:
    return RejectedInputError(
        "unreadable", "MCAP file is damaged", where=where, expected="a complete MCAP file", got=got
    )
