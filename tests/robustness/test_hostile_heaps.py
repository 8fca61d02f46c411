"""HDF5 entries of variable length that claim gigabytes, or whose heap makes the library walk for ever."""

from __future__ import annotations

import struct
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


@pytest.mark.parametrize("settings", [{}, {"chunks": (2,)}])
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


def test_compressed_entries_cannot_be_checked_and_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.h5", chunks=(5,), compression="gzip")
    with open_hdf5(path) as file, pytest.raises(RejectedInputError, match="cannot be checked"):
        list(file.image_files("images", 5))
