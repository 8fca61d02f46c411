"""Files of artifacts: reading them, and comparing them with the sizes and digests in their manifest.

A disk, a copy or a person that changes a byte changes what the next step computes, mostly without an error. Every
manifest therefore lists the size and digest of each file, and a step's inputs are compared with it before they are read.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Literal, get_args, get_type_hints

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from worldline_core.config import StrictModel
from worldline_core.errors import ArtifactError
from worldline_core.store.atomic import write_json_atomic

if TYPE_CHECKING:
    import pyarrow as pa

logger = logging.getLogger(__name__)

JsonObject = dict[str, Any]
MANIFEST_NAME = "manifest.json"
KEY_LENGTH = 16
VOLATILE_FOLDER = "run"
"""Not part of an artifact's content: timings, logs, resume state, recordings with wall-clock stamps."""
VerifyMode = Literal["full", "fast", "off"]
"""full: the digest of every file, once a process. fast: sizes, and the digests of files changed after the manifest was
written. off: nothing."""

_LARGE_BYTES = 1 << 30
_digests: dict[tuple[Path, int, int], str] = {}
"""Digests computed by this process, by path, size and modification time."""


def read_json(path: Path) -> JsonObject:
    """A JSON object from a file; an absent file is an empty object.

    Raises:
        ArtifactError: the file cannot be read or is not a JSON object.
    """
    if not path.is_file():
        return {}
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ArtifactError(
            "A JSON file is damaged", where=path, got=str(error), next_step="rebuild the artifact"
        ) from error
    if not isinstance(value, dict):
        raise ArtifactError("A JSON file has a wrong form", where=path, expected="an object", got=type(value).__name__)
    return value


