"""Defects: what is true about a damaged recording, kept apart from what curation and filtering may see, and those that any file
can have, whatever is in it."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from worldline_core.errors import DataError

SECOND = "#source.?"
"""End of the id of an episode that its source lists again; `corpus` puts the source's number in."""
Stage = Literal["kept", "curate", "filter", "stage2"]


@dataclass(frozen=True)
class Label:
    """The truth about one listed recording.

    Attributes:
        episode_id: the id in the curated set.
        kind: what was done to it; "clean" when nothing.
        stage: where it has to be found: kept, quarantined by curation or by the filters, or left out of Stage II.
        reasons: the codes that name the defect rightly.
    """

    episode_id: str
    layout: str
    kind: str
    stage: Stage = "kept"
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True)
class Kind:
    """A defect of one layout: `spoil(files or values, random)` is applied to a healthy recording."""

    name: str
    spoil: Callable[..., Any]
    reasons: tuple[str, ...]
    stage: Stage = "curate"


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
    """A named pipe without a writer in the file's place."""
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
