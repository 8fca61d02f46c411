"""Paths of recordings: on this machine or in an object store, and, where a dataset's own metadata names them, not to be
trusted.

Readers keep the paths they are given (messages name those) and open `local_file(path)`, at the moment of reading: the
copy of a remote file stays only while there is room.
"""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

from pydantic import BeforeValidator, PlainSerializer, WithJsonSchema
from upath import UPath

from worldline_core.data.guards.file_watch import note_file
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.errors import ConfigError, DataError
from worldline_core.scale.remote import (
    AnyPath,
    is_remote,
    list_files,
    matching,
    parse_location,
    process_cache,
    remote_kind,
)

__all__ = [
    "AnyPath",
    "SourceFolder",
    "exists",
    "fill_template",
    "find_files",
    "find_folders",
    "inside",
    "inside_folder",
    "is_file",
    "is_remote",
    "local_file",
    "parse_location",
    "portable_text",
    "relative_name",
    "safe_name",
]


def _folder_field(value: object) -> AnyPath:
    if not isinstance(value, str | Path | UPath):
        raise ValueError("a folder, or a URL such as s3://bucket/folder")
    try:
        return parse_location(value)
    except ConfigError as error:
        raise ValueError(str(error)) from error


SourceFolder = Annotated[
    Any,
    BeforeValidator(_folder_field),
    PlainSerializer(str, return_type=str),
    WithJsonSchema({"type": "string", "format": "path"}),
]
"""Field type of a configuration: a folder, or a URL such as `s3://bucket/folder`."""

_FIELD = re.compile(r"\{(video_key|chunk_index|file_index|episode_chunk|episode_index)(?::0?(\d{1,2})d)?\}")
_SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+=-]*")


def inside[P: AnyPath](root: P, relative: str) -> P:
    """root / relative, refused when it would leave root (by `..`, an absolute path, another URL or a link).

    Raises: RejectedInputError (path_traversal) with the offending path.
    """
    pure = PurePosixPath(relative)
    leaves = pure.is_absolute() or "\0" in relative
    if isinstance(root, Path):
        leaves = leaves or not (root / relative).resolve().is_relative_to(root.resolve())
    else:
        leaves = leaves or "://" in relative or "\\" in relative or ".." in pure.parts
    if leaves:
        raise RejectedInputError(
            "path_traversal",
            "Path leads outside of the dataset folder",
            where=str(root),
            expected="a path below the dataset folder",
            got=relative,
            next_step="repair the dataset's metadata, or copy linked files into the folder",
        )
    return root / relative  # pyright: ignore[reportReturnType]


def inside_folder[P: AnyPath](root: P, relative: str) -> P:
    """`inside` for a folder whose files are read by their names: no link in it may lead out of root either.

    Raises: RejectedInputError (path_traversal).
    """
    folder = inside(root, relative)
    if isinstance(folder, Path) and isinstance(root, Path):
        for entry in folder.rglob("*"):
            if entry.is_symlink():
                inside(root, str(entry.relative_to(root)))
    return folder


def local_file(path: AnyPath) -> Path:
    """The file to open: a local path itself (whether it exists is the reader's to say), a remote one's copy here.

    Raises: RejectedInputError (missing_file, unreadable) for a remote file that is not there or not allowed;
        UnreachableInputError when the store does not answer.
    """
    if isinstance(path, Path):
        note_file(path)
        return path
    try:
        return process_cache().fetch(path)
    except (FileNotFoundError, IsADirectoryError) as error:
        raise RejectedInputError("missing_file", "File is missing", where=str(path)) from error
    except PermissionError as error:
        raise _not_allowed(path) from error


def is_file(path: AnyPath) -> bool:
    """Whether there is a file.

    Raises: RejectedInputError (unreadable) where the store does not say; UnreachableInputError when it does not answer.
    """
    if isinstance(path, Path):
        return path.is_file()
    return process_cache().has(path) or _remote_kind(path) == "file"


def exists(path: AnyPath) -> bool:
    """Whether there is a file or a folder.

    Raises: RejectedInputError (unreadable) where the store does not say; UnreachableInputError when it does not answer.
    """
    return path.exists() if isinstance(path, Path) else _remote_kind(path) is not None


def _remote_kind(path: AnyPath) -> str | None:
    try:
        return remote_kind(path)
    except PermissionError as error:
        raise _not_allowed(path) from error


def _not_allowed(path: AnyPath) -> RejectedInputError:
    return RejectedInputError(
        "unreadable", "File may not be read", where=str(path), next_step="check the rights of the account"
    )


def find_files[P: AnyPath](root: P, pattern: str) -> list[P]:
    """What `root.rglob(pattern)` finds, sorted; a remote folder is listed once.

    Raises: UnreachableInputError when the store does not answer.
    """
    if isinstance(root, UPath) and not isinstance(root, Path):
        return [root / name for name in matching(list(list_files(root)), pattern)]
    return sorted(root.rglob(pattern))  # pyright: ignore[reportReturnType]


def find_folders[P: AnyPath](root: P, depth: int) -> list[P]:
    """Folders that lie `depth` levels below `root`, sorted; those of an object store exist by the files in them.

    Raises: UnreachableInputError when the store does not answer.
    """
    if isinstance(root, UPath) and not isinstance(root, Path):
        parts = (PurePosixPath(name).parts for name in list_files(root))
        return [root / "/".join(names) for names in sorted({p[:depth] for p in parts if len(p) > depth})]
    return sorted(path for path in root.glob("/".join(["*"] * depth)) if path.is_dir())  # pyright: ignore[reportReturnType]


def relative_name(path: AnyPath, root: AnyPath) -> PurePosixPath:
    """A file's name below the folder it was found in."""
    return PurePosixPath(path.relative_to(root).as_posix())  # pyright: ignore[reportArgumentType]


def portable_text(text: str, root: AnyPath, label: str) -> str:
    """A message with paths counted from the source's folder: a set must not depend on where its sources lay."""
    roots = [root.resolve(), root] if isinstance(root, Path) else [process_cache().place(root), root]
    for folder in roots:
        text = text.replace(f"{folder}/", "").replace(str(folder), label)
    return text


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
