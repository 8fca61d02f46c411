"""Defects that any file can have, whatever is in it."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from worldline_core.errors import DataError

FileDefect = Callable[[Path, np.random.Generator], None]


def truncate(path: Path, random: np.random.Generator) -> None:
    """The file ends somewhere between a quarter and three quarters."""
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * random.uniform(0.25, 0.75))])


def empty(path: Path, random: np.random.Generator) -> None:
    """Nothing is left in the file."""
    path.write_bytes(b"")


def garbage(path: Path, random: np.random.Generator) -> None:
    """Random bytes instead of the content."""
    path.write_bytes(random.bytes(path.stat().st_size))


def missing(path: Path, random: np.random.Generator) -> None:
    """The file is not there."""
    path.unlink()


def pipe(path: Path, random: np.random.Generator) -> None:
    """A named pipe nobody writes to lies in the file's place."""
    path.unlink()
    os.mkfifo(path)


def link_out(path: Path, random: np.random.Generator) -> None:
    """The file was moved out of the dataset, and a link leads to it."""
    target = _outside(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    path.rename(target)
    path.symlink_to(target)


def _outside(path: Path) -> Path:
    """A place beside the corpus: the first folder above named `corpus` ends it."""
    for parent in path.parents:
        if parent.name == "corpus":
            return parent.parent / "outside" / "-".join(path.relative_to(parent).parts)
    raise DataError("A corrupted corpus lies in a folder named corpus", where=str(path))


def claim_pixels(path: Path, random: np.random.Generator) -> None:
    """The mp4 header claims 30,000 x 30,000 pixels."""
    content = bytearray(path.read_bytes())
    entry = content.index(b"avc1", content.index(b"stsd"))
    content[entry + 28 : entry + 32] = struct.pack(">HH", 30_000, 30_000)
    path.write_bytes(bytes(content))


def claim_frames(path: Path, random: np.random.Generator) -> None:
    """The mp4 header claims 10^9 frames."""
    content = bytearray(path.read_bytes())
    table = content.index(b"stsz") + 4
    content[table + 8 : table + 12] = struct.pack(">I", 10**9)
    path.write_bytes(bytes(content))
