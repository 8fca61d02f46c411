"""EpisodeSets in a folder or an object store (`s3://bucket/folder`, any URL that fsspec knows): pushed and pulled.

The list of files with their digests is written last and removed first, so a reader sees a whole set or none. What has
arrived is not sent again: an interrupted push or pull goes on. Credentials come from the environment alone.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from worldline_core.data.guards.source_paths import inside
from worldline_core.errors import ArtifactError
from worldline_core.publishing.publish_content import (
    FILE_LIST,
    FileList,
    PublishedFile,
    card_files,
    check_may_publish,
    listed,
    set_files,
)
from worldline_core.store.digest import MANIFEST_NAME, VOLATILE_FOLDER, digest_file, digest_folder
from worldline_core.store.remote import AnyPath, file_system, is_remote, list_files, with_retries


@dataclass(frozen=True)
class PublishedAtUrl:
    """What lies at a location now, and how much of it this call moved."""

    location: str
    files: int
    num_bytes: int
    moved_files: int


def push_to_url(
    folder: Path,
    location: AnyPath,
    *,
    public: bool = False,
    allow_restricted: bool = False,
    title: str | None = None,
) -> PublishedAtUrl:
    """Push a finished EpisodeSet with its dataset card; files of an earlier push that are gone are removed.

    Args:
        public: whether others can read the location: licences that do not allow that are then refused.

    Raises: DataError when the folder is no set, or its licences do not allow it; ArtifactError when the set is not whole
        or the location holds something else; UnreachableInputError when the store does not answer.
    """
    files = set_files(folder)
    check_may_publish(folder, public=public, allow_restricted=allow_restricted)
    sources = {**files, **card_files(folder, files, title)}
    contents = listed(files, {name: path for name, path in sources.items() if name not in files})
    present, earlier = _listing(location), _list_at(location)
    foreign = sorted(set(present) - set(contents.files) - set(earlier.files if earlier else ()) - {FILE_LIST})
    if foreign:
        raise ArtifactError(
            "The location holds files that are not of this set",
            where=str(location),
            expected="an empty location, or an earlier push",
            got=", ".join(foreign[:5]) + (f" and {len(foreign) - 5} more" if len(foreign) > 5 else ""),
            next_step="push to a location of its own",
        )
    if earlier is not None and earlier == contents:
        return PublishedAtUrl(str(location), len(contents.files), contents.num_bytes, 0)
    if earlier is not None:
        _remove(location, FILE_LIST)
    sent = 0
    for name, path in sorted(sources.items()):
        if not _arrived(present.get(name), path):
            _send(path, location, name)
            sent += 1
    for name in sorted(set(present) - set(contents.files) - {FILE_LIST}):
        _remove(location, name)
    file_list = folder / VOLATILE_FOLDER / FILE_LIST
    contents.write(file_list)
    _send(file_list, location, FILE_LIST)
    return PublishedAtUrl(str(location), len(contents.files), contents.num_bytes, sent)


def pull_from_url(location: AnyPath, folder: Path) -> PublishedAtUrl:
    """Pull a set that `push_to_url` pushed; the folder appears when every file has been compared with its digest.

    The card lies in the folder's run/card, so the folder's content is that of the pushed set.

    Raises: ArtifactError when the folder exists, the location holds no finished set, or files are not those of the list;
        UnreachableInputError when the store does not answer.
    """
    if folder.exists():
        raise ArtifactError("Folder exists already", where=folder, next_step="pull into a new folder")
    unfinished = folder.with_name(f"{folder.name}.partial")
    file_list = unfinished / VOLATILE_FOLDER / FILE_LIST
    file_list.parent.mkdir(parents=True, exist_ok=True)
    file_list.unlink(missing_ok=True)
    if _is_file(location, FILE_LIST):
        _fetch(location, FILE_LIST, file_list)
    contents = FileList.read(file_list, location)
    fetched = 0
    for file in contents.files.values():
        target = _place(unfinished, file)
        if not _same(target, file):
            target.parent.mkdir(parents=True, exist_ok=True)
            _fetch(location, file.path, target)
            fetched += 1
            if not _same(target, file):
                raise ArtifactError(
                    "A published file is not that of the set",
                    where=f"{location}/{file.path}",
                    expected=f"{file.size} bytes, sha256 {file.sha256[:16]}",
                    got=f"{target.stat().st_size} bytes, sha256 {digest_file(target)[:16]}",
                    next_step="pull again; if it stays, push the set again",
                )
    _check_manifest(unfinished, location)
    unfinished.rename(folder)
    return PublishedAtUrl(str(location), len(contents.files), contents.num_bytes, fetched)


def _place(root: Path, file: PublishedFile) -> Path:
    return inside(root / VOLATILE_FOLDER / "card" if file.place == "card" else root, file.path)


def _same(path: Path, file: PublishedFile) -> bool:
    return path.is_file() and path.stat().st_size == file.size and digest_file(path) == file.sha256


def _check_manifest(folder: Path, location: AnyPath) -> None:
    manifest = folder / MANIFEST_NAME
    stated = json.loads(manifest.read_text()).get("digest") if manifest.is_file() else None
    if stated is not None and stated != (found := digest_folder(folder)):
        raise ArtifactError(
            "Content is not that of the manifest", where=str(location), expected=f"digest {stated}", got=found
        )


def _listing(location: AnyPath) -> Mapping[str, dict[str, Any]]:
    """Relative name -> what is known of the file, of all that lies there."""
    if is_remote(location):
        file_system(location).invalidate_cache()
        return list_files(location)
    found = (path for path in location.rglob("*") if path.is_file())
    return {path.relative_to(location).as_posix(): {"size": path.stat().st_size} for path in found}


def _list_at(location: AnyPath) -> FileList | None:
    if not _is_file(location, FILE_LIST):
        return None
    rows = json.loads(with_retries((location / FILE_LIST).read_text, f"{location}/{FILE_LIST}"))["files"]
    return FileList({row["path"]: PublishedFile(**row) for row in rows})


def _is_file(location: AnyPath, name: str) -> bool:
    return with_retries((location / name).is_file, f"{location}/{name}")


def _arrived(about: dict[str, Any] | None, path: Path) -> bool:
    """Whether the store says that it has this very content: an S3 object's ETag is its MD5 where it was sent at once."""
    if about is None or about.get("size") != path.stat().st_size:
        return False
    with path.open("rb") as stream:
        md5 = hashlib.file_digest(stream, "md5").hexdigest()
    return str(about.get("ETag", "")).strip('"') == md5


def _send(path: Path, location: AnyPath, name: str) -> None:
    target = location / PurePosixPath(name)
    if is_remote(location):
        with_retries(lambda: file_system(location).put_file(str(path), str(target)), str(target))
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(path.read_bytes())


def _fetch(location: AnyPath, name: str, target: Path) -> None:
    source = location / PurePosixPath(name)
    if is_remote(location):
        with_retries(lambda: file_system(location).get_file(str(source), str(target)), str(source))
    else:
        target.write_bytes(source.read_bytes())


def _remove(location: AnyPath, name: str) -> None:
    target = location / PurePosixPath(name)
    if is_remote(location):
        with_retries(lambda: file_system(location).rm_file(str(target)), str(target))
    else:
        target.unlink()
