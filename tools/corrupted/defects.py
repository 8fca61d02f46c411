"""Defects: what is true about a damaged recording, kept apart from what curation and filtering may see, and those that any file
can have, whatever is in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tools.corrupted.content import NUM_FRAMES

FileDefect = Callable[[Path, np.random.Generator], object]
Source = dict[str, Any]


@dataclass(frozen=True)
class Label:
    """The truth about one listed recording.

    Attributes:
        episode_id: the id in the curated set.
        kind: what was done to it; "clean" when nothing.
        endings: the right ones: "kept", or who quarantines it (curate, filter) with a code that names the defect.
    """

    episode_id: str
    layout: str
    kind: str
    endings: tuple[str, ...]


@dataclass(frozen=True)
class Kind:
    """A defect of one layout.

    Attributes:
        reasons: the codes that name it rightly.
        spoil: what happens to one of the files after a healthy recording was written.
        file: which of the recording's files.
        settings: of the recording that is written.
        listed_as: the id in the curated set, from the recording's id and the name of its file.
    """

    name: str
    reasons: tuple[str, ...] = ()
    spoil: FileDefect | None = None
    file: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    stage: Literal["curate", "filter"] = "curate"
    listed_as: str = "{id}"


@dataclass(frozen=True)
class Layout:
    """Layout of recordings, and the damage that it can have.

    Attributes:
        add: (root, number, random, **settings) -> id and files, by name, of one healthy recording.
        finish: (root, frames of each recording) -> the `curate.sources[]` entry that reads them.
    """

    name: str
    add: Callable[..., tuple[str, dict[str, Path]]]
    finish: Callable[[Path, list[int]], Source]
    kinds: tuple[Kind, ...]

    def write(self, root: Path, healthy: int, each: int, random: np.random.Generator) -> tuple[list[Label], Source]:
        """Write `healthy` clean recordings and `each` of every kind; returns labels and the entry that reads them."""
        root.mkdir(parents=True, exist_ok=True)
        labels, lengths, seed = list[Label](), list[int](), int(random.integers(2**32))
        for kind in (*[Kind("clean")] * healthy, *self.kinds * each):
            number, settings = len(labels), dict(kind.settings)
            drawn = np.random.default_rng([seed, settings.pop("like", number)])
            episode_id, files = self.add(root, number, drawn, **settings)
            path = files.get(kind.file) or next(iter(files.values()))
            if kind.spoil is not None:
                kind.spoil(path, random)
            listed = kind.listed_as.format(id=episode_id, file=path.name)
            endings = tuple(f"{kind.stage}: {reason}" for reason in kind.reasons) or ("kept",)
            labels.append(Label(listed, self.name, kind.name, endings))
            lengths.append(settings.get("num_frames", NUM_FRAMES))
        return labels, {"path": str(root), "name": root.name, **self.finish(root, lengths)}


def on_bytes(change: Callable[[bytes, np.random.Generator], bytes]) -> FileDefect:
    """Other content of the file."""
    return lambda path, random: path.write_bytes(change(path.read_bytes(), random))


truncate = on_bytes(lambda content, random: content[: int(len(content) * random.uniform(0.25, 0.75))])
"""The file ends somewhere between a quarter and three quarters."""
