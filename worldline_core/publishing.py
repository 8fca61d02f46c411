"""Push a finished EpisodeSet to a folder, an object store or the Hugging Face hub, and pull it back.

A published set has a list of its files with sizes and digests, by which every pulled file is checked. A push to the hub is
one commit; elsewhere the list is written last. Credentials come from the environment alone.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, Literal, cast

import httpx
from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi
from pydantic import Field, ValidationError
from upath import UPath

from worldline_core.config import StrictModel
from worldline_core.data.curation.source_table import read_source_table
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.source import for_evaluation_only
from worldline_core.errors import ArtifactError, ConfigError, DataError, UnavailableError
from worldline_core.http_exchange import hub_access
from worldline_core.report.data import write_card
from worldline_core.store.artifact_files import (
    MANIFEST_NAME,
    VOLATILE_FOLDER,
    content_files,
    digest_file,
    verify_artifact,
)
from worldline_core.store.remote import AnyPath, first_line, list_files, parse_location
from worldline_core.store.store import folder_lock
from worldline_core.untrusted_text import cut

FILE_LIST = "worldline_files.json"
MAX_LIST_BYTES = 64 << 20
_FILES_AT_ONCE = 8
_PIECE_BYTES = 8 << 20
_HUB_LOCATION = re.compile(r"hf://datasets/(?P<id>[\w.-]+/[\w.-]+)(@(?P<revision>[\w./-]+))?/?")


class PublishedFile(StrictModel):
    """Size and digest of a file."""

    size: int = Field(ge=0)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class FileList(StrictModel):
    """The files of a set by path; neither the list itself nor the dataset card is among them."""

    version: Literal[3] = 3
    files: dict[str, PublishedFile]

    @classmethod
    def of(cls, folder: Path) -> FileList:
        """The files that are in a folder, in the order of their names."""
        manifest = {p.name: {"size": p.stat().st_size, "sha256": digest_file(p)} for p in folder.glob(MANIFEST_NAME)}
        return cls.model_validate({"files": dict(sorted((content_files(folder) | manifest).items()))})


def push(folder: Path, where: str, *, public: bool = False, allow_restricted: bool = False) -> FileList:
    """Push a finished EpisodeSet with its dataset card; files of an earlier push that are gone are removed.

    Args:
        where: `hf://datasets/ORG/NAME[@REVISION]`, a URL that fsspec knows (`s3://bucket/folder`), or a folder.
        public: others can read the location, so licences that do not allow that are refused. Otherwise a new repository
            of the hub is private.
        allow_restricted: push although licences do not allow it.

    Raises: DataError when the folder is no set, or its licences do not allow it; ArtifactError when the set is damaged or
        not self-contained, the location holds something else or has another visibility, or the store refuses;
        ConfigError for an unknown location; UnavailableError without a token; UnreachableInputError when the store does not
        answer.
    """
    verify_artifact(folder)
    require_whole_set(folder)
    if not allow_restricted:
        _check_may_publish(folder, public=public)
    contents = FileList.of(folder)
    _check_names(contents.files, folder)
    sending = {name: folder / name for name in contents.files}
    if "README.md" not in sending:
        sending["README.md"] = write_card(folder, folder / VOLATILE_FOLDER / "card")
    listed = contents.model_dump_json(indent=1).encode()
    with _client_errors(where, "push"):
        hub = _Repository(where) if where.startswith("hf://") else None
        if hub is not None:
            hub.prepare(public=public)
        location = _location(where)
        present, earlier = _published(location)
        foreign = present.keys() - sending.keys() - {".gitattributes"}
        if foreign and not earlier.files:
            raise ArtifactError(
                "The location holds files that are not of this set",
                where=where,
                expected="an empty location, or an earlier push",
                got=cut("; ".join(sorted(foreign)), 300),
                next_step="push to a location of its own",
            )
        gone = sorted((earlier.files.keys() - sending.keys()) & present.keys())
        if hub is not None:
            hub.commit(sending, gone, listed)
        else:  # the list at last
            location.fs.put([str(path) for path in sending.values()], [str(location / name) for name in sending])
            for name in gone:
                location.fs.rm_file(str(location / name))
            location.fs.pipe_file(str(location / FILE_LIST), listed)
    return contents


def pull(where: str, folder: Path) -> FileList:
    """Pull a pushed set into a new folder, which appears once every file has been compared with its digest.

    Raises: ArtifactError when the folder exists, no finished set is published there, names or files do not match the list,
        or the store refuses; ConfigError for an unknown location; UnreachableInputError when the store does not answer.
    """
    if folder.exists():
        raise ArtifactError("Folder exists already", where=folder, next_step="pull into a new folder")
    unfinished = folder.with_name(f"{folder.name}.partial")
    with folder_lock(unfinished):
        if folder.exists():
            raise ArtifactError("Another command has pulled into this folder", where=folder)
        with _client_errors(where, "pull"):
            location = _location(where)
            present, contents = _published(location)
            if not contents.files:
                raise ArtifactError("No finished EpisodeSet is published here", where=where, expected=FILE_LIST)
            _check_names(contents.files, where)
            wrong = {name for name, file in contents.files.items() if present.get(name) != file.size}
            if not wrong:
                here = FileList.of(unfinished).files  # of an earlier, interrupted pull
                for name in here.keys() - contents.files.keys():
                    (unfinished / name).unlink()
                missing = dict(contents.files.items() - here.items())
                with ThreadPoolExecutor(_FILES_AT_ONCE) as pool:
                    list(pool.map(partial(_fetch, location, unfinished), missing, missing.values()))
                wrong = {name for name, _ in contents.files.items() ^ FileList.of(unfinished).files.items()}
            if wrong:
                raise ArtifactError(
                    "Published files are not those of the set",
                    where=where,
                    expected=f"the files with the sizes and digests of {FILE_LIST}",
                    got=cut("; ".join(sorted(wrong)), 300),
                    next_step="pull again; if it stays, delete the published copy and push the set again",
                )
        require_whole_set(unfinished)  # a set that refers to folders beside it would read what others put there
        verify_artifact(unfinished)
        unfinished.rename(folder)
        (folder / VOLATILE_FOLDER / ".lock").unlink()
    return contents


def require_whole_set(folder: Path) -> None:
    """Raises: DataError when the folder is no finished EpisodeSet; ArtifactError when it needs another artifact's datasets."""
    linked = {row.dataset for row in EpisodeSet.open(folder).rows if ".." in PurePosixPath(row.dataset).parts}
    if linked:
        raise ArtifactError(
            "The set refers to datasets of another artifact",
            where=folder,
            expected="datasets inside of the folder",
            got=cut("; ".join(sorted(linked)), 300),
            next_step=f"make it whole first: worldline export {folder} --format lerobot --output FOLDER",
        )


