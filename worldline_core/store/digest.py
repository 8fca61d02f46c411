"""Digests of values, files and artifact folders."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from worldline_core.errors import ArtifactError

#: Not part of an artifact's content: timings, logs, resume state, recordings with wall-clock stamps.
VOLATILE_FOLDER = "run"
MANIFEST_NAME = "manifest.json"


def digest_value(value: Any) -> str:
    """SHA-256 of a JSON value, independent of key order."""
    canonical = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def digest_file(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def folder_files(folder: Path) -> list[Path]:
    """The files that make up a folder's content, sorted: without the manifest and the volatile folder.

    Raises:
        ArtifactError: a symbolic link leads out of the folder.
    """
    root = folder.resolve()
    files = []
    for path in sorted(folder.rglob("*")):
        relative = path.relative_to(folder)
        if relative.parts[0] == VOLATILE_FOLDER or relative == Path(MANIFEST_NAME) or path.is_dir():
            continue
        if path.is_symlink() and not path.resolve().is_relative_to(root):
            raise ArtifactError("A symbolic link leads out of the folder", where=path, got=path.resolve())
        files.append(path)
    return files


def digest_folder(folder: Path) -> str:
    """SHA-256 over the relative names and bytes of a folder's content."""
    entries = [[path.relative_to(folder).as_posix(), digest_file(path)] for path in folder_files(folder)]
    return digest_value(entries)
