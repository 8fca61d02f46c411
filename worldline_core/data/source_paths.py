"""Paths that come from a dataset's own metadata, and are therefore not to be trusted."""

from __future__ import annotations

import re
from pathlib import Path

from worldline_core.data.rejection import RejectedInputError
from worldline_core.errors import DataError

_FIELD = re.compile(r"\{(video_key|chunk_index|file_index|episode_chunk|episode_index)(?::0?(\d{1,2})d)?\}")
_SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+=-]*")


def inside(root: Path, relative: str) -> Path:
    """root / relative, refused when it would leave root (by `..`, an absolute path or a link).

    Raises: DataError with the offending path.
    """
    candidate = root / relative
    if Path(relative).is_absolute() or not candidate.resolve().is_relative_to(root.resolve()):
        raise RejectedInputError(
            "path_traversal",
            "Path leads outside of the dataset folder",
            where=str(root),
            expected="a path below the dataset folder",
            got=relative,
            next_step="repair the dataset's metadata, or copy linked files into the folder",
        )
    return candidate


def fill_template(template: str, **values: int | str) -> str:
    """Fill LeRobot's `chunk-{chunk_index:03d}/...` templates; only the known fields and integer widths are accepted.

    Raises: DataError for any other brace expression.
    """

    def substitute(match: re.Match[str]) -> str:
        name, width = match.group(1), match.group(2)
        if name not in values:
            raise RejectedInputError(
                "path_traversal",
                "Path template asks for an unknown value",
                where=template,
                expected=", ".join(values),
                got=name,
            )
        return str(values[name]).zfill(int(width)) if width else str(values[name])

    filled = _FIELD.sub(substitute, template)
    if "{" in filled or "}" in filled:
        raise RejectedInputError(
            "path_traversal",
            "Path template is not understood",
            where=template,
            expected=_FIELD.pattern,
            got=filled,
        )
    return filled


def safe_name(name: str, what: str) -> str:
    """`name` when it can serve as one path component.

    Raises: DataError otherwise.
    """
    if not _SAFE_NAME.fullmatch(name):
        raise DataError(
            f"{what} cannot be a file name",
            expected="letters, digits and . _ + = - (not leading)",
            got=repr(name),
        )
    return name
