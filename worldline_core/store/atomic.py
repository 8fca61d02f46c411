"""Files that are either whole or absent."""

from __future__ import annotations

import json
import os
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; on success it is flushed to disk and renamed, on an error removed.

    Its name is unique among processes and hosts and keeps the suffix, by which encoders choose the container.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex}.tmp{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb") as stream:
            os.fsync(stream.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes_atomic(path: Path, content: bytes) -> None:
    """Write ``content`` so that a reader sees all of it or none."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_json_atomic(path: Path, value: Any) -> None:
    """Write JSON with sorted keys (equal values give equal bytes); NaN and infinities are refused."""
    write_bytes_atomic(path, (json.dumps(value, sort_keys=True, indent=1, allow_nan=False) + "\n").encode())


def write_arrays_atomic(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays as safetensors."""
    import numpy as np
    from safetensors.numpy import save

    # `save` copies raw memory: a transposed view would be read back in another order.
    ordered = {name: np.ascontiguousarray(array).reshape(array.shape) for name, array in arrays.items()}
    write_bytes_atomic(path, save(ordered))


def write_table_atomic(path: Path, table: pa.Table, *, rows_per_group: Sequence[int] | None = None) -> None:
    """Write a Parquet file; rows_per_group cuts it into row groups of these sizes."""
    import pyarrow.parquet as pq

    with atomic_path(path) as temporary, pq.ParquetWriter(temporary, table.schema, compression="snappy") as writer:
        start = 0
        for size in rows_per_group or [len(table)]:
            writer.write_table(table.slice(start, size), row_group_size=max(size, 1))
            start += size


def remove_unfinished(folder: Path) -> None:
    """Remove the temporary files that a killed process left anywhere below ``folder``."""
    for path in folder.rglob(".*.tmp*"):
        if path.is_file():
            path.unlink()
