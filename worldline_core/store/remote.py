"""Files of object stores: listed, and copied to this machine when they are read, within a bound.

Locations are `universal_pathlib` paths; credentials and endpoints come from the environment of the store's own library
(`AWS_*`, or fsspec's `FSSPEC_<PROTOCOL>_<OPTION>`), never from a configuration that ends up in a manifest. Only
transient faults are retried: those of a network or of a busy store, not of the data.
"""

from __future__ import annotations

import atexit
import errno
import logging
import os
import shutil
import tempfile
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
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

ATTEMPTS = 5
FIRST_PAUSE_SECONDS = 0.2

_TRANSIENT_ERRNOS = frozenset(
    getattr(errno, name)
    for name in (
        "EIO", "EREMOTEIO", "ESTALE", "EAGAIN", "EBUSY", "ETIMEDOUT", "ENETDOWN", "ENETUNREACH", "ENETRESET",
        "EHOSTDOWN", "EHOSTUNREACH",
    )
    if hasattr(errno, name)
)  # fmt: skip
"""What a network file system or s3fs (its translation of 5xx answers) reports when it should be asked again."""
_TRANSIENT_CLASSES = frozenset(
    {
        ("botocore.exceptions", "HTTPClientError"),  # connections refused, closed, timed out
        ("botocore.exceptions", "ResponseStreamingError"),
        ("botocore.exceptions", "IncompleteReadError"),
        ("botocore.parsers", "ResponseParserError"),  # an answer cut short
        ("aiohttp.client_exceptions", "ClientConnectionError"),
        ("aiohttp.client_exceptions", "ClientPayloadError"),
        ("http.client", "IncompleteRead"),
        ("httpx", "TransportError"),
    }
)
"""By name, so that the libraries of a store that is not used need not be installed."""


class UnreachableInputError(UnavailableError):
    """A store did not answer although it was asked several times; what lies there may well be good, so it is not quarantined."""


def is_transient(error: BaseException | None) -> bool:
    """Whether asking again may help: the error, or one that caused it, comes from a network or a busy store."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        if isinstance(error, ConnectionError | TimeoutError | UnreachableInputError):
            return True
        if isinstance(error, OSError) and error.errno in _TRANSIENT_ERRNOS:
            return True
        if _busy_answer(error) or any((c.__module__, c.__name__) in _TRANSIENT_CLASSES for c in type(error).__mro__):
            return True
        error = error.__cause__ or error.__context__
    return False


def _busy_answer(error: BaseException) -> bool:
    """botocore's ClientError, aiohttp's ClientResponseError and the hub's errors with a status of 5xx or 429."""
    response = getattr(error, "response", None)
    status = getattr(error, "status", getattr(response, "status_code", None))
    if isinstance(response, dict):
        status = response.get("ResponseMetadata", {}).get("HTTPStatusCode")
    return isinstance(status, int) and (status >= 500 or status == 429)


def retry_pauses(retries: int, first_seconds: float) -> list[float]:
    """Seconds before each further attempt, doubling."""
    return [first_seconds * 2**number for number in range(retries)]


def with_retries[T](action: Callable[[], T], what: str, pauses: Sequence[float] | None = None) -> T:
    """The result of `action`, tried again after each of `pauses` [s] while it fails for a transient reason.

    Raises: UnreachableInputError after the last attempt; every other error at once.
    """
    waiting = iter(retry_pauses(ATTEMPTS - 1, FIRST_PAUSE_SECONDS) if pauses is None else pauses)
    while True:
        try:
            return action()
        except Exception as error:
            if not is_transient(error):
                raise
            pause = next(waiting, None)
            if pause is None and isinstance(error, UnreachableInputError):
                raise
            if pause is None:
                raise UnreachableInputError(
                    "A store could not be reached",
                    where=what,
                    expected=f"an answer within {ATTEMPTS} attempts",
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
DEFAULT_CACHE_BYTES = 8 << 30
_FOLDER_PREFIX = "worldline-remote-"


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
            "Unknown kind of location", expected="a folder, or a URL of a protocol that fsspec knows", got=text
        ) from error
    if isinstance(location, Path):
        return Path(str(location))
    return Path(location.path) if isinstance(location, FilePath) else cast("AnyPath", location)  # file:// is local


def is_remote(path: AnyPath) -> bool:
    """Whether a path lies in an object store."""
    return not isinstance(path, Path)


def file_system(path: AnyPath) -> Any:
    """The fsspec file system of a location.

    Raises: UnavailableError where the store's library is not installed.
    """
    try:
        return cast("UPath", path).fs
    except ImportError as error:
        raise UnavailableError(
            f"Locations of the form {cast('UPath', path).protocol}:// need a library that is not installed",
            where=path,
            got=str(error),
            next_step=f"for s3:// {installing('s3')}; otherwise install the fsspec library of that store",
        ) from error


def list_files(root: AnyPath) -> dict[str, dict[str, Any]]:
    """Every file below `root`: relative name -> what the store says about it, sorted by name.

    Raises: UnreachableInputError when the store does not answer.
    """
    fs = file_system(root)
    base = fs._strip_protocol(str(root)).rstrip("/")
    found = with_retries(lambda: _find(fs, base), str(root))
    relative = {name.removeprefix(base).lstrip("/"): about for name, about in found.items()}
    return {name: relative[name] for name in sorted(relative) if name}


