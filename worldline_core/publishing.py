"""Push a finished EpisodeSet to a folder, an object store or the Hugging Face hub, and pull it back.

A published set has a list of its files with sizes and digests, which is pulled first and checked before anything else.
A push to the hub is one commit. Elsewhere files that differ are removed first, and the list is written last; until then
a list of another name records what is being sent, so that the same command continues after an interruption.
Credentials come from the environment alone (HF_TOKEN for the hub; HF_ENDPOINT names another hub).
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import batched
from pathlib import Path, PurePosixPath
from typing import Any, Literal, cast

from pydantic import Field, ValidationError
from upath import UPath

from worldline_core.config import StrictModel
from worldline_core.data.curation.source_table import read_source_table
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.source import EVALUATION_LAYOUTS, EVALUATION_ONLY, says_droid
from worldline_core.errors import ArtifactError, ConfigError, DataError, UnavailableError
from worldline_core.store.artifact_files import (
    MANIFEST_NAME,
    VOLATILE_FOLDER,
    digest_file,
    folder_files,
    verify_artifact,
)
from worldline_core.store.remote import AnyPath, file_system, first_line, list_files, parse_location, with_retries
from worldline_core.store.store import folder_lock

FILE_LIST = "worldline_files.json"
"""Written last wherever a set is published: a copy without it is not complete."""
UNFINISHED_LIST = "worldline_files.unfinished.json"
MAX_LIST_BYTES = 256 << 20
_BATCH_FILES = 32
_HUB_LOCATION = re.compile(r"hf://datasets/(?P<id>[\w.-]+/[\w.-]+)(@(?P<revision>[\w./-]+))?/?")
_CLIENTS = ("aiohttp", "botocore", "httpx", "huggingface_hub")
_DEVICES = frozenset({"CON", "PRN", "AUX", "NUL", *(f"{name}{n}" for name in ("COM", "LPT") for n in range(1, 10))})


class PublishedFile(StrictModel):
    """Size and digest of a file; `card` marks those made for the publication, which are not content of the set."""

    size: int = Field(ge=0)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    card: bool = False


class FileList(StrictModel):
    """All files of a published set except the list itself, by path."""

    version: Literal[2] = 2
    files: dict[str, PublishedFile]

    @property
    def num_bytes(self) -> int:
        return sum(file.size for file in self.files.values())


@dataclass(frozen=True)
class Published:
    """A published or pulled set; `moved_files` were sent or fetched by this call, `commit` is the hub's."""

    files: int
    num_bytes: int
    moved_files: int
    commit: str | None = None


def push(
    folder: Path, where: str, *, public: bool = False, allow_restricted: bool = False, title: str | None = None
) -> Published:
    """Push a finished EpisodeSet with its dataset card; files of an earlier push that are gone are removed.

    Args:
        where: `hf://datasets/ORG/NAME[@REVISION]`, a URL that fsspec knows (`s3://bucket/folder`), or a folder.
        public: others can read the location, so licences that do not allow that are refused. Otherwise a new repository
            of the hub is private.
        allow_restricted: push although licences do not allow it.
        title: heading of the dataset card.

    Raises: DataError when the folder is no set, or its licences do not allow it; ArtifactError when the set is damaged or
        not self-contained, the location holds something else or has another visibility, or the store refuses;
        ConfigError for an unknown location; UnavailableError without a token; UnreachableInputError when the store does
        not answer.
    """
    verify_artifact(folder)
    sources = set_files(folder)
    _check_may_publish(folder, public=public, allow_restricted=allow_restricted)
    card = _card_files(folder, sources, title)
    sources |= card
    contents = FileList(
        files={
            name: PublishedFile(size=path.stat().st_size, sha256=digest_file(path), card=name in card)
            for name, path in sorted(sources.items())
        }
    )
    _check_names(contents, folder)
    place = _place(where, writing=True)
    with place.errors("push"):
        place.prepare(public=public)
        present = place.sizes()
        finished = place.file_list(present, FILE_LIST)
        earlier = finished or place.file_list(present, UNFINISHED_LIST) or FileList(files={})
        if foreign := _foreign(present, {*contents.files, *earlier.files}):
            raise ArtifactError(
                "The location holds files that are not of this set",
                where=where,
                expected="an empty location, or an earlier push",
                got=_shortened(foreign),
                next_step="push to a location of its own",
            )
        trusted = earlier.files if place.keeps_sent_files else {}
        kept = {
            name
            for name, file in contents.files.items()
            if trusted.get(name) == file and present.get(name) == file.size
        }
        sending = {name: path for name, path in sources.items() if name not in kept}
        stale = [name for name in {*contents.files, *earlier.files} & present.keys() if name not in kept]
        if sending or stale or finished != contents:
            place.change(sending, stale, contents)
            _check_listing(contents, place.sizes(), where, "run the same command again: what arrived is kept")
    return Published(len(contents.files), contents.num_bytes, len(sending), place.commit)


