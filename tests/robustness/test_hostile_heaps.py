"""HDF5 entries of variable length that claim gigabytes, or whose heap makes the library walk for ever."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

h5py = pytest.importorskip("h5py", reason="the extra `hdf5` is not installed")

from worldline_core.data.guards.hdf5 import open_hdf5
from worldline_core.data.guards.rejection import RejectedInputError

IMAGES = [bytes([n]) * (40 + n) for n in range(5)]


def write(path: Path, **settings: object) -> Path:
    with h5py.File(path, "w") as file:
        images = file.create_dataset("images", (5,), dtype=h5py.vlen_dtype(np.uint8), **settings)
        for number, content in enumerate(IMAGES):
            images[number] = np.frombuffer(content, np.uint8)
        file["text"] = ["pick"]
    return path


def entry(path: Path, key: str) -> int:
    """Where the first entry of a dataset lies."""
    with h5py.File(path) as file:
        dataset = file[key]
        return dataset.id.get_offset() if dataset.chunks is None else dataset.id.get_chunk_info(0).byte_offset


def patch(path: Path, place: int, value: bytes) -> None:
    content = bytearray(path.read_bytes())
    content[place : place + len(value)] = value
    path.write_bytes(bytes(content))


FILTERED = [
    {"chunks": (2,), "compression": "gzip"},
    {"chunks": (3,), "compression": "gzip", "shuffle": True},
]


@pytest.mark.parametrize("settings", [{}, {"chunks": (2,)}, *FILTERED])
def test_sound_entries_are_read(tmp_path: Path, settings: dict[str, object]) -> None:
    with open_hdf5(write(tmp_path / "a.h5", **settings)) as file:
        assert list(file.image_files("images", 5)) == IMAGES
        assert file.text("text") == "pick"


@pytest.mark.parametrize("settings", [{}, {"chunks": (2,)}])
def test_an_entry_longer_than_its_file_is_refused_unread(tmp_path: Path, settings: dict[str, object]) -> None:
    path = write(tmp_path / "a.h5", **settings)
    patch(path, entry(path, "images"), struct.pack("<I", 3_000_000_000))
    with open_hdf5(path) as file, pytest.raises(RejectedInputError, match="longer than its file") as caught:
        list(file.image_files("images", 5))
    assert caught.value.reason == "too_large"
    patch(path, entry(path, "text"), struct.pack("<I", 3_000_000_000))
    with open_hdf5(path) as file, pytest.raises(RejectedInputError, match="longer than its file"):
        file.text("text")


@pytest.mark.parametrize("head", [struct.pack("<HHIQ", 0, 0, 0, 0), struct.pack("<HHIQ", 1, 0, 0, 2**40)])
def test_a_heap_that_leads_nowhere_does_not_hang(tmp_path: Path, head: bytes) -> None:
    """The library walks for ever over an object of number and length 0."""
    path = write(tmp_path / "a.h5")
    place = entry(path, "images")
    heap = struct.unpack("<Q", path.read_bytes()[place + 4 : place + 12])[0]
    patch(path, heap + 16, head)
    with open_hdf5(path) as file, pytest.raises(RejectedInputError, match="Heap of the entries is damaged") as caught:
        list(file.image_files("images", 5))
    assert caught.value.reason == "unreadable"


@pytest.mark.parametrize("settings", FILTERED)
def test_a_compressed_entry_longer_than_its_file_is_refused_unread(tmp_path: Path, settings: dict[str, object]) -> None:
    """The chunk is written as a stranger would: lengths of gigabytes, through the library's own filters."""
    path = write(tmp_path / "a.h5", **settings)
    with h5py.File(path, "r+") as file:
        identity = file["images"].id
        filters, rows = identity.get_create_plist(), file["images"].chunks[0]
        entry = struct.pack("<IQI", 3_000_000_000, 2048, 1)
        packed = zlib.compress(entry * rows)
        identity.write_direct_chunk((0,), packed, filter_mask=filters.get_nfilters() - 1)  # without shuffle
    with open_hdf5(path) as file, pytest.raises(RejectedInputError, match=r"longer than its file|Heap of the entries"):
        list(file.image_files("images", 5))


@pytest.mark.parametrize("content", [b"no gzip", zlib.compress(b"x" * (100 << 20)), zlib.compress(b"x" * 7)])
def test_compressed_entries_that_are_none_are_refused(tmp_path: Path, content: bytes) -> None:
    path = write(tmp_path / "a.h5", chunks=(5,), compression="gzip")
    with h5py.File(path, "r+") as file:
        file["images"].id.write_direct_chunk((0,), content)
    with open_hdf5(path) as file, pytest.raises(RejectedInputError, match=r"damaged|cannot be checked"):
        list(file.image_files("images", 5))


def test_entries_behind_other_filters_cannot_be_checked_and_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.h5", chunks=(5,), compression="lzf")
    with open_hdf5(path) as file, pytest.raises(RejectedInputError, match="cannot be checked"):
        list(file.image_files("images", 5))


@pytest.mark.parametrize("dtype", ["i1", "u1", "f2", "f8"])
def test_what_becomes_float64_is_counted_as_float64(tmp_path: Path, dtype: str) -> None:
    """A kilobyte of file, of which the library makes a gigabyte, and the conversion eight."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("state", (200_000_000,), dtype=dtype, chunks=(1_000_000,), compression="gzip")
    assert (tmp_path / "a.h5").stat().st_size < 10_000
    with (
        open_hdf5(tmp_path / "a.h5") as file,
        pytest.raises(RejectedInputError, match="Dataset is too large") as caught,
    ):
        file.array("state", (None,))
    assert caught.value.reason == "too_large"
