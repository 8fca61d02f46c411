"""Rows of an EpisodeSet's index and quarantine tables."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from worldline_core.data.episodes.episode import EpisodeLabels
from worldline_core.data.guards.plain_files import read_table
from worldline_core.data.guards.rejection import RejectedInputError, unreadable
from worldline_core.data.guards.source_paths import is_file
from worldline_core.errors import DataError
from worldline_core.store.artifact_files import row_schema
from worldline_core.store.atomic import write_table_atomic

INDEX_FILE = "index.parquet"
QUARANTINE_FILE = "quarantine.parquet"


@dataclass(frozen=True, kw_only=True)
class EpisodeRow(EpisodeLabels):
    """One episode, or a kept segment of one: its labels, and its place.

    Attributes:
        dataset: folder of the LeRobot dataset, relative to the set; may be in another artifact.
        start, stop: frames of the stored episode that this row covers, stop exclusive.
        num_frames: stop - start. video_frames: how many of them, from the first on, have images.
        stage2_reason: why not stage2_ok.
        stage1_ok, stage2_ok: whether the row may enter action-free, respectively action-conditioned, training.
        conventions: JSON of what the source declared.
    """

    dataset: str
    episode_index: int
    start: int
    stop: int
    num_frames: int
    video_frames: int
    views: tuple[str, ...]
    stage1_ok: bool = True
    stage2_ok: bool = True
    stage2_reason: str | None = None
    conventions: str = "{}"


# The file's order of columns; their types are those of `EpisodeRow`.
_ORDER = (
    "episode_id", "dataset", "episode_index", "start", "stop", "num_frames", "video_frames",
    "fps", "source", "embodiment", "scene", "task_family", "instruction", "outcome", "split",
    "views", "bank", "candidate", "primary_view", "stage1_ok", "stage2_ok", "stage2_reason", "conventions",
)  # fmt: skip
_INDEX = pa.schema([row_schema(EpisodeRow).field(name) for name in _ORDER])
_NULLABLE = ("bank", "candidate", "stage2_reason")


@dataclass(frozen=True)
class QuarantineRow:
    """An input that did not get through, why, and the numbers that show it (`evidence` is JSON)."""

    episode_id: str
    source: str
    reason: str
    detail: str
    evidence: str = "{}"

    @property
    def numbers(self) -> dict[str, Any]:
        return json.loads(self.evidence)


_QUARANTINE = row_schema(QuarantineRow)


def write_index(root: Path, rows: Iterable[EpisodeRow]) -> None:
    """Write index.parquet."""
    listed = [asdict(row) | {"views": list(row.views)} for row in rows]
    write_table_atomic(root / INDEX_FILE, pa.Table.from_pylist(listed, schema=_INDEX))


def read_index(root: Path) -> list[EpisodeRow]:
    """Rows of index.parquet; equal texts are one object.

    Raises: DataError when the file or a column is missing, or holds values of another kind.
    """
    path = root / INDEX_FILE
    table = read_table(path, _INDEX.names)
    with unreadable("Index holds values of another kind", path, (pa.ArrowException, ValueError)):
        table = table.select(_INDEX.names).cast(_INDEX)
    empty = [name for name in _INDEX.names if name not in _NULLABLE and table[name].null_count]
    if empty:
        raise RejectedInputError(
            "unreadable", "Index has empty fields", where=path, expected="a value", got=", ".join(empty)
        )
    columns = map(_shared_values, table.columns)
    return [EpisodeRow(**dict(zip(_INDEX.names, values, strict=True))) for values in zip(*columns, strict=True)]


def _shared_values(column: pa.ChunkedArray) -> list[Any]:
    """Python values of a column; equal ones are one object."""
    values = (tuple(value) if isinstance(value, list) else value for value in column.to_pylist())
    known: dict[Any, Any] = {}
    return [known.setdefault(value, value) for value in values]


def write_quarantine(root: Path, rows: Iterable[QuarantineRow]) -> None:
    """Write quarantine.parquet, ordered by episode and reason."""
    ordered = sorted(rows, key=lambda row: (row.episode_id, row.source, row.reason))
    write_table_atomic(
        root / QUARANTINE_FILE, pa.Table.from_pylist([asdict(row) for row in ordered], schema=_QUARANTINE)
    )


def nothing_kept(what: str, root: Path, rows: Sequence[QuarantineRow], next_step: str) -> DataError:
    """The error of a step that keeps no episode: counts by reason, and of each reason one case in full. Writes
    quarantine.parquet."""
    write_quarantine(root, rows)
    if not rows:
        return DataError(what, where=root, got="no episodes at all", next_step=next_step)
    counts = ", ".join(f"{count} {reason}" for reason, count in Counter(row.reason for row in rows).most_common())
    first = {row.reason: row for row in sorted(rows, key=lambda row: row.episode_id, reverse=True)}
    cases = sorted(first.values(), key=lambda row: row.episode_id)
    shown = (f"the first, {row.episode_id} ({row.reason}): {row.detail}" for row in cases)
    return DataError(
        what,
        where=root / QUARANTINE_FILE,
        got="\n    ".join([f"{len(rows)} quarantined ({counts})", *(text.replace("\n", "\n    ") for text in shown)]),
        next_step=next_step,
    )


def read_quarantine(root: Path) -> list[QuarantineRow]:
    """Rows of quarantine.parquet; a set without the file has an empty quarantine."""
    path = root / QUARANTINE_FILE
    return [QuarantineRow(**row) for row in read_table(path, _QUARANTINE.names).to_pylist()] if is_file(path) else []
