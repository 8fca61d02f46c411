"""Where artifacts live, and the one place that makes a step cached and resumable.

``artifacts/<step>/<key>/`` holds a finished artifact; its ``manifest.json`` is written last. The key is a digest of
the step's name and version, its config, and the digests of its inputs and of weights that the config names: nothing
else decides whether work is done again. Unfinished work lives in ``<key>.partial/`` and is continued by the next call.

One process at a time works on an artifact; the lock ends with its process. Of several processes that torchrun started
on one step the first owns the artifact and the others help. It announces itself in a small file beside the lock, so
that a helper neither waits for a lock that is never freed nor joins work that another command is doing.
"""

from __future__ import annotations

import fcntl
import importlib.metadata
import logging
import os
import platform
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from worldline_core.config import StrictModel, cache_relevant_config
from worldline_core.errors import ArtifactError
from worldline_core.store.artifact_files import (
    KEY_LENGTH,
    MANIFEST_NAME,
    VOLATILE_FOLDER,
    digest_folder,
    digest_value,
    how_to_rebuild,
    is_artifact,
    is_stored,
    read_json,
    read_manifest,
    write_manifest,
)
from worldline_core.store.atomic import remove_unfinished, write_bytes_atomic
from worldline_core.store.remote import is_remote, remote_digest
from worldline_core.store.verification import VerifyMode, verify_inputs, weights_digests

logger = logging.getLogger(__name__)

_VERSIONED_PACKAGES = ("torch", "numpy", "av", "diffusers", "prefect", "lerobot", "worldline")
_POLL_SECONDS = 0.1
_WRITERS = ".writers"

StepFunction = Callable[[Any, Mapping[str, Path], Path], dict[str, Any]]


@contextmanager
def exclusive_lock(path: Path) -> Iterator[None]:
    """Hold an advisory lock on ``path`` (``flock``: the kernel frees it when the process ends, also after kill -9)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            logger.warning("waiting for another process that works on %s", path.stem)
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def helper_lock(folder: Path) -> Iterator[None]:
    """Held by a process that writes into a step's folder on behalf of the one that holds its lock: if that one is killed,
    who takes the work over waits for this one to end."""
    path = folder / VOLATILE_FOLDER / _WRITERS
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def alone_in(folder: Path, doing: str) -> Iterator[None]:
    """Within the context no other command of this project writes into a folder of a user's own choice.

    Raises: ArtifactError when another one does.
    """
    (folder / VOLATILE_FOLDER).mkdir(parents=True, exist_ok=True)
    path = folder / VOLATILE_FOLDER / ".lock"
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ArtifactError(
                f"Another command is {doing} into this folder",
                where=folder,
                next_step="wait for it, or choose another one",
            ) from error
        try:
            yield
        finally:
            path.unlink(missing_ok=True)
            with suppress(OSError):  # others have something in there
                path.parent.rmdir()
    finally:
        os.close(descriptor)


def is_helper() -> bool:
    """Whether torchrun started this process as another than the first."""
    return int(os.environ.get("WORLD_SIZE", "1")) > 1 and int(os.environ.get("RANK", "0")) > 0


def _launch() -> bytes:
    """Names the launch that this process belongs to: the same in all of its processes."""
    names = ("TORCHELASTIC_RUN_ID", "MASTER_ADDR", "MASTER_PORT", "WORLD_SIZE")
    return " ".join(os.environ.get(name, "") for name in names).encode()


@contextmanager
def announced(path: Path) -> Iterator[None]:
    """Within the context, helpers of this launch may work; without helpers nothing is written."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield
        return
    write_bytes_atomic(path, _launch())
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


def is_announced(path: Path) -> bool:
    """Whether the first process of this launch has begun. If it fails instead, torchrun ends this one."""
    return path.is_file() and path.read_bytes() == _launch()


