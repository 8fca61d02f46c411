"""Text, JSON, NumPy and Parquet files that are not to be trusted: bounded in size, and every fault is named.

JSON may repeat no key; NaN and infinities are read as what they are: recorders write them, and the checks of values say
where they stand. A .npy file must hold what its header declares. Of Parquet tables rows and bytes are bounded.
"""

from __future__ import annotations

import json
import math
import tokenize
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.lib import format as npy
from pydantic import BaseModel, ValidationError

from worldline_core.data.guards.rejection import (
    MAX_ARRAY_BYTES,
    MAX_ROWS,
    MAX_TABLE_BYTES,
    MAX_TEXT_BYTES,
    RejectedInputError,
    too_large,
    unreadable,
)
from worldline_core.data.guards.source_paths import AnyPath, regular_file


def read_json(path: AnyPath) -> Any:
    """JSON of a file.

    Raises: RejectedInputError: missing_file, special_file, too_large, unreadable (no UTF-8, no JSON, a key given twice,
        nested too deeply, a number of thousands of digits).
    """
    return parse_json(read_text(path), path)


def parse_json(text: str | bytes, where: object) -> Any:
    """JSON of a text.

    Raises: RejectedInputError (unreadable).
    """
    # ValueError: of the decoder, of UTF-8, of a key given twice, of a number with too many digits.
    with unreadable("File is not valid JSON", where, (ValueError, RecursionError)):
        return json.loads(text, object_pairs_hook=_without_repetition)


def read_json_lines(path: AnyPath) -> Iterator[Any]:
    """The values of a file with one JSON value per line; empty lines are skipped.

    Raises: RejectedInputError as `read_json`, naming the line.
    """
    for number, line in enumerate(read_text(path).splitlines(), 1):
        if line.strip():
            yield parse_json(line, f"{path}, line {number}")


def read_text(path: AnyPath, *, max_bytes: int = MAX_TEXT_BYTES, encoding: str = "utf-8") -> str:
    """The text of a file.

    Raises: RejectedInputError: missing_file, special_file, too_large, unreadable (no UTF-8).
    """
    file = regular_file(path, "Text file", max_bytes=max_bytes)
    with unreadable("File cannot be read as text", path, (OSError, UnicodeDecodeError)):
        return file.read_text(encoding=encoding)


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) != len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))
        raise ValueError(f"the key {twice!r} is given twice")
    return values


@contextmanager
def expect_layout(where: object, layout: str) -> Iterator[None]:
    """Reject the file when parsed content read inside of the context has another shape than `layout` says.

    Raises: RejectedInputError (unreadable) for a missing key, another type, another length, a number out of range.
    """
    try:
        yield
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise RejectedInputError(
            "unreadable",
            "Content has another shape than its layout",
            where=where,
            expected=layout,
            got=f"{type(error).__name__}: {error}",
        ) from error


