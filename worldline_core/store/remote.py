"""Files in object stores: listed, and copied to this machine when they are read, within a size bound.

Locations are `universal_pathlib` paths; credentials and endpoints come from the environment of the store's own library
(`AWS_*`, or fsspec's `FSSPEC_<PROTOCOL>_<OPTION>`), never from a config that ends up in a manifest. Only transient
errors are retried: those of a network or a busy store, not of the data.
"""

from __future__ import annotations

import atexit
import errno
import fcntl
import functools
import logging
import os
import shutil
import tempfile
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, cast

from fsspec import AbstractFileSystem
from fsspec.asyn import AsyncFileSystem
from upath import UPath
from upath.implementations.local import FilePath

from worldline_core.errors import ArtifactError, ConfigError, UnavailableError, installing
from worldline_core.store.artifact_files import digest_value
from worldline_core.untrusted_text import carries_credentials

logger = logging.getLogger(__name__)

PAUSES = (0.2, 0.4, 0.8, 1.6)
"""Seconds before each further attempt."""
_TRANSIENT_ERRNOS = frozenset(
    getattr(errno, name, errno.EIO)  # as network file systems report, and s3fs for answers of status 5xx
    for name in ("EIO", "EREMOTEIO", "ESTALE", "EAGAIN", "EBUSY", "ETIMEDOUT", "ENETDOWN", "ENETUNREACH", "ENETRESET",
                 "EHOSTDOWN", "EHOSTUNREACH")
)  # fmt: skip
_TRANSIENT_CLASSES = frozenset(  # by name: the library of an unused store need not be installed
    {
        "botocore.exceptions.HTTPClientError", "botocore.exceptions.ResponseStreamingError",
        "botocore.exceptions.IncompleteReadError", "botocore.parsers.ResponseParserError",
        "aiohttp.client_exceptions.ClientConnectionError", "aiohttp.client_exceptions.ClientPayloadError",
        "http.client.IncompleteRead", "httpx.TransportError",
    }
)  # fmt: skip


class UnreachableInputError(UnavailableError):
    """A store did not answer several attempts. Its content may be good, so nothing is quarantined for it."""


def is_transient(error: BaseException | None) -> bool:
    """Returns whether another attempt may help: the error, or one of its causes, comes from a network or a busy store."""
    while error is not None:
        if isinstance(error, ConnectionError | TimeoutError | UnreachableInputError):
            return True
        if isinstance(error, OSError) and error.errno in _TRANSIENT_ERRNOS:
            return True
        if any(f"{kind.__module__}.{kind.__name__}" in _TRANSIENT_CLASSES for kind in type(error).__mro__):
            return True
        response = getattr(error, "response", None)  # of botocore (a mapping), aiohttp and the hub
        status = getattr(error, "status", getattr(response, "status_code", None))
        if isinstance(response, dict):
            status = response.get("ResponseMetadata", {}).get("HTTPStatusCode")
        if isinstance(status, int) and (status >= 500 or status == 429):
            return True
        error = error.__cause__ or error.__context__
    return False


def with_retries[T](action: Callable[[], T], what: str, pauses: Sequence[float] | None = None) -> T:
    """The result of `action`, tried again after each of `pauses` [s] while it fails for a transient reason.

    Raises: UnreachableInputError after the last attempt; every other error at once.
    """
    waiting = iter(PAUSES if pauses is None else pauses)
    while True:
        try:
            return action()
        except Exception as error:
            if not is_transient(error):
                raise
            pause = next(waiting, None)
            if pause is None:
                if isinstance(error, UnreachableInputError):
                    raise
                raise UnreachableInputError(
                    "A store could not be reached",
                    where=what,
                    got=f"{type(error).__name__}: {error}",
                    next_step="run the same command again when the store answers; finished work is kept",
                ) from error
            logger.warning("%s: %s; trying again in %.1f s", what, first_line(error), pause)
            time.sleep(pause)


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
            "A location carries credentials, which manifests and logs would keep",
            expected="a URL without password, key or signature",
            got=text,
            next_step="leave them to the store's environment variables (AWS_*, or FSSPEC_<PROTOCOL>_<OPTION>)",
        )
    try:
        location = UPath(text) if isinstance(text, str) else text
    except ValueError as error:
        raise ConfigError(
            "Unknown kind of location", expected="a folder, or a URL that fsspec knows", got=text
        ) from error
    if isinstance(location, Path):
        return Path(str(location))
    return Path(location.path) if isinstance(location, FilePath) else cast("AnyPath", location)  # file:// is local


def is_remote(path: AnyPath) -> bool:
    """Returns whether a path names a location in an object store."""
    return not isinstance(path, Path)


def file_system(path: AnyPath) -> Any:
    """The fsspec file system of a location.

    Raises: UnavailableError where the store's library is not installed.
    """
    try:
        return cast("UPath", path).fs
    except ImportError as error:
        next_step = f"for s3:// {installing('s3')}; otherwise install the fsspec library of that store"
        raise UnavailableError(
            "A store's library is not installed", where=path, got=error, next_step=next_step
        ) from error


def list_files(root: AnyPath) -> dict[str, dict[str, Any]]:
    """The store's description of every file below `root` by relative name, sorted.

    Raises: UnreachableInputError when the store does not answer.
    """
    fs = file_system(root)
    base = fs._strip_protocol(str(root)).rstrip("/")
    found = with_retries(lambda: _find(fs, base), str(root))
    relative = {name.removeprefix(base).lstrip("/"): about for name, about in found.items()}
    return {name: relative[name] for name in sorted(relative) if name}