def _find(fs: Any, base: str) -> dict[str, dict[str, Any]]:
    lists_all = getattr(type(fs), "_find", AsyncFileSystem._find) is not AsyncFileSystem._find
    if lists_all or (not isinstance(fs, AsyncFileSystem) and type(fs).find is not AbstractFileSystem.find):
        return fs.find(base, detail=True)
    # fsspec's own walk leaves out the folders that it could not list, below the first one even when told not to.
    found: dict[str, dict[str, Any]] = {}
    folders = [base]
    try:
        while folders:
            folder = folders.pop()
            for about in fs.ls(folder, detail=True):
                name = about["name"].rstrip("/")
                if about["type"] != "directory":
                    found[name] = about
                elif name != folder.rstrip("/"):
                    folders.append(name)
    except FileNotFoundError:
        if _kind_at(fs, base) is not None:
            raise  # it vanished meanwhile
    return found


def remote_kind(path: AnyPath) -> str | None:
    """What is at a location: "file", "directory", or None for nothing.

    fsspec's `isfile` takes an answer that did not come for a no; then an optional file would be left out silently.

    Raises: PermissionError where the store does not say; UnreachableInputError when it does not answer.
    """
    fs = file_system(path)
    return with_retries(lambda: _kind_at(fs, fs._strip_protocol(str(path))), str(path))


def _kind_at(fs: Any, name: str) -> str | None:
    """`remote_kind` of a name in a file system, asked once."""
    try:
        return fs.info(name)["type"]
    except FileNotFoundError:
        return None


_CHANGE_MARKS = (
    "ETag", "etag", "checksum", "md5Hash", "content_md5", "LastModified", "last_modified", "mtime", "created",
)  # fmt: skip
"""Attributes by which stores tell that a file's content changed; the first one present is taken."""


def remote_digest(root: AnyPath) -> str:
    """Digest of what a store lists below `root`: names, sizes and the mark of each file's content.

    Raises: ArtifactError when nothing is there; UnreachableInputError when the store does not answer.
    """
    entries = []
    for name, about in list_files(root).items():
        mark = next((str(about[key]) for key in _CHANGE_MARKS if about.get(key) is not None), "")
        entries.append([name, about.get("size"), mark])
    if not entries:
        raise ArtifactError("There is nothing at an input's location", where=root, next_step="check the URL")
    return digest_value(entries)


class RemoteCache:
    """Copies of remote files below one folder, the least recently read removed first.

    A copy may be removed as soon as the next file is fetched: open what `fetch` returns at once, and ask again later.
    A single file larger than the bound is kept alone.
    """

    def __init__(self, folder: Path, max_bytes: int = DEFAULT_CACHE_BYTES) -> None:
        self.folder = folder
        self.max_bytes = max_bytes
        self.fetched_bytes = 0
        self._sizes: OrderedDict[Path, int] = OrderedDict()
        self._lock = threading.Lock()

    def place(self, path: AnyPath) -> Path:
        """Where the copy of a remote file lies: the store's own names, so that messages can be made portable."""
        fs = file_system(path)
        parts = PurePosixPath(fs._strip_protocol(str(path))).parts
        return self.folder.joinpath(
            cast("UPath", path).protocol, *(part for part in parts if part not in ("/", "..", "."))
        )

    def has(self, path: AnyPath) -> bool:
        """Whether there is a copy."""
        return self.place(path) in self._sizes

    def fetch(self, path: AnyPath) -> Path:
        """A copy of the file on this machine.

        Raises: FileNotFoundError; UnreachableInputError when the store does not answer.
        """
        with self._lock:
            copy = self.place(path)
            if copy in self._sizes:
                self._sizes.move_to_end(copy)
                return copy
            fs = file_system(path)
            size = with_retries(lambda: self._download(fs, path, copy), str(path))
            self.fetched_bytes += size
            self._sizes[copy] = size
            while sum(self._sizes.values()) > self.max_bytes and len(self._sizes) > 1:
                oldest, _ = self._sizes.popitem(last=False)
                oldest.unlink(missing_ok=True)
            return copy

    def _download(self, fs: Any, path: AnyPath, copy: Path) -> int:
        about = fs.info(str(path))
        if about.get("type") != "file":
            raise FileNotFoundError(errno.ENOENT, "Not a file", str(path))
        copy.parent.mkdir(parents=True, exist_ok=True)
        temporary = copy.with_name(f".{copy.name}.tmp")
        try:
            fs.get_file(str(path), str(temporary))
            size = temporary.stat().st_size
            if about.get("size") is not None and size != about["size"]:
                fs.invalidate_cache()
                raise OSError(errno.EIO, f"download ended after {size} of {about['size']} bytes", str(path))
            temporary.replace(copy)
        finally:
            temporary.unlink(missing_ok=True)
        return size

    def clear(self) -> None:
        """Remove all copies."""
        with self._lock:
            self._sizes.clear()
            shutil.rmtree(self.folder, ignore_errors=True)


_process_cache: RemoteCache | None = None


def process_cache() -> RemoteCache:
    """The cache of this process, below the machine's folder for temporary files; removed when the process ends."""
    global _process_cache
    if _process_cache is None or _process_cache.folder.name != f"{_FOLDER_PREFIX}{os.getpid()}":
        temporary = Path(tempfile.gettempdir())
        _remove_leftovers(temporary)
        _process_cache = RemoteCache(temporary / f"{_FOLDER_PREFIX}{os.getpid()}")
        _process_cache.clear()  # of an earlier process with this number
        atexit.register(_process_cache.clear)
    return _process_cache


def _remove_leftovers(temporary: Path) -> None:
    """Caches of this user's processes that were killed."""
    for folder in temporary.glob(f"{_FOLDER_PREFIX}*"):
        number = folder.name.removeprefix(_FOLDER_PREFIX)
        if number.isdigit() and not Path(f"/proc/{number}").exists() and Path("/proc/self").exists():
            shutil.rmtree(folder, ignore_errors=True)