def validated[M: BaseModel](model: type[M], content: Any, where: object, what: str) -> M:
    """Parsed content as a model.

    Raises: RejectedInputError (missing_column) at the first key that is missing, unknown or of another kind.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        raise RejectedInputError(
            "missing_column",
            f"{what} is not understood",
            where=", ".join([str(where), ".".join(map(str, first["loc"]))]),
            expected=first["msg"],
            next_step="see the layout in docs/sources.md",
        ) from error


_NPY_FAULTS = (ValueError, TypeError, SyntaxError, EOFError, OSError, OverflowError, tokenize.TokenError)


def read_npy(path: AnyPath) -> np.ndarray:
    """The array of a .npy file; never unpickles.

    Raises: RejectedInputError: missing_file, special_file, too_large, unreadable (damaged, of objects, or cut off).
    """
    file = regular_file(path)
    with unreadable("Array cannot be read", path, _NPY_FAULTS), file.open("rb") as stream:
        size = file.stat().st_size
        version = npy.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"format version {version}")
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, fortran_order, dtype = read_header(stream)
        if dtype.hasobject:
            raise ValueError("an array of Python objects")
        declared = math.prod(shape) * dtype.itemsize
        if declared > MAX_ARRAY_BYTES:
            raise too_large("Array is too large", where=path, limit=MAX_ARRAY_BYTES, got=declared, unit="bytes")
        if declared != size - stream.tell():
            raise ValueError(f"{size - stream.tell()} bytes of data where the header declares {declared}")
        values = np.frombuffer(stream.read(declared), dtype=dtype)
        return values.reshape(shape, order="F" if fortran_order else "C").copy()


# A dictionary of long texts unpacks to far more than the footer says. No text is longer than its column chunk, so tables
# with texts are read in batches of so many rows that no batch exceeds the limit by much.
_BATCH_BYTES = 256 << 20
_BATCH_ROWS = (64, 65_536)
_FAULTS = (pa.ArrowException, OSError, ValueError, TypeError, OverflowError, MemoryError)
"""ArrowException covers ArrowInvalid, ArrowNotImplementedError and ArrowMemoryError of a header that asks for too much."""


def read_table(path: AnyPath, columns: Sequence[str] | None = None) -> pa.Table:
    """A Parquet file as a table.

    Raises: RejectedInputError: missing_file, special_file, missing_column (the message names it), too_large, unreadable.
    """
    local = regular_file(path)
    # No memory map: where somebody shortens the file meanwhile, a map ends in a signal instead of an error.
    with unreadable("Parquet file cannot be read", path, _FAULTS), pq.ParquetFile(local, memory_map=False) as file:
        names = file.schema_arrow.names
        missing = [column for column in columns or () if column not in names]
        if missing:
            raise RejectedInputError(
                "missing_column",
                "Parquet file lacks a column",
                where=path,
                expected=", ".join(missing),
                got="columns " + ", ".join(names),
            )
        wanted = None if columns is None else list(columns)
        _check_size(file, wanted, path)
        return _read(file, wanted, path)


def column_names(path: AnyPath) -> list[str]:
    """Names of a Parquet file's columns, from its footer.

    Raises: RejectedInputError: missing_file, special_file, unreadable.
    """
    local = regular_file(path)
    with unreadable("Parquet file cannot be read", path, _FAULTS):
        return list(pq.read_schema(local, memory_map=False).names)


def _check_size(file: pq.ParquetFile, columns: list[str] | None, path: AnyPath) -> None:
    """By the footer: 8 bytes per value, which is what Arrow takes for numbers, or as many as a value of fixed length has."""
    footer = file.metadata
    if footer.num_rows > MAX_ROWS:
        raise too_large("Table has too many rows", where=path, limit=MAX_ROWS, got=footer.num_rows, unit="rows")
    size = sum(max(count, 0) * max(width, 8) for count, width, _ in _chunks(file, columns))
    if size > MAX_TABLE_BYTES:
        raise too_large("Table has too many values", where=path, limit=MAX_TABLE_BYTES, got=size, unit="bytes")


def _chunks(file: pq.ParquetFile, columns: list[str] | None) -> Iterator[tuple[int, int, int]]:
    """(values, bytes of each where all have as many, bytes once decompressed) of the column chunks, as the footer has them."""
    footer = file.metadata
    for group in range(footer.num_row_groups):
        row_group = footer.row_group(group)
        for number in range(row_group.num_columns):
            column = row_group.column(number)
            if columns is None or column.path_in_schema.split(".")[0] in columns:
                fixed = column.physical_type == "FIXED_LEN_BYTE_ARRAY"
                width = file.schema.column(number).length if fixed else 0
                yield column.num_values, width, column.total_uncompressed_size


def _read(file: pq.ParquetFile, columns: list[str] | None, path: AnyPath) -> pa.Table:
    fields = [field for field in file.schema_arrow if columns is None or field.name in columns]
    if not any(_holds_text(field.type) for field in fields):
        return file.read(columns=columns, use_threads=False)
    batches, total = [], 0
    longest = max((size for *_, size in _chunks(file, columns)), default=1)
    rows = min(max(_BATCH_BYTES // max(longest, 1), _BATCH_ROWS[0]), _BATCH_ROWS[1])
    for batch in file.iter_batches(rows, columns=columns, use_threads=False):
        total += batch.nbytes
        if total > MAX_TABLE_BYTES:
            raise too_large("Table is too large", where=path, limit=MAX_TABLE_BYTES, got=total, unit="bytes")
        batches.append(batch)
    schema = file.schema_arrow
    if columns is not None:
        schema = pa.schema([schema.field(name) for name in columns], metadata=schema.metadata)
    return pa.Table.from_batches([batch.select(schema.names) for batch in batches], schema)


def _holds_text(kind: pa.DataType) -> bool:
    if pa.types.is_nested(kind):
        return any(_holds_text(kind.field(number).type) for number in range(kind.num_fields))
    text = (pa.types.is_string, pa.types.is_binary, pa.types.is_large_string, pa.types.is_large_binary)
    return any(is_kind(kind) for is_kind in text)
