"""The account of a mapped run: one row an input, a Parquet file a shard, merged at the end.

Kept in the step's `run/` folder: seconds differ from run to run and belong to no digest. Rows of episodes that an
earlier, killed run finished without writing its account have no seconds.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Literal

import pyarrow as pa
import pyarrow.parquet as pq

from worldline_core.errors import DataError
from worldline_core.store.atomic import atomic_path

FOLDER = "run/inputs"
MERGED = "run/inputs.parquet"


@dataclass(frozen=True)
class InputRow:
    """One input and what became of it.

    Attributes:
        digest: of the recorded content, where it was read; empty for what did not get so far.
        stored_bytes: what the result of this input takes on disk.
        seconds, cpu_seconds: time on the clock and of the processor.
    """

    episode_id: str
    source: str
    status: Literal["kept", "quarantined"]
    reason: str | None
    digest: str
    stored_bytes: int
    seconds: float | None = None
    cpu_seconds: float | None = None


_SCHEMA = pa.schema(
    [
        ("episode_id", pa.string()),
        ("source", pa.string()),
        ("status", pa.string()),
        ("reason", pa.string()),
        ("digest", pa.string()),
        ("stored_bytes", pa.int64()),
        ("seconds", pa.float64()),
        ("cpu_seconds", pa.float64()),
    ]
)


def write_shard_manifest(output: Path, name: str, rows: Iterable[InputRow]) -> None:
    """Write the account of one shard."""
    _write(output / FOLDER / f"{name}.parquet", rows)


def read_shard_manifests(output: Path) -> dict[str, InputRow]:
    """The rows of all shards by episode id; of two rows of an episode the one that did the work counts."""
    found: dict[str, InputRow] = {}
    for path in sorted((output / FOLDER).glob("*.parquet")):
        if path.name.startswith("."):
            continue
        for row in _read(path):
            known = found.get(row.episode_id)
            if known is None or known.seconds is None:
                found[row.episode_id] = row
    return found


def write_merged_manifest(output: Path, rows: Sequence[InputRow]) -> None:
    """Write the account of the whole run."""
    _write(output / MERGED, rows)


def read_merged_manifest(output: Path) -> list[InputRow]:
    """The account of a finished run."""
    return _read(output / MERGED)


def check_account(found: int, kept: set[str], quarantined: set[str], rows: Sequence[InputRow], where: Path) -> None:
    """Raises: DataError unless every input found is in the account once, as kept or as quarantined, and the results agree."""
    by_status = {
        "kept": {row.episode_id for row in rows if row.status == "kept"},
        "quarantined": {row.episode_id for row in rows if row.status == "quarantined"},
    }
    whole = len(rows) == found == len(kept) + len(quarantined)
    if whole and by_status["kept"] == kept and by_status["quarantined"] == quarantined:
        return
    raise DataError(
        "Inputs were lost between the sources and the result",
        where=str(where),
        expected=f"kept + quarantined = {found}, in the account and in the result",
        got=f"{len(by_status['kept'])} + {len(by_status['quarantined'])} in the account, "
        f"{len(kept)} + {len(quarantined)} in the result",
        next_step="remove the unfinished folder and run the step again",
    )


def _write(path: Path, rows: Iterable[InputRow]) -> None:
    with atomic_path(path) as temporary:
        pq.write_table(pa.Table.from_pylist([asdict(row) for row in rows], schema=_SCHEMA), temporary)


def _read(path: Path) -> list[InputRow]:
    names = [field.name for field in fields(InputRow)]
    return [InputRow(**row) for row in pq.read_table(path, columns=names).to_pylist()]