def read_json_lines(path: Path) -> list[JsonObject]:
    """The objects of a `.jsonl` file; an absent file has none, and a last line cut short by a kill is left out.

    Raises:
        ArtifactError: another line is not a JSON object.
    """
    if not path.is_file():
        return []
    rows: list[JsonObject] = []
    lines = [line for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    for index, line in enumerate(lines):
        try:
            value = json.loads(line)
        except (ValueError, RecursionError) as error:
            if index == len(lines) - 1:
                break
            raise ArtifactError("A line is not JSON", where=f"{path}:{index + 1}", got=line[:80]) from error
        if not isinstance(value, dict):
            raise ArtifactError("A line is not an object", where=f"{path}:{index + 1}", got=line[:80])
        rows.append(value)
    return rows


def read_table(path: Path) -> pa.Table | None:
    """A Parquet table; None for an absent file.

    Raises:
        ArtifactError: the file cannot be read.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not path.is_file():
        return None
    try:
        with pq.ParquetFile(path) as file:  # a third of what `pq.read_table` takes for a small table
            return file.read(use_threads=False)
    except (pa.ArrowInvalid, OSError) as error:
        raise ArtifactError(
            "A Parquet file is damaged", where=path, got=str(error), next_step="rebuild the artifact"
        ) from error


def read_rows(path: Path) -> list[JsonObject]:
    """The rows of a Parquet table as objects; an absent file has none."""
    table = read_table(path)
    return [] if table is None else table.to_pylist()


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
    """The kind of an artifact, recognized by its files.

    Raises:
        ArtifactError: the folder is missing or of no known kind.
    """
    if not folder.is_dir():
        raise ArtifactError("No such artifact folder", where=folder, next_step="give the folder of a finished artifact")
    for name, kind in (("scores.parquet", "Scores"), ("checkpoint.json", "Checkpoint"), ("index.html", "Report")):
        if (folder / name).is_file():
            return kind
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
    """The folder of an input named in an artifact's manifest, or None when it is gone.

    Manifests name inputs relative to the root of the artifacts, two folders up.
    """
    inputs = read_json(folder / MANIFEST_NAME).get("inputs")
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


class ListedFile(StrictModel):
    """Size [bytes] and digest of a file, as manifests and publications list it."""

    size: int = Field(ge=0)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


def describe_file(path: Path) -> ListedFile:
    """Size and digest of the file at a path."""
    return ListedFile(size=path.stat().st_size, sha256=digest_file(path))


def leads_out(path: Path, root: Path) -> bool:
    """True if a path ends outside of a folder. Snapshots of the Hub's cache may use the blobs of their own repository."""
    target, root = path.resolve(), root.resolve()
    blobs = [each.parent / "blobs" for each in root.parents if each.name == "snapshots"]
    return not any(target.is_relative_to(folder) for folder in (root, *blobs[:1]))


def folder_files(folder: Path, *, everything: bool = False) -> dict[str, Path]:
    """The files of a folder's content by relative name, sorted: all but the manifest and the volatile folder, or ``everything``.

    Raises:
        ArtifactError: a symbolic link leads out of the folder.
    """
    root, depth = folder.resolve(), len(folder.parts)
    files = []
    for place, folders, names in os.walk(folder, onerror=_refuse):
        if place == str(folder) and not everything:
            folders[:] = [name for name in folders if name != VOLATILE_FOLDER]
            names = [name for name in names if name not in (VOLATILE_FOLDER, MANIFEST_NAME)]
        files += [Path(place, name) for name in names]
    for path in files:
        if path.is_symlink() and leads_out(path, root):
            raise ArtifactError("A symbolic link leads out of the folder", where=path, got=path.resolve())
    # relative_to takes longer than everything else here
    return {"/".join(path.parts[depth:]): path for path in sorted(files, key=lambda path: path.parts[depth:])}


def _refuse(error: OSError) -> None:
    raise error  # os.walk would leave out a folder that cannot be listed


def content_files(folder: Path, *, everything: bool = False) -> dict[str, JsonObject]:
    """`size` [bytes] and `sha256` of every file of a folder's content by relative name, as a manifest lists them."""
    files = folder_files(folder, everything=everything)
    return {name: describe_file(path).model_dump() for name, path in files.items()}


def digest_listed(files: Mapping[str, JsonObject]) -> str:
    """SHA-256 over the names and digests of listed files: the digest of the artifact they make up."""
    return digest_value([[name, files[name]["sha256"]] for name in sorted(files, key=lambda name: name.split("/"))])


def digest_folder(folder: Path, *, everything: bool = False) -> str:
    """SHA-256 over the relative names and bytes of a folder's content.

    Args:
        everything: include the manifest and the volatile folder, which belong to the owner of a folder that is no artifact.
    """
    return digest_listed(content_files(folder, everything=everything))


def is_stored(folder: Path) -> bool:
    """Returns whether a folder has the name of a store's artifact: its key."""
    return re.fullmatch(rf"[0-9a-f]{{{KEY_LENGTH}}}", folder.name) is not None


def is_artifact(folder: Path) -> bool:
    """Returns whether a folder has the manifest of a finished artifact, damaged or not, rather than an unrelated manifest.json."""
    path = folder / MANIFEST_NAME
    if not path.is_file():
        return False
    return is_stored(folder) or all(key in path.read_bytes() for key in (b'"digest"', b'"step"'))


def write_manifest(folder: Path, facts: Mapping[str, Any]) -> str:
    """Finish an artifact: write its manifest with the facts of the step, and return the digest of its content.

    `files` lists every file; `digest` covers the whole content, `manifest_sha256` everything else in the manifest.
    """
    files = content_files(folder)
    content = json.loads(json.dumps({**facts, "digest": digest_listed(files), "files": files}, allow_nan=False))
    write_json_atomic(folder / MANIFEST_NAME, {**content, "manifest_sha256": digest_value(content)})
    return content["digest"]


class _Manifest(BaseModel):
    """Fields of a manifest that readers rely on."""

    model_config = ConfigDict(strict=True)
    digest: str
    files: dict[str, ListedFile]
    step: str = ""
    metrics: dict[str, Any] = {}
    config: dict[str, Any] = {}
    inputs: dict[str, dict[str, Any]] = {}
    environment: dict[str, Any] = {}


def read_manifest(folder: Path) -> JsonObject:
    """The manifest of a finished artifact; an empty object where there is none.

    Raises:
        ArtifactError: it is damaged, or of another form.
    """
    path = folder / MANIFEST_NAME
    if not path.is_file():
        return {}
    try:
        manifest = read_json(path)
    except ArtifactError as error:
        raise ArtifactError(error.what, where=path, got=error.got, next_step=how_to_rebuild(folder)) from error
    stated = manifest.pop("manifest_sha256", None)
    if stated != (found := digest_value(manifest)):
        raise ArtifactError(
            "A manifest is damaged", where=path, expected=f"content of sha256 {stated}", got=f"content of sha256 {found}",
            next_step=how_to_rebuild(folder),
        )  # fmt: skip
    try:
        _Manifest.model_validate(manifest)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        raise ArtifactError(
            "A manifest is of another form, as an earlier version wrote it", where=path,
            expected=f"{'.'.join(map(str, first['loc']))}: {first['msg']}", next_step=how_to_rebuild(folder),
        ) from error  # fmt: skip
    return manifest


def how_to_rebuild(folder: Path) -> str:
    """The next step for the owner of a damaged artifact."""
    if is_stored(folder):
        return (
            f"delete {folder}, then run the command that made it"
            f" (worldline task {folder.parent.name}, or the whole pipeline)"
        )
    return (
        "bring it back from where it came (git checkout, pip install --force-reinstall, worldline pull), or, where the"
        f" change is meant, delete its {MANIFEST_NAME}"
    )


def find_damage(folder: Path, mode: VerifyMode = "full") -> list[str]:
    """The differences between an artifact's files and its manifest; a folder without a manifest of ours has none."""
    if mode == "off" or not is_artifact(folder):
        return []
    try:
        stated = read_manifest(folder)["files"]
    except ArtifactError as error:
        return [f"{MANIFEST_NAME}: {error.got or error.expected}"]
    present = folder_files(folder)
    damage = [f"{name}: missing" for name in sorted(stated.keys() - present.keys())]
    damage += [f"{name}: not listed" for name in sorted(present.keys() - stated.keys())]
    written = (folder / MANIFEST_NAME).stat().st_mtime_ns
    reading: dict[str, tuple[Path, int, int]] = {}
    for name in sorted(stated.keys() & present.keys()):
        facts = present[name].stat()
        if facts.st_size != stated[name]["size"]:
            damage.append(f"{name}: {facts.st_size} bytes instead of {stated[name]['size']}")
        elif mode == "full" or facts.st_mtime_ns > written:
            reading[name] = (present[name], facts.st_size, facts.st_mtime_ns)
    new = [key for key in reading.values() if key not in _digests]
    if (total := sum(size for _, size, _ in new)) > _LARGE_BYTES:
        logger.info("comparing %d files (%.1f GB) with their digests", len(new), total / 1e9)
    with ThreadPoolExecutor() as pool:  # hashing releases the GIL
        _digests.update(zip(new, pool.map(_digest_or_error, [path for path, _, _ in new]), strict=True))
    for name, key in reading.items():
        if _digests[key] != stated[name]["sha256"]:
            damage.append(f"{name}: sha256 {_digests[key][:16]} instead of {stated[name]['sha256'][:16]}")
    return damage


def _digest_or_error(path: Path) -> str:
    try:
        return digest_file(path)
    except OSError as error:
        return f"({error.strerror})"


def shortened(items: list[str]) -> str:
    """The first five of some texts for a message, and how many more there are."""
    return "; ".join(items[:5]) + (f"; and {len(items) - 5} more" if len(items) > 5 else "")


def check_artifacts(folders: Iterable[Path], mode: VerifyMode = "full") -> dict[Path, list[str]]:
    """The damage of artifacts, and of those whose datasets they share, by folder.

    A filtered EpisodeSet has no videos of its own: a shared dataset that is missing is damage too.
    """
    waiting, checked = list(folders), dict[Path, list[str]]()
    while waiting:
        folder = waiting.pop(0)
        if folder in checked:
            continue
        checked[folder] = find_damage(folder, mode)
        index = None if checked[folder] else read_table(folder / "index.parquet")
        for name in (
            [] if index is None or "dataset" not in index.column_names else index["dataset"].unique().to_pylist()
        ):
            if ".." in PurePosixPath(name).parts:
                shared = Path(os.path.normpath(folder / name))
                if shared.is_dir():
                    waiting += [above for above in shared.parents if (above / MANIFEST_NAME).is_file()][:1]
                else:
                    checked[shared.parents[1]] = [f"datasets/{shared.name}: missing, with recordings of {folder}"]
    return checked


def verify_artifact(folder: Path, mode: VerifyMode = "full", what: str = "Artifact") -> None:
    """Compare an artifact, and those whose datasets it shares, with their manifests.

    Raises:
        ArtifactError: files differ from what was written, or shared datasets are missing.
    """
    for artifact, damage in check_artifacts([folder], mode).items():
        if damage:
            raise ArtifactError(
                f"{what} is damaged: files differ from what was written", where=artifact,
                expected=f"the files of its {MANIFEST_NAME}", got=shortened(damage), next_step=how_to_rebuild(artifact),
            )  # fmt: skip


def finished_artifacts(root: Path) -> list[Path]:
    """The finished artifacts of the store below a folder."""
    return sorted(path.parent for path in root.glob(f"*/*/{MANIFEST_NAME}") if is_stored(path.parent))