def pull(where: str, folder: Path) -> Published:
    """Pull a pushed set into a new folder, which appears once every file has been compared with its digest.

    The card goes to the folder's run/card, so that the folder's content is that of the pushed set.

    Raises: ArtifactError when the folder exists, no finished set is published there, names or files do not match the list,
        or the store refuses; ConfigError for an unknown location; UnreachableInputError when the store does not answer.
    """
    if folder.exists():
        raise ArtifactError("Folder exists already", where=folder, next_step="pull into a new folder")
    unfinished, place = folder.with_name(f"{folder.name}.partial"), _place(where, writing=False)
    again = "pull again; if it stays, delete the published copy and push the set again"
    with folder_lock(unfinished), place.errors("pull"):
        if folder.exists():
            raise ArtifactError("Another command has pulled into this folder", where=folder)
        place.pin()
        present = place.sizes()
        contents = place.file_list(present, FILE_LIST)
        if contents is None:
            raise ArtifactError(
                "No finished EpisodeSet is published here",
                where=where,
                expected=FILE_LIST,
                next_step="push it again: an interrupted push continues",
            )
        _check_names(contents, where)
        _check_listing(contents, present, where, again)
        targets = {name: unfinished / name for name in contents.files}
        there = {name for name, file in contents.files.items() if _is_at(file, targets[name])}
        for path in folder_files(unfinished, everything=True):  # of an interrupted pull of an earlier version
            name = path.relative_to(unfinished)
            if name.as_posix() not in there and name.parts[0] not in (VOLATILE_FOLDER, ".cache"):
                path.unlink()
        place.fetch({name: target for name, target in targets.items() if name not in there}, unfinished)
        wrong = [f"{name} differs" for name, file in contents.files.items() if not _is_at(file, targets[name])]
        _raise_mismatch(wrong, where, again)
        for name, file in contents.files.items():
            if file.card:
                target = unfinished / VOLATILE_FOLDER / "card" / name
                target.parent.mkdir(parents=True, exist_ok=True)
                targets[name].rename(target)
        set_files(unfinished)  # a set that refers to folders beside it would read what others put there
        verify_artifact(unfinished)
        unfinished.rename(folder)
        (folder / VOLATILE_FOLDER / ".lock").unlink()
    return Published(len(contents.files), contents.num_bytes, len(contents.files) - len(there), place.commit)


def set_files(folder: Path) -> dict[str, Path]:
    """The files of a finished, self-contained set, by their path in the publication.

    Raises: DataError when the folder is no finished EpisodeSet; ArtifactError when it needs another artifact's datasets.
    """
    linked = sorted({r.dataset for r in EpisodeSet.open(folder).rows if ".." in PurePosixPath(r.dataset).parts})
    if linked:
        raise ArtifactError(
            "The set refers to datasets of another artifact",
            where=folder,
            expected="datasets inside of the folder",
            got=", ".join(linked[:3]),
            next_step=f"make it whole first: worldline export {folder} --format lerobot --output FOLDER",
        )
    files = {path.relative_to(folder).as_posix(): path for path in folder_files(folder)}
    manifest = folder / MANIFEST_NAME
    return files | ({MANIFEST_NAME: manifest} if manifest.is_file() else {})


def _card_files(folder: Path, taken: Iterable[str], title: str | None) -> dict[str, Path]:
    """The dataset card, unless the set has a README.md of its own."""
    from worldline_core.report.dataset_card import write_card

    if "README.md" in taken:
        return {}
    output = folder / VOLATILE_FOLDER / "card"
    return {path.relative_to(output).as_posix(): path for path in write_card(folder, output, title)}


def _check_may_publish(folder: Path, *, public: bool, allow_restricted: bool) -> None:
    """Raises: DataError for sources whose licence forbids redistribution or, in a public place, does not mention it, and
    for recordings meant for evaluation only.
    """
    if allow_restricted:
        return
    sources = read_source_table(folder)
    forbidden = [f"{source.label} ({source.license})" for source in sources if source.redistribution == "no"]
    unknown = [f"{source.label} ({source.license})" for source in sources if source.redistribution == "unknown"]
    evaluation = sorted({row.source for row in EpisodeSet.open(folder).rows if _evaluation_only(row)})
    if not sources:
        unknown = ["all"]
    for what, names in (
        ("Sources forbid redistribution", forbidden),
        ("Sources are for evaluation only", evaluation),
        ("Sources do not state whether redistribution is allowed", unknown if public else []),
    ):
        if names:
            raise DataError(
                what,
                where=folder,
                expected="curate.sources[].redistribution: yes",
                got=", ".join(names),
                next_step="leave these sources out, or, if you have the right, add --allow-restricted",
            )


