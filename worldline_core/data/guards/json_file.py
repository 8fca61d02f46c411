"""JSON and JSON lines that are not to be trusted: bounded in size, no repeated keys, every fault named.

NaN and infinities are read as what they are: recorders write them, and the checks of values say where they stand.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from worldline_core.data.guards.limits import MAX_TEXT_BYTES, regular_file, too_large
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath


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
    try:
        return json.loads(text, object_pairs_hook=_without_repetition)
    except RecursionError as error:
        raise RejectedInputError(
            "unreadable",
            "JSON is nested too deeply",
            where=str(where),
            expected="some levels",
            got="more than Python's recursion limit",
        ) from error
    except ValueError as error:  # of the decoder, of UTF-8, of a key given twice, of a number with too many digits
        raise RejectedInputError("unreadable", "File is not valid JSON", where=str(where), got=str(error)) from error


def read_json_lines(path: AnyPath) -> Iterator[Any]:
    """The values of a file with one JSON value a line; empty lines are skipped.

    Raises: RejectedInputError as `read_json`, naming the line.
    """
    for number, line in enumerate(read_text(path).splitlines(), 1):
        if line.strip():
            yield parse_json(line, f"{path}, line {number}")


def read_text(path: AnyPath) -> str:
    """The text of a file.

    Raises: RejectedInputError: missing_file, special_file, too_large, unreadable (no UTF-8).
    """
    file = regular_file(path)
    try:
        size = file.stat().st_size
        if size > MAX_TEXT_BYTES:
            raise too_large("Text file is too large", where=str(path), limit=MAX_TEXT_BYTES, got=size, unit="bytes")
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RejectedInputError(
            "unreadable", "File cannot be read as text", where=str(path), got=str(error)
        ) from error


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) != len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))
        raise ValueError(f"the key {twice!r} is given twice")
    return values


@contextmanager
def well_formed(where: object, layout: str) -> Iterator[None]:
    """Around the reading of parsed content: what has another shape than its layout says is a fault of the file.

    Raises: RejectedInputError (unreadable) for a missing key, another type, another length, a number out of range.
    """
    try:
        yield
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise RejectedInputError(
            "unreadable",
            "Content has another shape than its layout",
            where=str(where),
            expected=layout,
            got=f"{type(error).__name__}: {error}",
        ) from error
