"""Push a finished EpisodeSet to a folder, an object store or the Hugging Face hub, and pull it back.

A published set has a list of its files with sizes and digests, by which every pulled file is checked. A push to the hub is
one commit; elsewhere the list is written last. Credentials come from the environment alone.
"""

from __future__ import annotations

import glob
import json
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, Literal, cast

import httpx
from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi, snapshot_download
from pydantic import ValidationError
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
    ListedFile,
    describe_file,
    folder_files,
    shortened,
    verify_artifact,
)
from worldline_core.store.remote import AnyPath, first_line, list_files, parse_location
from worldline_core.store.store import folder_lock

FILE_LIST = "worldline_files.json"
MAX_LIST_BYTES = 64 << 20
_HUB_NOTES = ".cache"
"""Folder in which the hub's client notes how far a download has come."""
_TAKEN = (FILE_LIST, VOLATILE_FOLDER, _HUB_NOTES)
_HUB_LOCATION = re.compile(r"hf://datasets/(?P<id>[\w.-]+/[\w.-]+)(@(?P<revision>[\w./-]+))?/?")


class FileList(StrictModel):
    """The files of a published set by path; neither the list itself nor the dataset card is among them."""

    version: Literal[3] = 3
    files: dict[str, ListedFile]

    @property
    def num_bytes(self) -> int:
        return sum(file.size for file in self.files.values())


def push(folder: Path, where: str, *, public: bool = False, allow_restricted: bool = False) -> FileList:
    """Push a finished EpisodeSet with its dataset card; files of an earlier push that are gone are removed.

    Args:
        where: `hf://datasets/ORG/NAME[@REVISION]`, a URL that fsspec knows (`s3://bucket/folder`), or a folder.
        public: others can read the location, so licences that do not allow that are refused. Otherwise a new repository
            of the hub is private.
        allow_restricted: push although licences do not allow it.

    Raises: DataError when the folder is no set, or its licences do not allow it; ArtifactError when the set is damaged or
        not self-contained, the location holds something else or has another visibility, or the store refuses;
        ConfigError for an unknown location; UnavailableError without a token.
    """
    verify_artifact(folder)
    sending = set_files(folder)
    if not allow_restricted:
        _check_may_publish(folder, public=public)
    _check_names(sending, folder)
    contents = FileList(files={name: describe_file(path) for name, path in sorted(sending.items())})
    if "README.md" not in sending:
        sending["README.md"] = write_card(folder, folder / VOLATILE_FOLDER / "card")
    with _client_errors(where, "push"):
        if where.startswith("hf://"):
            _prepare_repository(where, public=public)
        location, present, earlier = _published(where)
        foreign = present.keys() - sending.keys() - {".gitattributes"}
        if earlier is None and foreign:
            raise ArtifactError(
                "The location holds files that are not of this set", where=where, got=shortened(sorted(foreign)),
                expected="an empty location, or an earlier push", next_step="push to a location of its own",
            )  # fmt: skip
        gone = sorted(foreign & earlier.files.keys()) if earlier else []
        _send(where, location, sending, gone, contents.model_dump_json(indent=1).encode())
    return contents


def pull(where: str, folder: Path) -> FileList:
    """Pull a pushed set into a new folder, which appears once every file has been compared with its digest.

    Raises: ArtifactError when the folder exists, no finished set is published there, names or files do not match the list,
        or the store refuses; ConfigError for an unknown location; UnreachableInputError when the store does not answer.
    """
    _check_new(folder)
    unfinished = folder.with_name(f"{folder.name}.partial")
    with folder_lock(unfinished):
        _check_new(folder)  # another command may have finished meanwhile
        with _client_errors(where, "pull"):
            location, present, contents = _published(where)
            if contents is None:
                raise ArtifactError("No finished EpisodeSet is published here", where=where, expected=FILE_LIST)
            _check_names(contents.files, where)
            wrong = [name for name, file in contents.files.items() if present.get(name) != file.size]
            if not wrong:
                missing = _keep_listed(unfinished, contents)  # an interrupted pull may have left some
                _fetch(location, unfinished, missing)
                if (unfinished / _HUB_NOTES).exists():
                    shutil.rmtree(unfinished / _HUB_NOTES)
                wrong = _keep_listed(unfinished, contents)
        if wrong:
            raise ArtifactError(
                "Published files are not those of the set", where=where, got=shortened(wrong),
                expected=f"the files with the sizes and digests of {FILE_LIST}",
                next_step="pull again; if it stays, delete the published copy and push the set again",
            )  # fmt: skip
        set_files(unfinished)  # a set that refers to folders beside it would read what others put there
        verify_artifact(unfinished)
        unfinished.rename(folder)
        (folder / VOLATILE_FOLDER / ".lock").unlink()
    return contents


