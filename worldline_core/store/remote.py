"""Files in object stores: listed, and copied to this machine when they are read, within a size bound.

Locations are `universal_pathlib` paths; credentials and endpoints come from the environment of the store's own library
(`AWS_*`, or fsspec's `FSSPEC_<PROTOCOL>_<OPTION>`), never from a config that ends up in a manifest. Only transient
errors are retried: those of a network or a busy store, not of the data.
"""

from __future__ import annotations

import errno
import functools
import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.util import get_temp_dir
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, cast

from fsspec import AbstractFileSystem
from fsspec.asyn import AsyncFileSystem
from upath import UPath
from upath.implementations.local import FilePath

from worldline_core.errors import ArtifactError, ConfigError, UnavailableError, installing
from worldline_core.store.artifact_files import digest_value
from worldline_core.untrusted_text import carries_credentials

_TRANSIENT_ERRNOS = frozenset(
    getattr(errno, name, errno.EIO)  # as network file systems report, and s3fs for answers of status 5xx
    for name in ("EIO", "EREMOTEIO", "ESTALE", "EAGAIN", "EBUSY", "ETIMEDOUT", "ENETDOWN", "ENETUNREACH", "ENETRESET",
                 "EHOSTDOWN", "EHOSTUNREACH")
)  # fmt: skip
_TRANSIENT_CLASSES = frozenset((  # of Python, and of botocore, aiohttp, http.client and httpx, which need not be installed
    "ConnectionError", "TimeoutError", "UnreachableInputError", "HTTPClientError", "ResponseStreamingError",
    "IncompleteReadError", "ResponseParserError", "ClientConnectionError", "ClientPayloadError", "IncompleteRead", "TransportError",
))  # fmt: skip


class UnreachableInputError(UnavailableError):
    """A store did not answer several attempts. Its content may be good, so nothing is quarantined for it."""


def is_transient(error: BaseException | None) -> bool:
    """Returns whether another attempt may help: the error, or one of its causes, comes from a network or a busy store."""
    while error is not None:
        if getattr(error, "errno", None) in _TRANSIENT_ERRNOS:
            return True
        if any(kind.__name__ in _TRANSIENT_CLASSES for kind in type(error).__mro__):
            return True
        status = getattr(error, "status", getattr(getattr(error, "response", None), "status_code", None))
        if isinstance(status, int) and (status >= 500 or status == 429):
            return True
        error = error.__cause__ or error.__context__
    return False


@contextmanager
def _requests_to(path: AnyPath) -> Iterator[Any]:
    """The fsspec file system of a location, around requests, which the store's own library repeats.

    Raises: UnavailableError where that library is not installed; UnreachableInputError when the store does not answer.
    """
    try:
        yield cast("UPath", path).fs
    except ImportError as error:
        step = f"for s3:// {installing('s3')}; otherwise install the fsspec library of that store"
        raise UnavailableError("A store's library is not installed", where=path, got=error, next_step=step) from error
    except Exception as error:
        if isinstance(error, UnreachableInputError) or not is_transient(error):
            raise
        step, got = "run the same command again when the store answers; finished work is kept", first_line(error)
        raise UnreachableInputError("A store could not be reached", where=path, got=got, next_step=step) from error


def first_line(error: BaseException) -> str:
    """An error's kind and the first line of its message."""
    return f"{type(error).__name__}: {next(iter(str(error).splitlines()), '')}"


if TYPE_CHECKING:
    # UPath has pathlib's interface but is not its subclass; readers of folders need not tell them apart.
    type AnyPath = Path
else:
    AnyPath = Path | UPath


def parse_location(text: str | Path | UPath) -> AnyPath:
    """A folder of this machine, or a location in an object store when the text is a URL (`s3://bucket/folder`).

    Raises: ConfigError for an unknown protocol, or a URL with a password or a signature, which manifests would keep.
    """
    if isinstance(text, Path):
        return text
    if carries_credentials(str(text)):
        raise ConfigError(
            "A location carries credentials, which manifests and logs would keep", got=text,
            expected="a URL without password, key or signature",
            next_step="leave them to the store's environment variables (AWS_*, or FSSPEC_<PROTOCOL>_<OPTION>)",
        )  # fmt: skip
    try:
        location = UPath(text)
    except ValueError as error:
        expected = "a folder, or a URL that fsspec knows"
        raise ConfigError("Unknown kind of location", expected=expected, got=text) from error
    local = isinstance(location, Path | FilePath)  # file:// is local
    return Path(location.path) if local else cast("AnyPath", location)


