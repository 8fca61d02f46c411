"""EpisodeSets on the Hugging Face hub: pushed to and pulled from a dataset repository by its id.

The token comes from the environment (HF_TOKEN) alone; HF_ENDPOINT names another hub. A new repository is private unless
told otherwise. Files that arrived stay, so a push or pull that was interrupted continues; the list of files with their
digests goes last, and a repository without it, or whose files are not those of the list, is not taken for a set.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from worldline_core.data.guards.source_paths import inside
from worldline_core.errors import ArtifactError, ConfigError, UnavailableError
from worldline_core.publishing.publish_content import (
    FILE_LIST,
    FileList,
    PublishedFile,
    card_files,
    check_may_publish,
    listed,
    set_files,
)
from worldline_core.store.digest import MANIFEST_NAME, VOLATILE_FOLDER, digest_folder

if TYPE_CHECKING:
    from huggingface_hub import HfApi
    from huggingface_hub.hf_api import RepoFile

SCHEME = "hf://"
_LOCATION = re.compile(r"hf://datasets/(?P<id>[\w.-]+/[\w.-]+)(@(?P<revision>[\w./-]+))?/?")
_DEFAULT_ENDPOINT = "https://huggingface.co"


@dataclass(frozen=True)
class HubLocation:
    """A dataset repository and one of its revisions (None: main)."""

    repo_id: str
    revision: str | None = None

    @classmethod
    def parse(cls, text: str) -> HubLocation:
        """Of `hf://datasets/ORG/NAME[@REVISION]`.

        Raises: ConfigError.
        """
        match = _LOCATION.fullmatch(text)
        if match is None:
            raise ConfigError("Not a place on the hub", expected="hf://datasets/ORG/NAME[@REVISION]", got=text)
        return cls(match["id"], match["revision"])

    def __str__(self) -> str:
        return f"{SCHEME}datasets/{self.repo_id}" + (f"@{self.revision}" if self.revision else "")


@dataclass(frozen=True)
class Published:
    """What lies at a location now."""

    location: HubLocation
    commit: str
    files: int
    num_bytes: int


def push_to_hub(
    folder: Path,
    location: HubLocation,
    *,
    public: bool = False,
    allow_restricted: bool = False,
    title: str | None = None,
) -> Published:
    """Push a finished EpisodeSet with its dataset card; files of an earlier push that are gone are removed.

    Raises: DataError when the folder is no set, or its licences do not allow it; ArtifactError when the set is not whole,
        the repository's visibility is another one, or the hub does not take it; UnavailableError without a token.
    """
    files = set_files(folder)
    check_may_publish(folder, public=public, allow_restricted=allow_restricted)
    card = card_files(folder, files, title)
    contents = listed(files, card)
    api = _api(needs_token=True)
    revision = location.revision or "main"
    with _hub_errors(location, "push"):
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete

        api.create_repo(location.repo_id, repo_type="dataset", private=not public, exist_ok=True)
        _check_visibility(api, location, public=public)
        if location.revision is not None:
            api.create_branch(location.repo_id, branch=revision, repo_type="dataset", exist_ok=True)
        api.upload_folder(
            repo_id=location.repo_id,
            repo_type="dataset",
            folder_path=folder,
            revision=revision,
            # Exact names: what is not of the set (run/, hidden files) stays here.
            allow_patterns=[_exactly(name) for name in files],
            commit_message="Upload EpisodeSet",
        )
        file_list = folder / VOLATILE_FOLDER / FILE_LIST
        contents.write(file_list)
        present = set(api.list_repo_files(location.repo_id, repo_type="dataset", revision=revision))
        gone = sorted(present - set(contents.files) - {FILE_LIST, ".gitattributes"})
        last = api.create_commit(
            location.repo_id,
            repo_type="dataset",
            revision=revision,
            operations=[
                *(CommitOperationAdd(name, path) for name, path in card.items()),
                CommitOperationAdd(FILE_LIST, file_list),
                *(CommitOperationDelete(name) for name in gone),
            ],
            commit_message="Complete EpisodeSet",
        )
        _check_arrived(api, location, last.oid, contents)
    return Published(location, last.oid, len(contents.files), contents.num_bytes)


def pull_from_hub(location: HubLocation, folder: Path) -> Published:
    """Pull a set that `push_to_hub` pushed; the folder appears when every file has been compared with its digest.

    The card lies in the folder's run/card, so the folder's content is that of the pushed set.

    Raises: ArtifactError when the folder exists, the hub does not give it, or files are not those of the list.
    """
    if folder.exists():
        raise ArtifactError("Folder exists already", where=folder, next_step="pull into a new folder")
    unfinished = folder.with_name(f"{folder.name}.partial")
    api = _api(needs_token=False)
    with _hub_errors(location, "pull"):
        commit = api.repo_info(location.repo_id, repo_type="dataset", revision=location.revision).sha or "main"
        api.snapshot_download(location.repo_id, repo_type="dataset", revision=commit, local_dir=unfinished)
    contents = FileList.read(unfinished / FILE_LIST, location)
    contents.check(unfinished)
    _arrange(unfinished, contents)
    manifest = unfinished / MANIFEST_NAME
    if manifest.is_file():
        _check_manifest(manifest, location)
    unfinished.rename(folder)
    return Published(location, commit, len(contents.files), contents.num_bytes)


def _api(*, needs_token: bool) -> HfApi:
    from huggingface_hub import HfApi

    token = os.environ.get("HF_TOKEN")
    if needs_token and not token:
        raise UnavailableError(
            "Pushing to the hub needs a token",
            expected="the environment variable HF_TOKEN",
            next_step="make a token with write access and export HF_TOKEN",
        )
    # False: without a token the client would look for one that some other program stored.
    return HfApi(endpoint=os.environ.get("HF_ENDPOINT", _DEFAULT_ENDPOINT), token=token or False)


def _exactly(name: str) -> str:
    """A shell pattern that only this name fits."""
    return re.sub(r"([*?\[])", r"[\1]", name)


def _check_visibility(api: HfApi, location: HubLocation, *, public: bool) -> None:
    """An existing repository keeps its visibility, whatever is asked for: private data must not land in a public one."""
    private = api.repo_info(location.repo_id, repo_type="dataset").private
    if bool(private) == public:
        raise ArtifactError(
            "Repository has another visibility than asked for",
            where=location,
            expected="public" if public else "private",
            got="private" if private else "public",
            next_step="push to another repository, or " + ("leave out --public" if public else "say --public"),
        )


def _check_arrived(api: HfApi, location: HubLocation, commit: str, contents: FileList) -> None:
    """Raises: ArtifactError when the hub's listing differs from what was sent."""
    from huggingface_hub.hf_api import RepoFile

    tree = api.list_repo_tree(location.repo_id, repo_type="dataset", revision=commit, recursive=True)
    found = {entry.path: entry for entry in tree if isinstance(entry, RepoFile)}
    wrong = [name for name, file in contents.files.items() if name not in found or not _same(found[name], file)]
    if wrong:
        raise ArtifactError(
            "The hub does not hold what was sent",
            where=location,
            expected=f"{len(contents.files)} files",
            got="missing or different: " + ", ".join(sorted(wrong)[:5]),
            next_step="run the same command again: what arrived is kept",
        )