def set_files(folder: Path) -> dict[str, Path]:
    """The files of a finished, self-contained set, by their path in the publication.

    Raises: DataError when the folder is no finished EpisodeSet; ArtifactError when it needs another artifact's datasets.
    """
    linked = sorted({r.dataset for r in EpisodeSet.open(folder).rows if ".." in PurePosixPath(r.dataset).parts})
    if linked:
        raise ArtifactError(
            "The set refers to datasets of another artifact", where=folder, got=shortened(linked),
            next_step=f"make it whole first: worldline export {folder} --format lerobot --output FOLDER",
        )  # fmt: skip
    return folder_files(folder) | {path.name: path for path in folder.glob(MANIFEST_NAME)}


def _check_new(folder: Path) -> None:
    if folder.exists():
        raise ArtifactError("Folder exists already", where=folder, next_step="pull into a new folder")


def _check_may_publish(folder: Path, *, public: bool) -> None:
    """Raises: DataError for sources whose licence forbids redistribution or, in a public place, does not mention it, and
    for recordings meant for evaluation only.
    """
    sources, rows = read_source_table(folder), EpisodeSet.open(folder).rows
    unknown = [f"{s.label} ({s.license})" for s in sources if s.redistribution == "unknown"] if sources else ["all"]
    refused = {
        "Sources forbid redistribution": [f"{s.label} ({s.license})" for s in sources if s.redistribution == "no"],
        "Sources are for evaluation only": sorted(
            {r.source for r in rows if for_evaluation_only(json.loads(r.conventions), r.source, r.embodiment)}
        ),
        "Sources do not state whether redistribution is allowed": unknown if public else [],
    }
    for what, names in refused.items():
        if names:
            raise DataError(
                what, where=folder, expected="curate.sources[].redistribution: yes", got=", ".join(names),
                next_step="leave these sources out, or, if you have the right, add --allow-restricted",
            )  # fmt: skip


def _check_names(names: Mapping[str, object], where: object) -> None:
    """Raises: ArtifactError for a name that leads out of the folder, to a file of this module's, or below another file."""
    for name in names:
        path = PurePosixPath(name)
        plain = name.isprintable() and "\\" not in name and path.as_posix() == name and not path.is_absolute()
        taken = not path.parts or path.parts[0] in _TAKEN or any(str(p) in names for p in path.parents)
        if not plain or taken or ".." in path.parts:
            what, expected = "A file name of the set is unsafe or taken", "relative names of printable characters"
            raise ArtifactError(what, where=where, expected=expected, got=repr(name))


@contextmanager
def _client_errors(where: str, verb: str) -> Iterator[None]:
    """Turn errors of a store's client, also those by odd answers of a server, into one that names the next step."""
    try:
        yield
    except (OSError, RuntimeError, ValueError, TypeError, LookupError, AttributeError, httpx.HTTPError) as error:
        raise ArtifactError(
            f"The store did not finish the {verb}", where=where, got=first_line(error)[:300],
            next_step="check the name, the room and the rights (of HF_TOKEN), then run the same command again",
        ) from error  # fmt: skip


def _published(where: str) -> tuple[UPath, dict[str, int], FileList | None]:
    """A location, the size of every regular file there by its relative name, and the list of what was pushed there."""
    location = _location(where)
    location.fs.invalidate_cache()
    listed, source = list_files(cast("AnyPath", location)).items(), location / FILE_LIST
    present = {name: about["size"] for name, about in listed if about["type"] == "file" and not about.get("islink")}
    if FILE_LIST not in present:
        return location, present, None
    if present[FILE_LIST] > MAX_LIST_BYTES:
        raise ArtifactError("List of files is too large", where=source, expected=f"at most {MAX_LIST_BYTES} bytes")
    what, content = "List of files is damaged or of another version", source.read_bytes()
    if len(content) != present[FILE_LIST]:
        expected = f"{present[FILE_LIST]} bytes, as the store lists it"
        raise ArtifactError(what, where=source, expected=expected, got=f"{len(content)} bytes")
    try:
        return location, present, FileList.model_validate_json(content)
    except ValidationError as error:
        got = error.errors(include_url=False)[0]["msg"]
        raise ArtifactError(what, where=source, got=got) from error


