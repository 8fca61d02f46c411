"""The account of a mapped run: one row per input. A Parquet file per shard, merged at the end.

Kept in the step's `run/` folder: seconds differ from run to run and belong to no digest. Rows of episodes that an
earlier, killed run finished without writing its account have no seconds.
"""

from __future__ import annotations

import re
import traceback
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
import pyarrow.parquet as pq

from worldline_core.errors import DataError
from worldline_core.store.artifact_files import digest_value, row_schema
from worldline_core.store.atomic import write_table_atomic

SHARDS_FOLDER = "run/inputs"
MERGED_FILE = "run/inputs.parquet"


@dataclass(frozen=True, kw_only=True)
class InputRow:
    """One input and what became of it.

    Attributes:
        digest: of the recorded content, where it was read; empty for what did not get so far.
        stored_bytes: size of this input's result on disk.
        seconds: wall-clock time.
    """

    episode_id: str
    source: str
    status: Literal["kept", "quarantined"]
    reason: str | None = None
    digest: str = ""
    stored_bytes: int = 0
    seconds: float | None = None


_SCHEMA = row_schema(InputRow)


def write_shard_account(output: Path, number: int, rows: Sequence[InputRow]) -> None:
    """Write what a shard did. Other episodes get another file: a resumed shard overwrites nothing."""
    name = f"shard-{number:06d}-{digest_value([row.episode_id for row in rows])[:12]}.parquet"
    _write(output / SHARDS_FOLDER / name, rows)


def write_account(output: Path, rows: Iterable[InputRow]) -> None:
    """Write the account of the whole run: the given rows, with the times that the shards noted."""
    timed: dict[str, InputRow] = {}
    for path in sorted((output / SHARDS_FOLDER).glob("*.parquet")):
        if not path.name.startswith("."):
            # Of two rows of an episode the one that did the work counts.
            timed |= {row.episode_id: row for row in _read(path) if row.seconds is not None}
    merged = []
    for row in rows:
        known = timed.get(row.episode_id, row)
        merged.append(replace(row, seconds=known.seconds))
    _write(output / MERGED_FILE, merged)


def read_account(output: Path) -> list[InputRow]:
    """The account of a finished run."""
    return _read(output / MERGED_FILE)


def check_account(output: Path, found: int, kept: set[str], quarantined: set[str]) -> None:
    """Compare the account of a run with its result.

    Raises: DataError unless each of the inputs `found` is in the account once, as kept or as quarantined, and the result
        has it the same way.
    """
    rows = read_account(output)
    by_status = {status: {row.episode_id for row in rows if row.status == status} for status in ("kept", "quarantined")}
    complete = len(rows) == found == len(kept) + len(quarantined)
    if complete and by_status == {"kept": kept, "quarantined": quarantined}:
        return
    raise DataError(
        "Inputs were lost between the sources and the result",
        where=output,
        expected=f"kept + quarantined = {found}, in the account and in the result",
        got=f"{len(by_status['kept'])} + {len(by_status['quarantined'])} in the account, "
        f"{len(kept)} + {len(quarantined)} in the result",
        next_step="remove the unfinished folder and run the step again",
    )


def _write(path: Path, rows: Iterable[InputRow]) -> None:
    write_table_atomic(
        path,
        pa.Table.from_pylist([{name: getattr(row, name) for name in _SCHEMA.names} for row in rows], schema=_SCHEMA),
    )


def _read(path: Path) -> list[InputRow]:
    return [InputRow(**row) for row in pq.read_table(path, columns=_SCHEMA.names).to_pylist()]


_ADDRESS = re.compile(r"0x[0-9a-fA-F]{4,}")
_ABSOLUTE = re.compile(r"(?<![\w.:/])/(?:[^\s'\":,;()]+/)+")
_FRAMES = 5
_PACKAGE_ROOT = Path(__file__).parents[2]


def crash_evidence(error: BaseException) -> dict[str, Any]:
    """Evidence of an unforeseen error, without this machine's paths: {"type", "message", "trace"}.

    The trace is the innermost frames as `file:line function`, innermost last.
    """
    frames = traceback.extract_tb(error.__traceback__)[-_FRAMES:]
    return {
        "type": type(error).__name__,
        "message": portable_message(str(error)),
        "trace": [f"{_within_package(frame.filename)}:{frame.lineno} {frame.name}" for frame in frames],
    }


def portable_message(text: str) -> str:
    """A message without memory addresses and folders: it must not differ from run to run."""
    return _ABSOLUTE.sub("", _ADDRESS.sub("0x…", text))


def _within_package(filename: str) -> str:
    path = Path(filename)
    if "site-packages" in path.parts:
        return "/".join(path.parts[path.parts.index("site-packages") + 1 :])
    return path.relative_to(_PACKAGE_ROOT).as_posix() if path.is_relative_to(_PACKAGE_ROOT) else path.name
