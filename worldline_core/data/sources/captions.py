"""Captions of videos that are kept beside them: a text file a video, or one table for all."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping
from typing import Any

from worldline_core.data.guards.json_file import read_json, read_json_lines
from worldline_core.data.guards.limits import MAX_TEXT_BYTES, regular_file, too_large
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, is_file
from worldline_core.errors import ConfigError, DataError

MAX_CAPTION_BYTES = 1 << 16
TABLE_SUFFIXES = (".json", ".jsonl", ".csv")


def caption_of(path: AnyPath) -> str | None:
    """The text of a file that holds one caption, or None where there is no such file.

    Raises: RejectedInputError: unreadable (no UTF-8 text), too_large.
    """
    return " ".join(_text(path, MAX_CAPTION_BYTES).split()) if is_file(path) else None


def caption_table(path: AnyPath, video_key: str, caption_key: str) -> dict[str, str]:
    """Captions by the video's path in the folder, from a table.

    JSON: an object {video: caption}, or a list of objects with the two keys; JSONL: one such object a line; CSV: a header
    with the two names.

    Raises: DataError when the file is missing, damaged or says two things of one video; ConfigError for another suffix
        or a key that is not there.
    """
    suffix = path.suffix.lower()
    if suffix not in TABLE_SUFFIXES:
        raise ConfigError(
            "Captions are in a file of unknown kind", where=str(path), expected=" | ".join(TABLE_SUFFIXES), got=suffix
        )
    if not is_file(path):
        raise DataError(
            "Table of captions is missing", where=str(path), next_step="check the file's name in the source"
        )
    table: dict[str, str] = {}
    for video, caption in _rows(path, suffix, video_key, caption_key):
        name, said = video.removeprefix("./"), " ".join(caption.split())
        if table.setdefault(name, said) != said:
            raise DataError("Table has two captions for one video", where=str(path), got=name)
    return table


def _rows(path: AnyPath, suffix: str, video_key: str, caption_key: str) -> Iterable[tuple[str, str]]:
    if suffix == ".csv":
        try:
            listed: Any = list(csv.DictReader(io.StringIO(_text(path, MAX_TEXT_BYTES), newline=""), strict=True))
        except csv.Error as error:
            raise DataError("Table of captions is no CSV", where=str(path), got=str(error)) from error
    elif suffix == ".jsonl":
        listed = list(read_json_lines(path))
    else:
        listed = read_json(path)
        if isinstance(listed, dict):
            listed = [{video_key: video, caption_key: caption} for video, caption in listed.items()]
    if not isinstance(listed, list):
        raise DataError(
            "Table of captions has a wrong shape", where=str(path), expected="rows", got=type(listed).__name__
        )
    return [
        (_field(row, video_key, number, path), _field(row, caption_key, number, path))
        for number, row in enumerate(listed, start=1)
    ]


def _text(path: AnyPath, limit: int) -> str:
    file = regular_file(path)
    size = file.stat().st_size
    if size > limit:
        raise too_large("Text is too long", where=str(path), limit=limit, got=size, unit="bytes")
    try:
        return file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise RejectedInputError("unreadable", "Text cannot be read", where=str(path), got=str(error)) from error


def _field(row: Any, key: str, number: int, path: AnyPath) -> str:
    value = row.get(key) if isinstance(row, Mapping) else None
    if not isinstance(value, str):
        raise ConfigError(
            "Row of the table of captions lacks a text",
            where=f"{path}, row {number}",
            expected=f"a text named {key}",
            got=", ".join(map(str, row)) if isinstance(row, Mapping) else type(row).__name__,
            next_step="give the source the names that the table has, or the right table",
        )
    return value
