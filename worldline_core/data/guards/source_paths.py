"""Paths of recordings: on this machine or in an object store, and, where a dataset's own metadata names them, not to be
trusted.

Readers keep the paths they are given (messages name those) and open `local_file(path)`, at the moment of reading: the copy
of a remote file stays only while there is room. A recording that is written, replaced or cut while it is read would come
out half old and half new: size, time of change and identity of each file that an episode opens are compared at its end.
"""

from __future__ import annotations

import hashlib
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

from pydantic import BeforeValidator, PlainSerializer, WithJsonSchema
from upath import UPath

from worldline_core.data.guards.reader_process import still_reading
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.errors import ConfigError, DataError
from worldline_core.store.artifact_files import leads_out
from worldline_core.store.remote import AnyPath, list_files, parse_location, process_cache, remote_kind

type FileState = tuple[int, int, int, int] | None

_LONGEST_STEM = 200
_DIGEST_AT_END = re.compile("-[0-9a-f]{16}$")

_opened: ContextVar[dict[Path, FileState] | None] = ContextVar("opened", default=None)
"""State of every local file of the present episode, as it was when it was first opened."""


@contextmanager
def unchanged_files(episode_id: str) -> Iterator[None]:
    """Around everything that reads one episode; the block's own errors are replaced where a local file changed meanwhile.

    Raises: RejectedInputError (changed_while_reading) naming the files.
    """
    opened: dict[Path, FileState] = {}
    token = _opened.set(opened)
    finding: Exception | None = None
    try:
        yield
    except Exception as error:  # noqa: BLE001 - raised below
        finding = error
    finally:
        _opened.reset(token)
    changed = [str(path) for path in sorted(opened) if _state(path) != opened[path]]
    if changed:
        raise RejectedInputError(
            "changed_while_reading",
            "Files changed while the recording was read",
            where=f"episode {episode_id}",
            got=", ".join(changed),
            next_step="wait until the recording is complete, then curate again",
        ) from finding
    if finding is not None:
        raise finding


def _state(path: Path) -> FileState | None:
    try:
        found = path.stat()
    except (OSError, ValueError):
        return None
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


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

_FILE_KINDS = {
    stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}  # fmt: skip
_FIELD = re.compile(r"\{(\w+)(?::0?(\d{1,2})d)?\}")
_SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+=-]*")


def inside[P: AnyPath](root: P, relative: str) -> P:
    """root / relative, refused when it would leave root (by `..`, an absolute path, another URL or a link).

    Raises: RejectedInputError (path_traversal) with the offending path.
    """
    pure = PurePosixPath(relative)
    leaves = pure.is_absolute() or "\0" in relative
    if isinstance(root, Path):
        leaves = leaves or leads_out(root / relative, root)
    else:
        leaves = leaves or "://" in relative or "\\" in relative or ".." in pure.parts
    if leaves:
        raise RejectedInputError(
            "path_traversal",
            "Path leads outside of the dataset folder",
            where=root,
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
    still_reading()
    if isinstance(path, Path):
        opened = _opened.get()
        if opened is not None and path not in opened:
            opened[path] = _state(path)
        return path
    try:
        return process_cache().fetch(path)
    except (FileNotFoundError, IsADirectoryError) as error:
        raise RejectedInputError("missing_file", "File is missing", where=path) from error
    except PermissionError as error:
        raise _not_allowed(path) from error


def regular_file(path: AnyPath, what: str = "File") -> Path:
    """The file to open for `path` (see `local_file`), if it is regular: a pipe may block, a device does not end.

    Raises: RejectedInputError: missing_file, special_file, and what `local_file` raises.
    """
    try:
        local = local_file(path)
        found = local.stat()
    except (OSError, ValueError) as error:  # ValueError: a name with a null byte
        raise RejectedInputError(
            "missing_file",
            f"{what} is missing",
            where=path,
            got=None if isinstance(error, FileNotFoundError) else str(error),
            next_step="restore the file or drop the episode",
        ) from error
    if not stat.S_ISREG(found.st_mode):
        raise RejectedInputError(
            "special_file",
            f"{what} is no regular file",
            where=path,
            expected="a regular file",
            got=_FILE_KINDS.get(stat.S_IFMT(found.st_mode), "something else"),
        )
    return local


def is_file(path: AnyPath) -> bool:
    """True if there is a file.

    Raises: RejectedInputError (unreadable) where the store does not say; UnreachableInputError when it does not answer.
    """
    if isinstance(path, Path):
        return path.is_file()
    return _remote_kind(path) == "file"


def exists(path: AnyPath) -> bool:
    """True if there is a file or a folder.

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
        "unreadable", "File may not be read", where=path, next_step="check the rights of the account"
    )


def find_files[P: AnyPath](root: P, pattern: str) -> list[P]:
    """Files that match `root.rglob(pattern)`, sorted; a remote folder is listed once.

    Raises: UnreachableInputError when the store does not answer.
    """
    if isinstance(root, UPath) and not isinstance(root, Path):
        return [root / name for name in list_files(root) if PurePosixPath(name).match(pattern)]
    return sorted(root.rglob(pattern))  # pyright: ignore[reportReturnType]


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

    def substitute(field: re.Match[str]) -> str:
        name, width = field.groups()
        return str(values[name]).zfill(int(width or 0)) if name in values else field[0]

    filled = _FIELD.sub(substitute, template)
    if "{" in filled or "}" in filled:
        raise RejectedInputError(
            "path_traversal",
            "Path template is not understood",
            where=template,
            expected="no other fields than " + ", ".join(values),
            got=filled,
        )
    return filled


def safe_stem(name: str) -> str:
    """Any name as the beginning of a file name; different names give different stems.

    Other characters than letters, digits, - and _ become _; a digest ends every stem that is not the name itself, and that
    of a name that looks as if it ended in one.
    """
    stem = "".join(c if c.isalnum() or c in "-_" else "_" for c in name)
    if stem == name and len(stem.encode()) <= _LONGEST_STEM and not _DIGEST_AT_END.search(name):
        return stem
    kept = stem if len(stem.encode()) <= _LONGEST_STEM else stem[: _LONGEST_STEM // 4]
    return f"{kept}-{hashlib.sha256(name.encode()).hexdigest()[:16]}"


def safe_name(name: str, what: str) -> str:
    """`name` when it can serve as one path component.

    Raises: DataError otherwise.
    """
    if not _SAFE_NAME.fullmatch(name):
        raise DataError(
            f"{what} cannot be a file name", expected="letters, digits and . _ + = - (not leading)", got=repr(name)
        )
    return name