def _keep_listed(folder: Path, contents: FileList) -> list[str]:
    """Remove files that are not as listed; returns the names of those that are missing then."""
    for name, path in folder_files(folder, everything=True).items():
        ours = name.startswith((f"{VOLATILE_FOLDER}/", f"{_HUB_NOTES}/"))
        if not ours and not (path.is_file() and describe_file(path) == contents.files.get(name)):
            path.unlink()
    return [name for name in contents.files if not (folder / name).is_file()]


def _fetch(location: UPath, folder: Path, names: Iterable[str]) -> None:
    """Fetch files into a folder."""
    if str(location).startswith("hf://"):
        _, repository, commit = _hub(str(location))
        # The client lists the repository again, and only these names were checked.
        wanted = [glob.escape(name) for name in names]
        snapshot_download(**repository, revision=commit, local_dir=folder, allow_patterns=wanted, **hub_access())
    else:
        location.fs.get([str(location / name) for name in names], [str(folder / name) for name in names])


def _location(where: str) -> UPath:
    """A folder, an object store, or the newest commit of a hub's repository, as fsspec addresses it."""
    if where.startswith("hf://"):
        api, repository, revision = _hub(where)
        commit = str(api.repo_info(**repository, revision=revision).sha)
        if not re.fullmatch("[0-9a-f]{40}", commit):
            raise ValueError(f"the repository's commit is {commit!r}")
        name = f"hf://datasets/{repository['repo_id']}@{commit}"
        return UPath(name, **hub_access(), skip_instance_cache=True)
    location = parse_location(where)
    local = isinstance(location, Path)
    return UPath(location.absolute(), protocol="file", auto_mkdir=True) if local else cast("UPath", location)


def _send(where: str, location: UPath, files: Mapping[str, Path], gone: Iterable[str], listed: bytes) -> None:
    """Send files, remove those that are gone, and write the list of what is there: in one commit, or last."""
    if where.startswith("hf://"):
        api, repository, revision = _hub(where)
        added = [CommitOperationAdd(name, content) for name, content in {**files, FILE_LIST: listed}.items()]
        changes = [*map(CommitOperationDelete, gone), *added]
        api.create_commit(**repository, revision=revision, operations=changes, commit_message="Upload EpisodeSet")
        return
    location.fs.put([str(path) for path in files.values()], [str(location / name) for name in files])
    for name in gone:
        location.fs.rm_file(str(location / name))
    location.fs.pipe_file(str(location / FILE_LIST), listed)


def _hub(where: str) -> tuple[HfApi, dict[str, Any], str | None]:
    """Client, dataset repository and revision of a location on the hub."""
    match = _HUB_LOCATION.fullmatch(where)
    if match is None:
        raise ConfigError("Not a place on the hub", expected="hf://datasets/ORG/NAME[@REVISION]", got=where)
    return HfApi(**hub_access()), {"repo_id": match["id"], "repo_type": "dataset"}, match["revision"]


def _prepare_repository(where: str, *, public: bool) -> None:
    """Make the repository, and the branch, where they do not exist.

    Raises: ArtifactError when it exists with another visibility: private data must not become public.
    """
    api, repository, revision = _hub(where)
    if not api.token:
        step = "make a token with write access and export HF_TOKEN"
        raise UnavailableError("Pushing to the hub needs a token", where=where, next_step=step)
    api.create_repo(**repository, private=not public, exist_ok=True)
    if bool(api.repo_info(**repository).private) == public:
        expected, got = ("public", "private") if public else ("private", "public")
        step = "push to another repository, or " + ("leave out --public" if public else "add --public")
        raise ArtifactError(
            "Repository has another visibility than asked for", where=where, expected=expected, got=got, next_step=step
        )
    if revision is not None:
        api.create_branch(**repository, branch=revision, exist_ok=True)
