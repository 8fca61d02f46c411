"""Whether the files of finished artifacts are still those that their steps wrote.

A disk, a copy or a hand that changes a byte changes what the next step computes, mostly without an error. Every manifest
states the size and the digest of each file; a step's inputs are compared with them before the step reads anything.
"""

from __future__ import annotations

import itertools
import logging
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from worldline_core.errors import ArtifactError
from worldline_core.store.artifact_files import (
    MANIFEST_NAME,
    digest_file,
    digest_listed,
    folder_files,
    how_to_rebuild,
    is_artifact,
    is_stored,
    read_json,
    read_manifest,
    read_table,
)
from worldline_core.store.atomic import write_json_atomic
from worldline_core.store.remote import AnyPath, is_remote

logger = logging.getLogger(__name__)

VerifyMode = Literal["full", "fast", "off"]
"""full: the digest of every file, once a process. fast: sizes, and the digests of files that were changed after the
manifest was written. off: nothing."""

_LARGE_BYTES = 1 << 30
_UNREADABLE = "unreadable"
_digests: dict[tuple[Path, int, int], str] = {}
"""Path, size and time of change -> the digest that this process has computed."""


@dataclass(frozen=True)
class Damage:
    """A file of an artifact that is not as it was written; its name is relative to the artifact."""

    file: str
    expected: str
    got: str

    def __str__(self) -> str:
        return f"{self.file}: {self.got} instead of {self.expected}"


@dataclass(frozen=True)
class CheckedArtifact:
    """What comparing a finished artifact with its manifest found; `set_aside` is where it was moved."""

    artifact: Path
    damage: tuple[Damage, ...]
    set_aside: Path | None = None

    def __str__(self) -> str:
        lines = [f"{'damaged' if self.damage else 'whole'}  {self.artifact}", *(f"  {found}" for found in self.damage)]
        if self.set_aside is not None:
            lines.append(f"  set aside: {self.set_aside}")
        elif self.damage:
            lines.append(f"  next step: {how_to_rebuild(self.artifact)}")
        return "\n".join(lines)


def find_damage(folder: Path, mode: VerifyMode = "full") -> list[Damage]:
    """Compare the files of an artifact with its manifest. One without a manifest of ours has nothing to be compared with."""
    if mode == "off" or not is_artifact(folder):
        return []
    try:
        manifest = read_manifest(folder)
    except ArtifactError as error:
        return [Damage(MANIFEST_NAME, "its content when it was written", str(error.got))]
    if "digest" not in manifest:
        return []
    present = {path.relative_to(folder).as_posix(): path for path in folder_files(folder)}
    stated = manifest.get("files")
    if stated is None:
        return _damage_somewhere(folder, present, manifest["digest"], mode)
    damage = [Damage(name, "a file", "nothing") for name in sorted(stated.keys() - present.keys())]
    damage += [Damage(name, "nothing", "a file") for name in sorted(present.keys() - stated.keys())]
    right_size: dict[str, Path] = {}
    for name in sorted(stated.keys() & present.keys()):
        if (size := present[name].stat().st_size) != stated[name]["size"]:
            damage.append(Damage(name, f"{stated[name]['size']} bytes", f"{size} bytes"))
        else:
            right_size[name] = present[name]
    for name, found in _digests_of(_to_read(folder, right_size, mode)).items():
        if found != stated[name]["sha256"]:
            got = found if found.startswith(_UNREADABLE) else f"sha256 {found[:16]}"
            damage.append(Damage(name, f"sha256 {stated[name]['sha256'][:16]}", got))
    return damage


def _damage_somewhere(folder: Path, present: Mapping[str, Path], digest: str, mode: VerifyMode) -> list[Damage]:
    """For manifests of earlier versions, which state the digest of the whole alone."""
    if not _to_read(folder, present, mode):
        return []
    found = digest_listed({name: {"sha256": sha256} for name, sha256 in _digests_of(present).items()})
    return [] if found == digest else [Damage("one of its files", f"digest {digest[:16]}", f"digest {found[:16]}")]


def _to_read(folder: Path, files: Mapping[str, Path], mode: VerifyMode) -> dict[str, Path]:
    written = (folder / MANIFEST_NAME).stat().st_mtime_ns
    return {name: path for name, path in files.items() if mode == "full" or path.stat().st_mtime_ns > written}


def _digests_of(files: Mapping[str, Path]) -> dict[str, str]:
    """Digests by name; of a file that cannot be read, the reason."""
    keys = {name: (path, (s := path.stat()).st_size, s.st_mtime_ns) for name, path in files.items()}
    new = [key for key in keys.values() if key not in _digests]
    if (total := sum(size for _, size, _ in new)) > _LARGE_BYTES:
        logger.info("comparing %d files (%.1f GB) with their digests", len(new), total / 1e9)
    with ThreadPoolExecutor() as pool:  # hashing leaves Python's lock
        _digests.update(zip(new, pool.map(_digest, [path for path, _, _ in new]), strict=True))
    return {name: _digests[key] for name, key in keys.items()}


