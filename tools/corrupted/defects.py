"""Defects: what is true about a damaged recording, kept apart from what curation and filtering may see, and those that any file
can have, whatever is in it."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

Stage = Literal["kept", "curate", "filter"]


@dataclass(frozen=True)
class Label:
    """The truth about one listed recording.

    Attributes:
        episode_id: the id in the curated set.
        kind: what was done to it; "clean" when nothing.
        stage: where it has to be found: kept, or quarantined by curation or by the filters.
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


FileDefect = Callable[[Path, np.random.Generator], None]


def truncate(path: Path, random: np.random.Generator) -> None:
    """The file ends somewhere between a quarter and three quarters."""
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * random.uniform(0.25, 0.75))])


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
    """A link to a file elsewhere."""
    path.unlink()
    path.symlink_to(Path(__file__).resolve())