def _evaluation_only(row: EpisodeRow) -> bool:
    conventions = json.loads(row.conventions)
    marked = conventions.get("layout") in EVALUATION_LAYOUTS or EVALUATION_ONLY in conventions
    return marked or says_droid(row.source, row.embodiment)


def _check_names(contents: FileList, where: object) -> None:
    """Raises: ArtifactError for a name that leads out of the folder or is not one file of its own on every machine."""
    folders = {str(parent).casefold() for name in contents.files for parent in PurePosixPath(name).parents}
    seen = {FILE_LIST, UNFINISHED_LIST, *folders}
    for name in contents.files:
        parts = name.split("/")
        usable = parts[0] not in (VOLATILE_FOLDER, ".cache") and name.casefold() not in seen
        for part in parts:
            usable &= part.isprintable() and not set('\\:*?"<>|') & set(part) and not part.endswith((".", " "))
            usable &= part != "" and not part.startswith("..") and part.split(".")[0].upper() not in _DEVICES
        if not usable:
            raise ArtifactError(
                "A file name of the set is unsafe or taken",
                where=where,
                expected="relative names of printable characters that every file system takes, different in more than case",
                got=repr(name),
            )
        seen.add(name.casefold())


def _foreign(present: Iterable[str], own: Iterable[str]) -> list[str]:
    """Files at a location that are neither the set's nor the hub's own."""
    known = {*own, FILE_LIST, UNFINISHED_LIST, ".gitattributes"}
    return sorted(name for name in present if name not in known and not name.startswith(".cache/"))


def _shortened(items: list[str]) -> str:
    return "; ".join(items[:5]) + (f"; and {len(items) - 5} more" if len(items) > 5 else "")


def _check_listing(contents: FileList, present: Mapping[str, int], where: str, next_step: str) -> None:
    """Raises: ArtifactError where a location's files are not those of the list, or of another size."""
    wrong = [f"{name} is missing" for name in contents.files.keys() - present.keys()]
    wrong += [
        f"{name} has {present[name]} bytes instead of {file.size}"
        for name, file in contents.files.items()
        if present.get(name, file.size) != file.size
    ]
    wrong += [f"{name} is not listed" for name in _foreign(present, contents.files)]
    _raise_mismatch(sorted(wrong), where, next_step)


def _raise_mismatch(wrong: list[str], where: str, next_step: str) -> None:
    if wrong:
        raise ArtifactError(
            "Published files are not those of the set",
            where=where,
            expected=f"the files with the sizes and digests of {FILE_LIST}",
            got=_shortened(wrong),
            next_step=next_step,
        )


def _is_at(file: PublishedFile, path: Path) -> bool:
    return path.is_file() and path.stat().st_size == file.size and digest_file(path) == file.sha256


class _Place:
    """A folder or an object store that sets are published to."""

    commit: str | None = None
    keeps_sent_files = True
    """Whether a push goes on with the files that an interrupted one has sent."""

    def __init__(self, where: str, location: AnyPath) -> None:
        self.where = where
        self.location = location

    @contextmanager
    def errors(self, verb: str) -> Iterator[None]:
        """Turn errors of the store's client into one that names the next step."""
        try:
            yield
        except Exception as error:
            if not isinstance(error, OSError | RuntimeError) and type(error).__module__.split(".")[0] not in _CLIENTS:
                raise
            raise ArtifactError(
                f"The store did not finish the {verb}",
                where=self.where,
                got=first_line(error)[:300],
                next_step="check the name, the room and the rights (of HF_TOKEN); the same command continues where it stopped",
            ) from error

    def prepare(self, *, public: bool) -> None:
        """Make the place where it has to be made before files are sent."""

    def pin(self) -> None:
        """Read one version of the place, where it has several."""

    def sizes(self) -> dict[str, int]:
        """Size of every file by its relative name."""
        file_system(self.location).invalidate_cache()
        return {name: about["size"] for name, about in list_files(self.location).items()}

    def file_list(self, present: Mapping[str, int], name: str) -> FileList | None:
        """The list of files at the place; None where there is none."""
        if name not in present:
            return None
        source = str(self.location / name)
        try:
            if present[name] > MAX_LIST_BYTES:
                raise ValueError(f"{present[name]} bytes")
            content = with_retries(lambda: file_system(self.location).cat_file(source), source)
            return FileList.model_validate_json(content)
        except ValueError as error:
            got = error.errors(include_url=False)[0]["msg"] if isinstance(error, ValidationError) else error
            raise ArtifactError("List of files is damaged or of another version", where=source, got=got) from error

    def fetch(self, targets: Mapping[str, Path], folder: Path) -> None:
        """Copy files to this machine, to their targets below the folder."""
        fs = file_system(self.location)
        for batch in batched(targets.items(), _BATCH_FILES):
            for _, target in batch:
                target.parent.mkdir(parents=True, exist_ok=True)
            sources, copies = [str(self.location / name) for name, _ in batch], [str(target) for _, target in batch]
            with_retries(lambda sources=sources, copies=copies: fs.get(sources, copies), self.where)

    def change(self, add: Mapping[str, Path], remove: Iterable[str], contents: FileList) -> None:
        """Remove files, send others, and write the list of what is there afterwards."""
        fs = file_system(self.location)

        def delete(name: str) -> None:
            with_retries(lambda: fs.rm_file(str(self.location / name)), self.where)

        def write(name: str) -> None:
            content = contents.model_dump_json(indent=1).encode()
            with_retries(lambda: fs.pipe_file(str(self.location / name), content), self.where)

        for name in remove:
            delete(name)
        write(UNFINISHED_LIST)
        if fs.exists(str(self.location / FILE_LIST)):
            delete(FILE_LIST)
        for batch in batched(add.items(), _BATCH_FILES):
            sources, targets = [str(path) for _, path in batch], [str(self.location / name) for name, _ in batch]
            with_retries(lambda sources=sources, targets=targets: fs.put(sources, targets), self.where)
        write(FILE_LIST)
        delete(UNFINISHED_LIST)