def wait_until[T](finished: Callable[[], T | None]) -> T:
    """Return what ``finished`` finds, once it finds something."""
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
    """The artifacts below one root folder (``artifacts/`` unless told otherwise).

    Args:
        verify: how the files of a step's inputs are compared with their manifests before the step reads them.
    """

    def __init__(self, root: Path, verify: VerifyMode = "full") -> None:
        self.root = root.resolve()
        self.verify: VerifyMode = verify

    def key(self, step: str, version: int, config: StrictModel, inputs: Mapping[str, str]) -> str:
        """Content key of a step. ``inputs`` maps an input's name to the digest of its content."""
        made = cache_relevant_config(config.model_dump(mode="json"))
        identity = {"step": step, "version": version, "config": made, "inputs": dict(inputs)}
        if weights := weights_digests(config.weights_read(), self.root / ".weights.json"):
            identity |= {"weights": weights}
        return digest_value(identity)[:KEY_LENGTH]

    def find(self, step: str, key: str) -> Artifact | None:
        """The finished artifact of a key, or None."""
        folder = self.root / step / key
        if not (folder / MANIFEST_NAME).is_file():
            return None
        manifest = read_manifest(folder)
        if "digest" not in manifest:
            raise ArtifactError("A manifest has no digest", where=folder, next_step=how_to_rebuild(folder))
        return Artifact(step, folder, str(manifest["digest"]), cached=True)

    def input_digest(self, path: Path) -> str:
        """Digest of an input: read from the manifest of an artifact, computed for any other folder.

        Of a location in an object store the listing counts (names, sizes, and the store's own digests or times of
        change): its files are not read twice.

        Raises:
            ArtifactError: the folder does not exist; what lies outside of a store is not what its manifest states.
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
            verify_inputs({"of this step": path}, "fast")  # recordings and models, which their owner may change
        return str(read_manifest(path)["digest"])

    def run(
        self,
        step: str,
        version: int,
        function: StepFunction,
        config: StrictModel,
        inputs: Mapping[str, Path],
        *,
        seeds: Mapping[str, int] | None = None,
        distributed: bool = False,
    ) -> Artifact:
        """Return the artifact of a step, working only for what is not there yet.

        Args:
            distributed: the step shares its work among the processes of torchrun. Of any other step the first process
                does all the work.

        Raises:
            ArtifactError: files of an input are not those that were written.
            WorldLineError: whatever the step raises; its unfinished work stays in ``<key>.partial/``.
        """
        digests = {name: self.input_digest(path) for name, path in sorted(inputs.items())}
        key = self.key(step, version, config, digests)
        if (found := self.find(step, key)) is not None:
            logger.info("%s %s: cached%s", step, key, _account(found.path))
            return found
        folder = self.root / step / key
        partial = folder.with_name(f"{key}.partial")
        sources = {name: path if is_remote(path) else path.resolve() for name, path in inputs.items()}
        announcement = self.root / step / f".{key}.workers"
        if is_helper():
            wait_until(lambda: self.find(step, key) or is_announced(announcement) or None)
            if distributed and self.find(step, key) is None:
                with helper_lock(partial):
                    function(config, sources, partial)
            return wait_until(lambda: self.find(step, key))
        with exclusive_lock(self.root / step / f".{key}.lock"):
            if (found := self.find(step, key)) is not None:
                return found
            verify_inputs(sources, self.verify)
            if folder.exists():
                # A folder without a manifest is not an artifact: someone deleted the manifest, or copied half of it.
                shutil.rmtree(folder)
            resumed = partial.exists()
            partial.mkdir(parents=True, exist_ok=True)
            if (writers := partial / VOLATILE_FOLDER / _WRITERS).exists():
                with exclusive_lock(writers):  # until workers of a killed command have ended
                    pass
            remove_unfinished(partial)
            logger.info("%s %s: %s", step, key, "continuing" if resumed else "working")
            started = time.time()
            with announced(announcement):
                metrics = function(config, sources, partial)
            facts = {
                "step": step,
                "version": version,
                "key": key,
                "config": config.model_dump(mode="json"),
                "inputs": {
                    name: {"path": _portable(path, self.root), "digest": digests[name]} for name, path in inputs.items()
                },
                "seeds": dict(seeds) if seeds is not None else _seeds(config.model_dump(mode="json")),
                "metrics": metrics,
                "environment": {
                    **describe_environment(),
                    "threads": read_json(partial / VOLATILE_FOLDER / "threads.json").get("threads"),
                },
                "resumed": resumed,
                "wall_seconds": round(time.time() - started, 3),
                "finished_at": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            }
            digest = write_manifest(partial, facts)
            partial.replace(folder)
            logger.info("%s %s: done in %.0f s%s", step, key, facts["wall_seconds"], _account(folder))
        return Artifact(step, folder, digest, cached=False)


def _account(folder: Path) -> str:
    """What became of a step's episodes, where it says so, and where its result lies."""
    metrics = read_manifest(folder).get("metrics", {})
    parts: list[str] = []
    if {"found", "kept"} <= metrics.keys():
        lost, reasons = "quarantined", metrics.get("reasons", metrics.get("quarantine_reasons", {}))
        if "left_out" in metrics:
            lost, reasons = "left out", metrics["left_out"]
        named = ", ".join(f"{count} {reason}" for reason, count in reasons.items() if count)
        account = f"found {metrics['found']}, kept {metrics['kept']}, {lost} {metrics['found'] - metrics['kept']}"
        parts.append(f"{account} ({named})" if named else account)
    if metrics.get("splits", {}).keys() == {"test"}:
        parts.append("all in split test, so nothing is trained on them (curate.sources[].split, curate.splits)")
    return "; ".join(["", *parts, str(folder)])


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


def describe_environment() -> dict[str, Any]:
    """Versions, device and commit: what a result depends on besides its config and inputs."""
    versions = {}
    for package in _VERSIONED_PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu_count": os.cpu_count(),
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