def _check_may_publish(folder: Path, *, public: bool) -> None:
    """Raises: DataError for sources whose licence forbids redistribution or, in a public place, does not mention it, and
    for recordings meant for evaluation only.
    """
    sources, rows = read_source_table(folder), EpisodeSet.open(folder).rows
    forbidden, unknown = (
        [f"{source.label} ({source.license})" for source in sources if source.redistribution == kind]
        for kind in ("no", "unknown")
    )
    evaluation = {r.source for r in rows if for_evaluation_only(json.loads(r.conventions), r.source, r.embodiment)}
    for what, names in (
        ("Sources forbid redistribution", forbidden),
        ("Sources are for evaluation only", sorted(evaluation)),
        ("Sources do not state whether redistribution is allowed", (unknown if sources else ["all"]) if public else []),
    ):
        if names:
            raise DataError(
                what,
                where=folder,
                expected="curate.sources[].redistribution: yes",
                got=", ".join(names),
                next_step="leave these sources out, or, if you have the right, add --allow-restricted",
            )


def _check_names(names: Mapping[str, object], where: object) -> None:
    """Raises: ArtifactError for a name that leads out of the folder, to a file of this module's, or below another file."""
    for name in names:
        path = PurePosixPath(name)
        plain = name.isprintable() and "\\" not in name and path.as_posix() == name and not path.is_absolute()
        taken = path.parts[:1] in ((), (VOLATILE_FOLDER,), (FILE_LIST,)) or any(str(p) in names for p in path.parents)
        if not plain or taken or ".." in path.parts:
            expected = "relative names of printable characters"
            raise ArtifactError("A file name is unsafe or taken", where=where, expected=expected, got=repr(name))