def _digest(path: Path) -> str:
    try:
        return digest_file(path)
    except OSError as error:
        return f"{_UNREADABLE}: {error}"


def shared_datasets(folder: Path) -> list[Path]:
    """The datasets of other artifacts that an EpisodeSet shares: a filtered set has no videos of its own."""
    index = read_table(folder / "index.parquet")
    if index is None or "dataset" not in index.column_names:
        return []
    shared = [name for name in index.column("dataset").unique().to_pylist() if ".." in PurePosixPath(name).parts]
    return [Path(os.path.normpath(folder / name)) for name in shared]


def linked_artifacts(folder: Path) -> list[Path]:
    """The artifacts whose datasets an EpisodeSet shares."""
    places = shared_datasets(folder)
    owners = [next((above for above in place.parents if (above / MANIFEST_NAME).is_file()), None) for place in places]
    return list(dict.fromkeys(owner for owner in owners if owner is not None))


def verify_inputs(inputs: Mapping[str, AnyPath], mode: VerifyMode) -> None:
    """Compare the inputs of a step, and the artifacts whose datasets they share, with their manifests.

    Raises:
        ArtifactError: files are not those that were written.
    """
    for name, folder in inputs.items():
        if is_remote(folder):
            continue
        if mode != "off":
            _verify_input(name, folder, mode)
        if missing := [place for place in shared_datasets(folder) if not place.is_dir()]:
            raise ArtifactError(
                f"Input {name} shares recordings that are not there", where=folder,
                expected=", ".join(map(str, missing[:3])), got="no such folder", next_step=how_to_rebuild(missing[0].parents[1]),
            )  # fmt: skip
        for artifact in linked_artifacts(folder) if mode != "off" else ():
            _verify_input(name, artifact, mode)


def _verify_input(name: str, folder: Path, mode: VerifyMode) -> None:
    if damage := find_damage(folder, mode):
        more = f"; and {len(damage) - 5} more" if len(damage) > 5 else ""
        raise ArtifactError(
            f"Input {name} is damaged: files are not those that were written",
            where=folder,
            expected=f"the files of its {MANIFEST_NAME}",
            got="; ".join(map(str, damage[:5])) + more,
            next_step=how_to_rebuild(folder),
        )


def weights_digests(places: Mapping[str, Path | None], remembered: Path) -> dict[str, str]:
    """Digest of each file, or of a folder's files, that is there. What has the same size and time of change is not read
    again: weights have gigabytes. Folders of the Hugging Face hub's cache consist of links; hidden files are its notes.

    Args:
        remembered: JSON file that keeps what was read.
    """
    known, digests = dict[str, Any](), dict[str, str]()
    for name, place in places.items():
        if place is None or not place.exists():
            continue
        known = known or read_json(remembered)
        files: dict[str, dict[str, str]] = {}
        for path in sorted(path for path in [place, *place.rglob("*")] if path.is_file()):
            relative, facts = path.relative_to(place), path.stat()
            if any(part.startswith(".") for part in relative.parts):
                continue
            key = f"{path.resolve()} {facts.st_size} {facts.st_mtime_ns}"
            if key not in known:
                known[key] = digest_file(path)
                write_json_atomic(remembered, known)
            files[relative.as_posix()] = {"sha256": known[key]}
        digests[name] = digest_listed(files)
    return digests


def check_artifacts(folders: Sequence[Path], *, set_damaged_aside: bool = False) -> list[CheckedArtifact]:
    """Read every file of finished artifacts, and of those whose datasets they share, and compare it with its manifest.

    Raises:
        ArtifactError: a folder has no manifest; a damaged one cannot be set aside.
    """
    for folder in folders:
        if not (folder / MANIFEST_NAME).is_file():
            raise ArtifactError("Not a finished artifact", where=folder, expected=MANIFEST_NAME, got="no such file")
    waiting, checked = list(folders), dict[Path, CheckedArtifact]()
    while waiting:
        folder = waiting.pop(0)
        if folder in checked:
            continue
        damage = tuple(find_damage(folder))
        if not damage:
            waiting += linked_artifacts(folder)
        checked[folder] = CheckedArtifact(folder, damage, set_aside(folder) if damage and set_damaged_aside else None)
    return list(checked.values())


def finished_artifacts(root: Path) -> list[Path]:
    """The finished artifacts of the store below a folder."""
    return sorted(path.parent for path in root.glob(f"*/*/{MANIFEST_NAME}") if is_stored(path.parent))


def set_aside(folder: Path) -> Path:
    """Move an artifact to `damaged/<step>/` in its store, so that the next run builds it again; returns where it is.

    Raises:
        ArtifactError: it is not the artifact of a store.
    """
    folder = folder.resolve()
    if not is_stored(folder):
        raise ArtifactError(
            "Only an artifact of a store can be set aside", where=folder, next_step=how_to_rebuild(folder)
        )
    place = folder.parents[1] / "damaged" / folder.parent.name
    place.mkdir(parents=True, exist_ok=True)
    target = next(path for path in (place / f"{folder.name}.{n}" for n in itertools.count(1)) if not path.exists())
    return folder.rename(target)
