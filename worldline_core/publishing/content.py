"""What of a finished EpisodeSet is published, with the digest of every file, and whether it may be."""

from __future__ import annotations

import json
import posixpath
import re
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from worldline_core.data.curation.source_table import read_source_table
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.source import EVALUATION_LAYOUTS, EVALUATION_ONLY, says_droid
from worldline_core.data.guards.source_paths import inside
from worldline_core.errors import ArtifactError, DataError
from worldline_core.store.artifact_files import (
    MANIFEST_NAME,
    VOLATILE_FOLDER,
    digest_file,
    digest_folder,
    folder_files,
    read_json,
)
from worldline_core.store.atomic import atomic_path

FILE_LIST = "worldline_files.json"
"""Written last wherever a set is published: a copy without it is not complete."""
FILE_LIST_VERSION = 1
Place = Literal["content", "card"]
_PORTABLE = re.compile(r'[^\x00-\x1f\x7f\\:*?"<>|]+')
_DEVICES = frozenset({"CON", "PRN", "AUX", "NUL", *(f"{name}{n}" for name in ("COM", "LPT") for n in range(1, 10))})


@dataclass(frozen=True)
class PublishedFile:
    """One file of a published set.

    Attributes:
        path: where it lies in the published copy.
        place: content belongs to the set, card to the dataset card that is made for the publication.
    """

    path: str
    size: int
    sha256: str
    place: Place = "content"

    def is_at(self, path: Path) -> bool:
        """Whether a file of this machine has this content."""
        return path.is_file() and path.stat().st_size == self.size and digest_file(path) == self.sha256

    def below(self, folder: Path) -> Path:
        """Where a copy keeps it: a card goes to run/card, so that the folder's content is that of the set.

        Raises: RejectedInputError (path_traversal) for a path that leads out of the copy.
        """
        return inside(folder / VOLATILE_FOLDER / "card" if self.place == "card" else folder, self.path)


@dataclass(frozen=True)
class FileList:
    """All files of a published set except the list itself, by path."""

    files: Mapping[str, PublishedFile]

    @property
    def num_bytes(self) -> int:
        return sum(file.size for file in self.files.values())

    def foreign(self, names: Iterable[str]) -> list[str]:
        """Which of these names are not of the set; what a hub or its client adds does not count."""
        own = {*self.files, FILE_LIST, ".gitattributes"}
        return sorted(name for name in names if name not in own and not name.startswith(".cache/"))

    def write(self, path: Path) -> None:
        """As JSON, whole or not at all; equal lists give equal bytes."""
        rows = [asdict(file) for _, file in sorted(self.files.items())]
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps({"version": FILE_LIST_VERSION, "files": rows}, indent=1) + "\n")

    @classmethod
    def read(cls, path: Path, where: object) -> FileList:
        """The list of a copy.

        Raises: ArtifactError when it is not understood.
        """
        try:
            content = json.loads(path.read_text())
            if content["version"] != FILE_LIST_VERSION:
                raise ValueError(f"version {content['version']}")
            files = [_published_file(row) for row in content["files"]]
            _check_names([file.path for file in files])
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise ArtifactError(
                "List of files is damaged or of another version", where=where, got=str(error)
            ) from error
        return cls({file.path: file for file in files})


def _published_file(row: Mapping[str, Any]) -> PublishedFile:
    place = row["place"]
    if place not in ("content", "card") or not isinstance(row["path"], str) or int(row["size"]) < 0:
        raise ValueError(f"entry {dict(row)}")
    return PublishedFile(row["path"], int(row["size"]), str(row["sha256"]), place)


def _check_names(paths: Sequence[str]) -> None:
    """Raises: ValueError for names that are not one file each on every machine. (What leads out is `inside`'s matter.)"""
    folders = {parent.as_posix() for path in paths for parent in PurePosixPath(path).parents}
    seen: set[str] = set()
    for path in paths:
        if posixpath.normpath(path).startswith(".."):
            continue
        parts = path.split("/")
        if not _PORTABLE.fullmatch(path) or any(p.endswith((".", " ")) for p in parts) or "" in parts[1:]:
            raise ValueError(f"the name {path!r}")
        if any(part.split(".")[0].upper() in _DEVICES for part in parts):
            raise ValueError(f"the name {path!r}, a device on some machines")
        if path in folders or parts[0] == VOLATILE_FOLDER or path.casefold() in seen:
            raise ValueError(f"the name {path!r}, which is taken")
        seen.add(path.casefold())


