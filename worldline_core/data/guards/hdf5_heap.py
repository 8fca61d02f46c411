"""What entries of variable length in an HDF5 file claim, checked before the library allocates it.

An entry is a length (4 bytes), the address of a heap and an index into it. The library allocates the length, up to 4 GB
each, and walks through the heap's objects forever where one has no size. No entry can be longer than its file, and every
object must lead on to the next. (HDF5 file format specification, "Global Heap" and "Variable-Length".)
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from worldline_core.data.guards.rejection import MAX_ARRAY_BYTES, RejectedInputError, too_large

_LARGEST_OFFSET = 2**62
_GZIP, _SHUFFLE = 1, 2
_ENTRY = np.dtype([("length", "<u4"), ("address", "<u8"), ("index", "<u4")])


def check_entries(dataset: Any, start: int, stop: int, path: Path, where: str) -> None:
    """Entries start..stop (exclusive) of a dataset of variable length: none longer than the file, nor all of them together
    than an array may be, and sound heaps.

    Raises: RejectedInputError (too_large); (unreadable) for a damaged heap, and for entries behind filters other than gzip
        and shuffle, which cannot be seen.
    """
    entries = _entries(dataset, start, stop, path, where)
    lengths = entries["length"].astype(np.int64)
    if not len(lengths):
        return
    with path.open("rb") as stream:
        for address in np.unique(entries["address"][lengths > 0]).tolist():
            _check_heap(stream, address, where)
    size = path.stat().st_size
    if int(lengths.max()) > size:
        raise too_large(
            "Entry is longer than its file", where=where, limit=size, got=int(lengths.max()), unit="elements"
        )
    if int(lengths.sum()) > MAX_ARRAY_BYTES:
        raise too_large(
            "Entries are too long", where=where, limit=MAX_ARRAY_BYTES, got=int(lengths.sum()), unit="elements"
        )


def _entries(dataset: Any, start: int, stop: int, path: Path, where: str) -> np.ndarray:
    """The entries as the file has them; none where nothing was ever written."""
    if dataset.chunks is None:
        offset = dataset.id.get_offset()
        if offset is None:
            return np.zeros(0, dtype=_ENTRY)
        _check_stored(dataset.id.get_storage_size(), dataset.size, where)
        return _read(path, offset + start * _ENTRY.itemsize, stop - start, where)
    settings, rows = dataset.id.get_create_plist(), dataset.chunks[0]
    filters = [settings.get_filter(number)[0] for number in range(settings.get_nfilters())]
    if not set(filters) <= {_GZIP, _SHUFFLE}:
        raise _unseen(where, f"filters {filters}")
    found = []
    for chunk in range(start // rows, -(-stop // rows)):
        info = dataset.id.get_chunk_info_by_coord((chunk * rows,))
        if info.byte_offset is not None:
            with path.open("rb") as stream:
                stream.seek(info.byte_offset)
                content = stream.read(info.size)
            content = _unfiltered(content, filters, info.filter_mask, rows * _ENTRY.itemsize, where)
            _check_stored(len(content), rows, where)
            found.append(np.frombuffer(content, _ENTRY))
    return np.concatenate(found) if found else np.zeros(0, dtype=_ENTRY)


def _unfiltered(content: bytes, filters: Sequence[int], skipped: int, size: int, where: str) -> bytes:
    """A chunk before its filters, which were applied in their order; bit n of `skipped`: not filter n."""
    for number, applied in reversed(list(enumerate(filters))):
        if skipped >> number & 1:
            continue
        if applied == _SHUFFLE:
            whole = len(content) // _ENTRY.itemsize * _ENTRY.itemsize
            shuffled = np.frombuffer(content[:whole], np.uint8).reshape(_ENTRY.itemsize, -1)
            content = shuffled.T.tobytes() + content[whole:]
        else:
            try:
                content = zlib.decompressobj().decompress(content, size + 1)
            except zlib.error as error:
                raise RejectedInputError("unreadable", "Entries are damaged", where=where, got=str(error)) from error
    return content


def _check_stored(stored: int, entries: int, where: str) -> None:
    """Files with addresses of another size than 8 bytes have entries of another size."""
    if stored != entries * _ENTRY.itemsize:
        raise _unseen(where, f"{stored} bytes for {entries} entries")


def _read(path: Path, offset: int, count: int, where: str) -> np.ndarray:
    with path.open("rb") as stream:
        stream.seek(offset)
        content = stream.read(count * _ENTRY.itemsize)
    if len(content) != count * _ENTRY.itemsize:
        raise RejectedInputError("unreadable", "Entries lie beyond the end of the file", where=where)
    return np.frombuffer(content, _ENTRY)


def _check_heap(stream: BinaryIO, address: int, where: str) -> None:
    stream.seek(min(address, _LARGEST_OFFSET))
    head = stream.read(16)
    size = int.from_bytes(head[8:16], "little")
    sound = head[:4] == b"GCOL" and len(head) == 16
    position = 16
    while sound and position + 16 <= size:
        stream.seek(address + position)
        number, _, _, length = struct.unpack("<HHIQ", stream.read(16).ljust(16, b"\0"))
        # Number 0 is the free space at the end; its length counts its own head.
        step = length if number == 0 else 16 + (length + 7) // 8 * 8
        sound = 16 <= step <= size - position
        position += step
    if not sound:
        raise RejectedInputError(
            "unreadable",
            "Heap of the entries is damaged",
            where=where,
            expected="objects one after the other",
            got=f"a step that leads nowhere at {address + position}",
        )


def _unseen(where: str, got: str) -> RejectedInputError:
    return RejectedInputError(
        "unreadable",
        "Lengths of the entries cannot be checked",
        where=where,
        expected="entries of variable length, plain or behind gzip and shuffle",
        got=got,
    )