class _Hub(_Place):
    """A dataset repository of the hub, made when it does not exist, changed by one commit."""

    keeps_sent_files = False

    def __init__(self, where: str, repo_id: str, revision: str | None, *, writing: bool) -> None:
        from huggingface_hub import HfApi

        token = os.environ.get("HF_TOKEN")
        if writing and not token:
            raise UnavailableError(
                "Pushing to the hub needs a token",
                expected="the environment variable HF_TOKEN",
                next_step="make a token with write access and export HF_TOKEN",
            )
        # False: without a token the client would look for one that some other program stored.
        self._client: dict[str, Any] = {"endpoint": os.environ.get("HF_ENDPOINT"), "token": token or False}
        self._api = HfApi(**self._client)
        self._repo: dict[str, Any] = {"repo_id": repo_id, "repo_type": "dataset"}
        self._revision = revision
        self.where = where

    def prepare(self, *, public: bool) -> None:
        """Raises: ArtifactError when the repository exists with another visibility: private data must not become public."""
        self._api.create_repo(**self._repo, private=not public, exist_ok=True)
        private = bool(self._api.repo_info(**self._repo).private)
        if private == public:
            raise ArtifactError(
                "Repository has another visibility than asked for",
                where=self.where,
                expected="public" if public else "private",
                got="private" if private else "public",
                next_step="push to another repository, or " + ("leave out --public" if public else "add --public"),
            )
        if self._revision is not None:
            self._api.create_branch(self._repo["repo_id"], branch=self._revision, repo_type="dataset", exist_ok=True)
        self.pin()

    def pin(self) -> None:
        self.commit = self._api.repo_info(**self._repo, revision=self._revision).sha
        name = f"hf://datasets/{self._repo['repo_id']}@{self.commit}"
        self.location = cast("AnyPath", UPath(name, **self._client, skip_instance_cache=True))

    def fetch(self, targets: Mapping[str, Path], folder: Path) -> None:
        self._api.snapshot_download(
            **self._repo, revision=self.commit, local_dir=folder, ignore_patterns=[".gitattributes", FILE_LIST]
        )
        shutil.rmtree(folder / ".cache", ignore_errors=True)

    def change(self, add: Mapping[str, Path], remove: Iterable[str], contents: FileList) -> None:
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete

        self._api.create_commit(
            **self._repo,
            revision=self._revision,
            operations=[
                *(CommitOperationDelete(name) for name in remove if name not in add),
                *(CommitOperationAdd(name, path) for name, path in add.items()),  # the client sends what differs
                CommitOperationAdd(FILE_LIST, contents.model_dump_json(indent=1).encode()),
            ],
            commit_message="Upload EpisodeSet",
        )
        self.pin()


def _place(where: str, *, writing: bool) -> _Place:
    if where.startswith("hf://"):
        match = _HUB_LOCATION.fullmatch(where)
        if match is None:
            raise ConfigError("Not a place on the hub", expected="hf://datasets/ORG/NAME[@REVISION]", got=where)
        return _Hub(where, match["id"], match["revision"], writing=writing)
    location = parse_location(where)
    if isinstance(location, Path):
        location = cast("AnyPath", UPath(location.absolute(), protocol="file", auto_mkdir=True))
    return _Place(where, location)
