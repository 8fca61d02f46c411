"""The files of artifacts: their digests, what kind they are, and JSON and Parquet read with errors that name the file."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from worldline_core.errors import ArtifactError
from worldline_core.store.atomic import write_json_atomic

if TYPE_CHECKING:
    import pyarrow as pa

JsonObject = dict[str, Any]
MANIFEST_NAME = "manifest.json"
KEY_LENGTH = 16
VOLATILE_FOLDER = "run"
"""Not part of an artifact's content: timings, logs, resume state, recordings with wall-clock stamps."""


def read_json(path: Path) -> JsonObject:
    """A JSON object from a file; an absent file is an empty object.

    Raises:
        ArtifactError: the file is not a JSON object.
    """
    if not path.is_file():
        return {}
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ArtifactError(
            "A JSON file is damaged", where=path, got=str(error), next_step="rebuild the artifact"
        ) from error
    if not isinstance(value, dict):
        raise ArtifactError("A JSON file has a wrong form", where=path, expected="an object", got=type(value).__name__)
    return value


def read_json_lines(path: Path, *, atomic: bool = False) -> list[JsonObject]:
    """The objects of a `.jsonl` file; none of an absent one. A last line that a kill cut short is left out, but of a file
    that is written as a whole (``atomic``).

    Raises:
        ArtifactError: a line before the last is not a JSON object.
    """
    if not path.is_file():
        return []
    rows: list[JsonObject] = []
    lines = [line for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    for index, line in enumerate(lines):
        try:
            value = json.loads(line)
        except (ValueError, RecursionError) as error:
            if index == len(lines) - 1 and not atomic:
                break
            raise ArtifactError("A line is not JSON", where=f"{path}:{index + 1}", got=line[:80]) from error
        if not isinstance(value, dict):
            raise ArtifactError("A line is not an object", where=f"{path}:{index + 1}", got=line[:80])
        rows.append(value)
    return rows


def read_table(path: Path, columns: Sequence[str] | None = None) -> pa.Table | None:
    """A Parquet table, or some of its columns; None where there is no file.

    Raises:
        ArtifactError: the file cannot be read.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not path.is_file():
        return None
    try:
        return pq.read_table(path, columns=None if columns is None else list(columns))
    except (pa.ArrowInvalid, OSError) as error:
        raise ArtifactError(
            "A Parquet file is damaged", where=path, got=str(error), next_step="rebuild the artifact"
        ) from error


def read_rows(path: Path) -> list[JsonObject]:
    """The rows of a Parquet table as objects; no file means no rows."""
    found = read_table(path)
    return [] if found is None else found.to_pylist()


def row_schema(row: type) -> pa.Schema:
    """The Parquet columns of a dataclass: its fields, in order; an optional one has the type of its values."""
    import pyarrow as pa

    columns = {int: pa.int64(), float: pa.float64(), bool: pa.bool_(), tuple[str, ...]: pa.list_(pa.string())}
    schema = []
    for name, hint in get_type_hints(row).items():
        known = [columns[kind] for kind in (hint, *get_args(hint)) if kind in columns]
        schema.append((name, known[0] if known else pa.string()))
    return pa.schema(schema)


def kind_of(folder: Path) -> str:
    """The kind of an artifact, told by its files.

    Raises:
        ArtifactError: the folder is not there, or is of no known kind.
    """
    if not folder.is_dir():
        raise ArtifactError("No such artifact folder", where=folder, next_step="give the folder of a finished artifact")
    if (folder / "scores.parquet").is_file():
        return "Scores"
    if (folder / "checkpoint.json").is_file():
        return "Checkpoint"
    if (folder / "index.html").is_file():
        return "Report"
    index = read_table(folder / "index.parquet")
    columns = set() if index is None else set(index.column_names)
    for kind, needed in (
        ("RolloutSet", {"episode_id", "method", "seed"}),
        ("EpisodeSet", {"episode_id", "dataset", "outcome"}),
        ("ActionTracks", {"episode_id", "arms", "shard"}),
        ("Latents", {"episode_id"}),
    ):
        if needed <= columns:
            return kind
    if (folder / "quarantine.parquet").is_file():
        return "Quarantine"
    raise ArtifactError(
        "Not an artifact of a known kind",
        where=folder,
        expected="index.parquet, scores.parquet, checkpoint.json, quarantine.parquet or index.html",
        got=", ".join(sorted(path.name for path in folder.iterdir())[:8]) or "an empty folder",
    )


def linked_folder(folder: Path, name: str) -> Path | None:
    """The folder of an input that an artifact's manifest names, where it is still there.

    Manifests name inputs relative to the root of the artifacts, two folders up.
    """
    inputs = read_json(folder / "manifest.json").get("inputs")
    entry = inputs.get(name) if isinstance(inputs, dict) else None
    if not isinstance(entry, dict) or not isinstance(entry.get("path"), str):
        return None
    path = folder.resolve().parent.parent / entry["path"]
    return path if path.is_dir() else None


def digest_value(value: Any) -> str:
    """SHA-256 of a JSON value, independent of key order."""
    canonical = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def digest_file(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def folder_files(folder: Path, *, everything: bool = False) -> list[Path]:
    """The files that make up a folder's content, sorted: without the manifest and the volatile folder, or everything.

    Raises:
        ArtifactError: a symbolic link leads out of the folder.
    """
    root, depth = folder.resolve(), len(folder.parts)
    files = []
    for path in sorted(folder.rglob("*")):
        relative = path.parts[depth:]
        ours = relative[0] == VOLATILE_FOLDER or relative == (MANIFEST_NAME,)
        if (ours and not everything) or path.is_dir():
            continue
        if path.is_symlink() and not path.resolve().is_relative_to(root):
            raise ArtifactError("A symbolic link leads out of the folder", where=path, got=path.resolve())
        files.append(path)
    return files


def content_files(folder: Path, *, everything: bool = False) -> dict[str, JsonObject]:
    """Relative name -> `size` [bytes] and `sha256` of every file of a folder's content, as a manifest states them.

    Raises:
        ArtifactError: a file that the folder lists is gone when it is read, as where somebody still writes to it.
    """
    try:
        return {
            path.relative_to(folder).as_posix(): {"size": path.stat().st_size, "sha256": digest_file(path)}
            for path in folder_files(folder, everything=everything)
        }
    except FileNotFoundError as error:
        raise ArtifactError(
            "A file was gone when its folder was read",
            where=error.filename or folder,
            expected="a folder that nothing writes to, without links to nothing",
            next_step="wait until what writes it is done (a recording, a copy), then run the command again",
        ) from error


def digest_listed(files: Mapping[str, JsonObject]) -> str:
    """SHA-256 over the names and digests of listed files: the digest of the artifact that they make up."""
    return digest_value([[name, files[name]["sha256"]] for name in sorted(files, key=lambda name: name.split("/"))])


def digest_folder(folder: Path, *, everything: bool = False) -> str:
    """SHA-256 over the relative names and bytes of a folder's content.

    Args:
        everything: its manifest and volatile folder too, which of a folder that is no artifact are its owner's.
    """
    return digest_listed(content_files(folder, everything=everything))


def is_artifact(folder: Path) -> bool:
    """Whether a folder has the manifest of a finished artifact, damaged or not, and not another file of that name."""
    path = folder / MANIFEST_NAME
    if not path.is_file():
        return False
    text = path.read_bytes()
    return is_stored(folder) or all(f'"{key}"'.encode() in text for key in ("digest", "step"))


def write_manifest(folder: Path, facts: Mapping[str, Any]) -> str:
    """Finish an artifact: write its manifest, with the facts of the step, and return the digest of its content.

    `files` states every file, `digest` the whole content, `manifest_sha256` all that the manifest says besides.
    """
    files = content_files(folder)
    content = json.loads(json.dumps({**facts, "digest": digest_listed(files), "files": files}, allow_nan=False))
    write_json_atomic(folder / MANIFEST_NAME, {**content, "manifest_sha256": digest_value(content)})
    return content["digest"]


def read_manifest(folder: Path) -> JsonObject:
    """The manifest of a finished artifact; an empty object where there is none.

    Raises:
        ArtifactError: it is damaged. One that lists no files (of an earlier version) has nothing to be compared with.
    """
    path = folder / MANIFEST_NAME
    try:
        manifest = read_json(path)
    except ArtifactError as error:
        raise ArtifactError(error.what, where=path, got=error.got, next_step=how_to_rebuild(folder)) from error
    stated = manifest.pop("manifest_sha256", None)
    if stated is None and "files" not in manifest:
        return manifest
    if stated != (found := digest_value(manifest)):
        raise ArtifactError(
            "A manifest is damaged",
            where=path,
            expected=f"content of sha256 {stated}",
            got=f"content of sha256 {found}",
            next_step=how_to_rebuild(folder),
        )
    return manifest


def is_stored(folder: Path) -> bool:
    """Whether a folder has the name of a store's artifact: its key."""
    return re.fullmatch(rf"[0-9a-f]{{{KEY_LENGTH}}}", folder.name) is not None


def how_to_rebuild(folder: Path) -> str:
    """What to do about a damaged artifact."""
    if is_stored(folder):
        return (
            f"worldline verify {folder} --set-aside, and then the command that made it"
            f" (worldline task {folder.parent.name}, or the whole pipeline)"
        )
    return (
        "bring it back from where it came (git checkout, pip install --force-reinstall, worldline pull), or, where the"
        f" change is meant, delete its {MANIFEST_NAME}"
    )