@contextmanager
def _client_errors(where: str, verb: str) -> Iterator[None]:
    """Turn errors of a store's client, also those by odd answers of a server, into one that names the next step."""
    try:
        yield
    except (OSError, RuntimeError, ValueError, TypeError, LookupError, AttributeError, httpx.HTTPError) as error:
        raise ArtifactError(
            f"The store did not finish the {verb}",
            where=where,
            got=first_line(error),
            next_step="check the name, the room and the rights (of HF_TOKEN), then run the same command again",
        ) from error


def _location(where: str) -> UPath:
    """A folder, an object store or the newest commit of a repository, as fsspec addresses it."""
    if where.startswith("hf://"):
        return _Repository(where).newest_commit()
    location = parse_location(where)
    if isinstance(location, Path):
        return UPath(location.absolute(), protocol="file", auto_mkdir=True)
    return location


def _published(location: UPath) -> tuple[dict[str, int], FileList]:
    """The size of every regular file at a location by relative name, and the list, of no files where there is none."""
    found = list_files(cast("AnyPath", location)).items()
    sizes = {name: about["size"] for name, about in found if about["type"] == "file" and not about.get("islink")}
    if FILE_LIST not in sizes:
        return sizes, FileList(files={})
    try:
        content = b"".join(_pieces(location / FILE_LIST, min(sizes[FILE_LIST], MAX_LIST_BYTES)))
        return sizes, FileList.model_validate_json(content)
    except ValidationError as error:
        raise ArtifactError(
            "List of files is damaged, too large or of another version",
            where=location / FILE_LIST,
            expected=f"version 3 in at most {MAX_LIST_BYTES} bytes",
            got=error.errors(include_url=False)[0]["msg"],
        ) from error


def _pieces(source: UPath, size: int) -> Iterator[Any]:
    """The content of a file, until one byte more than it should have: a server may send without end."""
    left = size + 1
    # Block size 0: a stream where the library has one, as a server may send all when asked for a range.
    with source.fs.open(str(source), "rb", block_size=0) as stream:
        while left and (piece := stream.read(min(_PIECE_BYTES, left))):
            left -= len(piece)
            yield piece


def _fetch(location: UPath, folder: Path, name: str, file: PublishedFile) -> None:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    with (folder / name).open("wb") as stream:
        stream.writelines(_pieces(location / name, file.size))


class _Repository:
    """A dataset repository of the hub, changed by one commit."""

    def __init__(self, where: str) -> None:
        match = _HUB_LOCATION.fullmatch(where)
        if match is None:
            raise ConfigError("Not a place on the hub", expected="hf://datasets/ORG/NAME[@REVISION]", got=where)
        self._where, self._revision = where, match["revision"]
        self._repo: dict[str, Any] = {"repo_id": match["id"], "repo_type": "dataset"}
        self._api = HfApi(**hub_access())

    def prepare(self, *, public: bool) -> None:
        """Make the repository and the branch where they do not exist.

        Raises: ArtifactError when it exists with another visibility: private data must not become public.
        """
        if not self._api.token:
            step = "make a token with write access and export HF_TOKEN"
            raise UnavailableError("Pushing to the hub needs a token", where=self._where, next_step=step)
        self._api.create_repo(**self._repo, private=not public, exist_ok=True)
        if bool(self._api.repo_info(**self._repo).private) == public:
            raise ArtifactError(
                "Repository has another visibility than asked for",
                where=self._where,
                expected="public" if public else "private",
                got="private" if public else "public",
                next_step="push to another repository, or " + ("leave out --public" if public else "add --public"),
            )
        if self._revision is not None:
            self._api.create_branch(**self._repo, branch=self._revision, exist_ok=True)

    def newest_commit(self) -> UPath:
        """The files of the revision's newest commit."""
        commit = str(self._api.repo_info(**self._repo, revision=self._revision).sha)
        if not re.fullmatch("[0-9a-f]{40}", commit):
            raise ValueError(f"the repository's commit is {commit!r}")
        return UPath(f"hf://datasets/{self._repo['repo_id']}@{commit}", **hub_access(), skip_instance_cache=True)

    def commit(self, sources: Mapping[str, Path], gone: Iterable[str], listed: bytes) -> None:
        """Send files, those that differ, with the list of what is there, and remove those that are gone."""
        added = [CommitOperationAdd(name, path) for name, path in sources.items()]
        operations = [*map(CommitOperationDelete, gone), *added, CommitOperationAdd(FILE_LIST, listed)]
        message = "Upload EpisodeSet"
        self._api.create_commit(**self._repo, revision=self._revision, operations=operations, commit_message=message)