def is_remote(path: AnyPath) -> bool:
    """Returns whether a path names a location in an object store."""
    return not isinstance(path, Path)


def list_files(root: AnyPath) -> dict[str, dict[str, Any]]:
    """The store's description of every file below `root` by relative name, sorted.

    Raises: UnreachableInputError when the store does not answer.
    """
    found: dict[str, Any]
    with _requests_to(root) as fs:
        base = fs._strip_protocol(str(root)).rstrip("/")
        own: Any = type(fs)._find if isinstance(fs, AsyncFileSystem) else type(fs).find
        if own in (AsyncFileSystem._find, AbstractFileSystem.find):
            # fsspec's own walk silently omits folders that it could not list: `on_error` does not reach further down.
            found, folders = {}, [base] if remote_kind(root) else []
            for folder in folders:
                listed = {about["name"].rstrip("/"): about for about in fs.ls(folder, detail=True)}
                found |= {name: about for name, about in listed.items() if about["type"] != "directory"}
                folders += [name for name in listed.keys() - found.keys() if name != folder]
        else:
            found = cast("dict[str, Any]", fs.find(base, detail=True))
    return {name: found[path] for path in sorted(found) if (name := path.removeprefix(base).lstrip("/"))}


def remote_kind(path: AnyPath) -> str | None:
    """The kind of a location: "file", "directory", or None for nothing.

    Raises: PermissionError where the store refuses; UnreachableInputError when it does not answer, for which fsspec's
        `isfile` returns False.
    """
    with _requests_to(path) as fs, suppress(FileNotFoundError):
        return fs.info(str(path))["type"]
    return None


def remote_digest(root: AnyPath) -> str:
    """Digest of a store's listing below `root`: names, sizes and ETags (elsewhere what fsspec compares).

    Raises: ArtifactError when nothing is there; UnreachableInputError when the store does not answer.
    """
    files = list_files(root)
    if not files:
        raise ArtifactError("There is nothing at an input's location", where=root, next_step="check the URL")
    with _requests_to(root) as fs:
        states = {name: about.get("ETag") or fs.ukey(about["name"]) for name, about in files.items()}
    return digest_value([[name, about["size"], states[name]] for name, about in files.items()])


class RemoteCache:
    """Copies of remote files in a private folder of this process.

    The least recently read one may be removed as soon as the next file is fetched: open the result of `fetch` at once.
    """

    def __init__(self, max_bytes: int = 8 << 30) -> None:
        # Of mode 0700; multiprocessing removes what is there when its first process ends.
        self.folder = Path(tempfile.mkdtemp(prefix="worldline-remote-", dir=get_temp_dir()))
        self.max_bytes, self._sizes, self._lock = max_bytes, dict[Path, int](), threading.Lock()

    def place(self, path: AnyPath) -> Path:
        """The path of a remote file's copy, which repeats the store's own names, so that messages can be made portable."""
        where = cast("UPath", path)
        kept = (part for part in PurePosixPath(where.path).parts if part not in ("/", "..", "."))
        return self.folder.joinpath(where.protocol, *kept)

    def fetch(self, path: AnyPath) -> Path:
        """A copy of the file on this machine.

        Raises: FileNotFoundError; UnreachableInputError when the store does not answer.
        """
        with self._lock:
            copy = self.place(path)
            size = self._sizes.pop(copy, None)
            if size is None:
                copy.parent.mkdir(parents=True, exist_ok=True)
                with _requests_to(path) as fs:
                    fs.get_file(str(path), str(copy))
                size = copy.stat().st_size
            self._sizes[copy] = size
            while len(self._sizes) > 1 and sum(self._sizes.values()) > self.max_bytes:
                oldest = next(iter(self._sizes))
                oldest.unlink()
                del self._sizes[oldest]
            return copy


@functools.cache
def process_cache() -> RemoteCache:
    """The cache of this process, below its folder for temporary files (TMPDIR)."""
    return RemoteCache()


os.register_at_fork(after_in_child=process_cache.cache_clear)
