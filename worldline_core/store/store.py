"""The artifact store: the one place that makes a step cached and resumable.

``artifacts/<step>/<key>/`` holds a finished artifact; its ``manifest.json`` is written last. The key is a digest of
the step's name and version, its config, and the digests of its inputs and of weights that the config names: nothing
else decides whether work is done again. Unfinished work lives in ``<key>.partial/`` and is continued by the next call.

One process at a time works on an artifact; the lock ends with its process. Of several processes that torchrun started
on one step the first owns the artifact and the others help. It announces itself in a small file beside the lock, so
that a helper neither waits for a lock that is never freed nor joins work that another command is doing.
"""

from __future__ import annotations

import errno
import fcntl
import functools
import importlib.metadata
import logging
import os
import platform
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError

from worldline_core.config import StrictModel, cache_relevant_config
from worldline_core.errors import ArtifactError, WorldLineError
from worldline_core.processor import processor_has_bfloat16
from worldline_core.store.artifact_files import (
    KEY_LENGTH,
    MANIFEST_NAME,
    VOLATILE_FOLDER,
    VerifyMode,
    digest_file,
    digest_folder,
    digest_listed,
    digest_value,
    is_artifact,
    is_stored,
    read_json,
    read_manifest,
    verify_artifact,
    write_manifest,
)
from worldline_core.store.atomic import remove_unfinished, write_bytes_atomic, write_json_atomic
from worldline_core.store.remote import is_remote, remote_digest

logger = logging.getLogger(__name__)

_VERSIONED_PACKAGES = ("torch", "numpy", "av", "diffusers", "prefect", "lerobot", "worldline")
_POLL_SECONDS = 0.1
LATEST = "latest"
"""Folder of links by name, one to the last artifact of each call."""
_WRITERS = ".writers"

StepFunction = Callable[[Any, Mapping[str, Path], Path], dict[str, Any]]


_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def disk_full(error: BaseException) -> bool:
    """Returns whether an error says that a disk is full, or a quota or the allowed size of a file used up."""
    if isinstance(error, OSError):
        return error.errno in _FULL
    return isinstance(error, SafetensorError) and any(f"(os error {number})" in str(error) for number in _FULL)


@contextmanager
def clear_full_disk(folder: Path | None = None) -> Iterator[None]:
    """Turn the error of a full disk into one ArtifactError.

    Args:
        folder: where is written, for errors that name no file.
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, WorldLineError) or not disk_full(error):
            raise
        raise ArtifactError(
            "No space left",
            where=getattr(error, "filename", None) or folder,
            got=error,
            next_step="free some space, or choose a folder elsewhere (--artifacts, --output); the same command continues",
        ) from error


@contextmanager
def clear_store_errors(root: Path) -> Iterator[None]:
    """Turn a full disk, and below ``root`` missing rights, a read-only disk and files in the way, into one ArtifactError."""
    try:
        with clear_full_disk(root):
            yield
    except OSError as error:
        in_the_way = PermissionError | FileExistsError | NotADirectoryError | IsADirectoryError
        if not isinstance(error, in_the_way) and error.errno not in (errno.EROFS, errno.EXDEV, errno.ELOOP):
            raise
        place = Path(str(error.filename or root))
        if not place.is_relative_to(root):
            raise
        raise ArtifactError(
            "A file or folder of the store cannot be used",
            where=place,
            expected="a store whose files can be read and written",
            got=error.strerror,
            next_step="correct its rights or remove what is in the way, or choose another folder",
        ) from error


@contextmanager
def _lock_file(path: Path) -> Iterator[int]:
    """Open a lock file. ``flock`` ends with the process, also after kill -9."""
    with clear_store_errors(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


@contextmanager
def exclusive_lock(path: Path, *, wait: bool = True) -> Iterator[None]:
    """Hold the lock on ``path``, waiting for another process to release it.

    Raises:
        ArtifactError: another process holds the lock and ``wait`` is false.
    """
    with _lock_file(path) as descriptor:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if not wait:
                raise ArtifactError(
                    "Another command writes into this folder",
                    where=path.parent,
                    next_step="wait for it, or choose another folder",
                ) from error
            logger.warning("waiting for another process that works on %s", path.stem)
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield


@contextmanager
def helper_lock(folder: Path) -> Iterator[None]:
    """Lock held by a process that writes into a step's folder on behalf of the step's owner.

    If the owner is killed, the next one waits for its helpers to end.
    """
    with _lock_file(folder / VOLATILE_FOLDER / _WRITERS) as descriptor:
        fcntl.flock(descriptor, fcntl.LOCK_SH)
        yield


def folder_lock(folder: Path) -> AbstractContextManager[None]:
    """Keep other commands of this project out of a folder that the user chose.

    Raises:
        ArtifactError: another command writes into it.
    """
    return exclusive_lock(folder / VOLATILE_FOLDER / ".lock", wait=False)


def _is_helper() -> bool:
    """Returns whether torchrun started this process as another than the first."""
    return int(os.environ.get("WORLD_SIZE", "1")) > 1 and int(os.environ.get("RANK", "0")) > 0


def _launch() -> bytes:
    """An identity shared by all processes of one launch."""
    names = ("TORCHELASTIC_RUN_ID", "MASTER_ADDR", "MASTER_PORT", "WORLD_SIZE")
    return " ".join(os.environ.get(name, "") for name in names).encode()


@contextmanager
def _announced(path: Path) -> Iterator[None]:
    """Let helpers of this launch work inside of the context; without helpers nothing is written."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield
        return
    write_bytes_atomic(path, _launch())
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