def _same(entry: RepoFile, file: PublishedFile) -> bool:
    return entry.size == file.size and (entry.lfs is None or entry.lfs.sha256 == file.sha256)


def _arrange(root: Path, contents: FileList) -> None:
    """Card and bookkeeping go to run/, what the hub and its client added goes away."""
    for file in contents.files.values():
        if file.place == "card":
            target = inside(root / VOLATILE_FOLDER / "card", file.path)
            target.parent.mkdir(parents=True, exist_ok=True)
            inside(root, file.path).replace(target)
    (root / VOLATILE_FOLDER).mkdir(exist_ok=True)
    (root / FILE_LIST).replace(root / VOLATILE_FOLDER / FILE_LIST)
    (root / ".gitattributes").unlink(missing_ok=True)
    shutil.rmtree(root / ".cache", ignore_errors=True)
    for path in sorted(root.rglob("*"), reverse=True):
        if path.is_dir() and not any(path.iterdir()):
            path.rmdir()


def _check_manifest(manifest: Path, location: HubLocation) -> None:
    """Raises: ArtifactError when the content is not that whose digest the step wrote down."""

    stated = json.loads(manifest.read_text()).get("digest")
    found = digest_folder(manifest.parent)
    if stated is not None and stated != found:
        raise ArtifactError(
            "Content is not that of the manifest", where=location, expected=f"digest {stated}", got=f"digest {found}"
        )


@contextmanager
def _hub_errors(location: HubLocation, verb: str) -> Iterator[None]:
    """What the client raises, as an error that says what to do."""
    import httpx
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

    try:
        yield
    except HFValidationError as error:
        raise ConfigError("Not the name of a repository", where=location, got=str(error)) from error
    except (HfHubHTTPError, LocalEntryNotFoundError, httpx.HTTPError, OSError, RuntimeError) as error:
        text = str(error).strip().splitlines()
        raise ArtifactError(
            f"The hub did not finish the {verb}",
            where=location,
            got=f"{type(error).__name__}: {text[0] if text else ''}"[:300],
            next_step="check the name and the rights of HF_TOKEN; the same command continues where it stopped",
        ) from error