def _find(fs: Any, base: str) -> dict[str, dict[str, Any]]:
    own: Any = type(fs)._find if isinstance(fs, AsyncFileSystem) else type(fs).find
    if own not in (AsyncFileSystem._find, AbstractFileSystem.find):
        return cast("dict[str, dict[str, Any]]", fs.find(base, detail=True))
    # fsspec's own walk silently omits the folders it could not list: `on_error` does not reach folders further down.
    found: dict[str, dict[str, Any]] = {}
    folders = [base] if fs.exists(base) else []
    while folders:
        for about in fs.ls(folder := folders.pop(), detail=True):
            name = about["name"].rstrip("/")
            if about["type"] != "directory":
                found[name] = about
            elif name != folder.rstrip("/"):
                folders.append(name)
    return found


def remote_kind(path: AnyPath) -> str | None:
    """The kind of a location: "file", "directory", or None for nothing.

    fsspec's `isfile` returns False when the store did not answer, which would silently leave out an optional file.

    Raises: PermissionError where the store refuses; UnreachableInputError when it does not answer.
    """
    fs = file_system(path)
    try:
        return with_retries(lambda: fs.info(str(path))["type"], str(path))
    except FileNotFoundError:
        return None


_CHANGE_MARKS = (
    "ETag", "etag", "checksum", "md5Hash", "content_md5", "LastModified", "last_modified", "mtime", "created",
)  # fmt: skip
"""Attributes that change with a file's content, by store; the first one present is used."""


def remote_digest(root: AnyPath) -> str:
    """Digest of a store's listing below `root`: names, sizes and the change mark of each file.

    Raises: ArtifactError when nothing is there; UnreachableInputError when the store does not answer.
    """
    entries = []
    for name, about in list_files(root).items():
        mark = next((str(about[key]) for key in _CHANGE_MARKS if about.get(key) is not None), "")
        entries.append([name, about.get("size"), mark])
    if not entries:
        raise ArtifactError("There is nothing at an input's location", where=root, next_step="check the URL")
    return digest_value(entries)


_FOLDER_PREFIX = "worldline-remote-"


class RemoteCache:
    """Copies of remote files in a private folder of this process, the least recently read removed first.

    A copy may be removed as soon as the next file is fetched: open the result of `fetch` at once.
    """

    def __init__(self, max_bytes: int = 8 << 30) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix=_FOLDER_PREFIX))  # of mode 0700, with an unpredictable name
        self.max_bytes = max_bytes
        # This lock shows other processes that this one is alive.
        fcntl.flock(os.open(self.folder, os.O_RDONLY), fcntl.LOCK_SH | fcntl.LOCK_NB)
        self._sizes: OrderedDict[Path, int] = OrderedDict()
        self._lock = threading.Lock()

    def place(self, path: AnyPath) -> Path:
        """The path of a remote file's copy, which repeats the store's own names, so that messages can be made portable."""
        parts = PurePosixPath(file_system(path)._strip_protocol(str(path))).parts
        return self.folder.joinpath(
            cast("UPath", path).protocol, *(part for part in parts if part not in ("/", "..", "."))
        )

    def has(self, path: AnyPath) -> bool:
        """Returns whether there is a copy."""
        return self.place(path) in self._sizes

    def fetch(self, path: AnyPath) -> Path:
        """A copy of the file on this machine.

        Raises: FileNotFoundError; UnreachableInputError when the store does not answer.
        """
        with self._lock:
            copy = self.place(path)
            if copy not in self._sizes:
                self._sizes[copy] = with_retries(lambda: _download(path, copy), str(path))
            self._sizes.move_to_end(copy)
            while sum(self._sizes.values()) > self.max_bytes and len(self._sizes) > 1:
                self._sizes.popitem(last=False)[0].unlink(missing_ok=True)
            return copy


def _download(path: AnyPath, copy: Path) -> int:
    fs = file_system(path)
    about = fs.info(str(path))
    if about.get("type") != "file":
        raise FileNotFoundError(errno.ENOENT, "Not a file", str(path))
    copy.parent.mkdir(parents=True, exist_ok=True)
    fs.get_file(str(path), str(copy))
    size = copy.stat().st_size
    if about.get("size") not in (None, size):
        fs.invalidate_cache()
        raise OSError(errno.EIO, f"download ended after {size} of {about['size']} bytes", str(path))
    return size


def process_cache() -> RemoteCache:
    """The cache of this process, removed when the process ends; its folder is in the one for temporary files (TMPDIR)."""
    return _cache_of(os.getpid())


@functools.cache
def _cache_of(process: int) -> RemoteCache:
    _remove_leftovers()
    cache = RemoteCache()
    # Not by a fork, which would remove the folder of its parent.
    atexit.register(lambda: process == os.getpid() and shutil.rmtree(cache.folder, ignore_errors=True))
    return cache


def _remove_leftovers() -> None:
    """Remove the caches of this user's processes that were killed, on this host or in containers that share its folder."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_FOLDER_PREFIX}*"):
        with suppress(OSError):
            facts = folder.lstat()
            if facts.st_uid == os.getuid() and time.time() - facts.st_mtime > 60:  # the lock is taken after the folder
                descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
                try:
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(folder, ignore_errors=True)
                finally:
                    os.close(descriptor)