def _wait_until[T](finished: Callable[[], T | None]) -> T:
    while (found := finished()) is None:
        time.sleep(_POLL_SECONDS)
    return found


@dataclass(frozen=True)
class Artifact:
    """A finished artifact: its folder and the digest of its content."""

    step: str
    path: Path
    digest: str
    cached: bool

    @property
    def key(self) -> str:
        return self.path.name


class ArtifactStore:
    """The artifacts below one root folder (``artifacts/`` by default).

    Args:
        verify: how a step's inputs are compared with their manifests before the step reads them.
    """

    def __init__(self, root: Path, verify: VerifyMode = "full") -> None:
        self.root = root.resolve()
        self.verify: VerifyMode = verify

    def key(self, step: str, version: int, config: StrictModel, inputs: Mapping[str, str]) -> str:
        """Content key of a step. ``inputs`` maps an input's name to the digest of its content."""
        relevant = cache_relevant_config(config.model_dump(mode="json"))
        identity = {"step": step, "version": version, "config": relevant, "inputs": dict(inputs)}
        if weights := _weights_digests(config.weights_read(), self.root / ".weights.json"):
            identity |= {"weights": weights}
        return digest_value(identity)[:KEY_LENGTH]

    def find(self, step: str, key: str) -> Artifact | None:
        """The finished artifact of a key, or None."""
        folder = self.root / step / key
        if not (folder / MANIFEST_NAME).is_file():
            return None
        manifest = read_manifest(folder)
        return Artifact(step, folder, manifest["digest"], cached=True)

    def linked(self, name: str, artifact: Artifact) -> Artifact:
        """Let `latest/<name>` lead to an artifact: keys are no names. Nothing reads these links but people."""
        link = self.root / LATEST / name
        temporary = link.with_name(f".{name}.{os.getpid()}")
        try:
            link.parent.mkdir(exist_ok=True)
            temporary.symlink_to(os.path.relpath(artifact.path, link.parent), target_is_directory=True)
            temporary.replace(link)
        except OSError as error:  # a file system without links, or one that may not be written
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            logger.info("no link %s: %s", link, error)
        return artifact

    def input_digest(self, path: Path) -> str:
        """Digest of an input: read from the manifest of an artifact, computed for any other folder.

        For a location in an object store it is the digest of the listing (names, sizes, and the store's own digests or
        modification times), so that files are not read twice.

        Raises:
            ArtifactError: the folder does not exist; an artifact outside of a store differs from its manifest.
            UnreachableInputError: the store does not answer.
        """
        if is_remote(path):
            return remote_digest(path)
        if not path.is_dir():
            raise ArtifactError(
                "An input folder does not exist",
                where=path,
                next_step="correct the path (of recordings: sources[].path), or run the step that makes it",
            )
        if not is_artifact(path):
            return digest_folder(path, everything=True)
        if not is_stored(path) and self.verify != "off":
            verify_artifact(path, "fast", "An input")  # recordings and models, which their owner may change
        return str(read_manifest(path)["digest"])

    def run(
        self,
        step: str,
        version: int,
        function: StepFunction,
        config: StrictModel,
        inputs: Mapping[str, Path],
        *,
        distributed: bool = False,
    ) -> Artifact:
        """Return the artifact of a step, working only for what is missing.

        Args:
            distributed: the step shares its work among the processes of torchrun; otherwise the first process does it all.

        Raises:
            ArtifactError: an input differs from its manifest, the store cannot be read or written, or the disk is full.
            WorldLineError: an error of the step; its unfinished work stays in ``<key>.partial/``.
        """
        with clear_store_errors(self.root):
            return self._run(step, version, function, config, inputs, distributed)

    def _run(
        self,
        step: str,
        version: int,
        function: StepFunction,
        config: StrictModel,
        inputs: Mapping[str, Path],
        distributed: bool,
    ) -> Artifact:
        digests = {name: self.input_digest(path) for name, path in sorted(inputs.items())}
        key = self.key(step, version, config, digests)
        if (found := self.find(step, key)) is not None:
            logger.info(
                "%s %s: cached%s; %s", step, key, _counts(read_manifest(found.path).get("metrics", {})), found.path
            )
            return found
        folder = self.root / step / key
        if not folder.parent.resolve().is_relative_to(self.root):
            raise ArtifactError(
                "A step's folder is a link out of the store",
                where=folder.parent,
                got=folder.parent.resolve(),
                next_step="link the whole store instead: manifests name inputs by paths relative to it",
            )
        partial = folder.with_name(f"{key}.partial")
        sources = {name: path if is_remote(path) else path.resolve() for name, path in inputs.items()}
        announcement = folder.with_name(f".{key}.workers")
        if _is_helper():
            _wait_until(
                lambda: (
                    self.find(step, key)
                    or (announcement.is_file() and announcement.read_bytes() == _launch())
                    or None  # if the first process fails instead, torchrun ends this one
                )
            )
            if distributed and self.find(step, key) is None:
                with helper_lock(partial):
                    function(config, sources, partial)
            return _wait_until(lambda: self.find(step, key))
        with exclusive_lock(folder.with_name(f".{key}.lock")):
            if (found := self.find(step, key)) is not None:
                return found
            for name, path in sources.items():
                if not is_remote(path):
                    verify_artifact(path, self.verify, f"Input {name}")
            if folder.exists():
                # Not an artifact without its manifest: the manifest was deleted, or half of the folder copied.
                shutil.rmtree(folder)
            resumed = partial.exists()
            partial.mkdir(parents=True, exist_ok=True)
            if (writers := partial / VOLATILE_FOLDER / _WRITERS).exists():
                with exclusive_lock(writers):  # until helpers of a killed command have ended
                    pass
            remove_unfinished(partial)
            logger.info("%s %s: %s", step, key, "continuing" if resumed else "working")
            started = time.monotonic()
            with _announced(announcement):
                metrics = function(config, sources, partial)
            facts = {
                "step": step,
                "version": version,
                "key": key,
                "config": config.model_dump(mode="json"),
                "inputs": {
                    name: {"path": _portable(path, self.root), "digest": digests[name]} for name, path in inputs.items()
                },
                "seeds": _seeds(config.model_dump(mode="json")),
                "metrics": metrics,
                "environment": {
                    **describe_environment(),
                    "threads": read_json(partial / VOLATILE_FOLDER / "threads.json").get("threads"),
                },
                "resumed": resumed,
                "wall_seconds": round(time.monotonic() - started, 3),
                "finished_at": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            }
            digest = write_manifest(partial, facts)
            partial.replace(folder)
            logger.info("%s %s: done in %.0f s%s; %s", step, key, facts["wall_seconds"], _counts(metrics), folder)
        return Artifact(step, folder, digest, cached=False)