def set_files(folder: Path) -> dict[str, Path]:
    """Path in the publication -> file, of everything that makes up a finished, self-contained set.

    Raises: DataError when the folder is no finished EpisodeSet; ArtifactError when it needs another artifact's datasets.
    """
    rows = EpisodeSet.open(folder).rows
    linked = sorted({row.dataset for row in rows if ".." in PurePosixPath(row.dataset).parts})
    if linked:
        raise ArtifactError(
            "The set refers to datasets of another artifact",
            where=folder,
            expected="datasets inside of the folder",
            got=", ".join(linked[:3]),
            next_step=f"make it whole first: worldline export {folder} --format lerobot --output FOLDER",
        )
    files = {path.relative_to(folder).as_posix(): path for path in folder_files(folder)}
    if FILE_LIST in files:
        raise DataError("A file of the set has the name of the list of files", where=folder, got=FILE_LIST)
    manifest = folder / MANIFEST_NAME
    return files | ({MANIFEST_NAME: manifest} if manifest.is_file() else {})


def listed(files: Mapping[str, Path], card: Mapping[str, Path]) -> FileList:
    """Sizes and digests of what is published."""
    return FileList(
        {
            name: PublishedFile(name, path.stat().st_size, digest_file(path), "card" if name in card else "content")
            for name, path in {**files, **card}.items()
        }
    )


def card_files(folder: Path, taken: Iterable[str], title: str | None) -> dict[str, Path]:
    """The dataset card, made now: path in the publication -> file. Nothing where the set has a README.md of its own."""
    from worldline_core.report.dataset_card import write_card

    if "README.md" in taken:
        return {}
    output = folder / VOLATILE_FOLDER / "card"
    written = write_card(folder, output, title)
    return {path.relative_to(output).as_posix(): path for path in written}


def check_may_publish(folder: Path, *, public: bool, allow_restricted: bool) -> None:
    """Raises: DataError when licences do not allow it: a source says that it may not be handed on, holds recordings for
    evaluation only, or, for a public place, does not say.
    """
    if allow_restricted:
        return
    sources = read_source_table(folder)
    forbidden = [f"{source.label} ({source.license})" for source in sources if source.redistribution == "no"]
    unknown = [f"{source.label} ({source.license})" for source in sources if source.redistribution == "unknown"]
    evaluation = sorted({row.source for row in EpisodeSet.open(folder).rows if _evaluation_only(row)})
    for what, names in (
        ("Sources may not be handed on", forbidden),
        ("Sources are for evaluation only", evaluation),
        (
            "Sources do not say whether they may be handed on",
            (unknown or ([] if sources else ["all"])) if public else [],
        ),
    ):
        if names:
            raise DataError(
                what,
                where=folder,
                expected="curate.sources[].redistribution: yes",
                got=", ".join(names),
                next_step="leave these sources out, or, if you have the right, say --allow-restricted",
            )


def _evaluation_only(row: EpisodeRow) -> bool:
    conventions = json.loads(row.conventions)
    noted = conventions.get("layout") in EVALUATION_LAYOUTS or EVALUATION_ONLY in conventions
    return noted or says_droid(row.source, row.embodiment)


def check_space(contents: FileList, targets: Mapping[str, Path], folder: Path) -> None:
    """Raises: ArtifactError before anything is fetched that does not fit on the disk."""
    there = sum(path.stat().st_size for path in targets.values() if path.is_file())
    free = shutil.disk_usage(folder).free
    if contents.num_bytes - there > free:
        raise ArtifactError(
            "The set does not fit on the disk", where=folder, expected=f"{contents.num_bytes - there:,} bytes",
            got=f"{free:,} bytes free", next_step="free some space, or pull into another folder",
        )  # fmt: skip


def check_manifest(folder: Path, where: str) -> None:
    """Raises: ArtifactError when the content is not that whose digest the step wrote down."""
    manifest = folder / MANIFEST_NAME
    stated = read_json(manifest).get("digest")
    if stated is not None and stated != (found := digest_folder(folder)):
        raise ArtifactError(
            "Content is not that of the manifest", where=where, expected=f"digest {stated}", got=f"digest {found}"
        )