def _counts(metrics: Mapping[str, Any]) -> str:
    """The counts among a step's metrics, for a log line."""
    parts = [f"; {name} {value}" for name, value in metrics.items() if type(value) is int]
    for name, values in metrics.items():
        if isinstance(values, Mapping) and values and all(type(value) is int for value in values.values()):
            parts.append(f"; {name}: " + ", ".join(f"{value} {of}" for of, value in values.items()))
    return "".join(parts)


def _portable(path: Path, root: Path) -> str:
    """Paths in manifests are relative to the artifacts' root, so that a checkout can be moved."""
    return str(path) if is_remote(path) else os.path.relpath(path.resolve(), root)


def _seeds(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    seeds: dict[str, Any] = {}
    for name, value in config.items():
        if isinstance(value, Mapping):
            seeds.update(_seeds(value, f"{prefix}{name}."))
        elif name in ("seed", "seeds"):
            seeds[f"{prefix}{name}"] = value
    return seeds


def _weights_digests(places: Mapping[str, Path | None], cache: Path) -> dict[str, str]:
    """Digests of weight files, or of the files in a folder, by name; missing ones are left out.

    Files of the same size and modification time are not read again: weights have gigabytes. Folders of the Hugging Face
    hub's cache consist of links; its hidden files are notes.
    """
    digests = dict[str, str]()
    for name, place in places.items():
        if place is None or not place.exists():
            continue
        known = read_json(cache)
        files: dict[str, dict[str, str]] = {}
        for path in sorted(path for path in [place, *place.rglob("*")] if path.is_file()):
            relative, facts = path.relative_to(place), path.stat()
            if any(part.startswith(".") for part in relative.parts):
                continue
            key = f"{path.resolve()} {facts.st_size} {facts.st_mtime_ns}"
            if key not in known:
                known[key] = digest_file(path)
                with suppress(OSError, ArtifactError), exclusive_lock(cache.with_suffix(".lock")):  # a read-only store
                    known |= read_json(cache)  # of other processes meanwhile
                    write_json_atomic(cache, known)
            files[relative.as_posix()] = {"sha256": known[key]}
        digests[name] = digest_listed(files)
    return digests


@functools.cache
def describe_environment() -> dict[str, Any]:
    """Versions, device and commit: what a result depends on besides its config and inputs. Looked up once: a process goes on
    with the code that it began with.
    """
    versions = {}
    for package in _VERSIONED_PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu_count": os.cpu_count(),
        "processor_has_bfloat16": processor_has_bfloat16(),
        "processes": int(os.environ.get("WORLD_SIZE", "1")),
        "packages": versions,
        "git_commit": _git_commit(),
    }


def _git_commit() -> str | None:
    try:
        result = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12"],  # noqa: S607
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=False,
            timeout=10,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout.strip() or None
