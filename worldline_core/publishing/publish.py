"""Push a finished EpisodeSet somewhere, pull it from there: the Hugging Face hub, a folder, or an object store."""

from __future__ import annotations

from pathlib import Path

from worldline_core.publishing.publish_hub import SCHEME, HubLocation, Published, pull_from_hub, push_to_hub
from worldline_core.publishing.publish_url import PublishedAtUrl, pull_from_url, push_to_url
from worldline_core.store.remote import parse_location


def push(
    folder: Path, where: str, *, public: bool = False, allow_restricted: bool = False, title: str | None = None
) -> Published | PublishedAtUrl:
    """Push to `hf://datasets/ORG/NAME`, to a URL that fsspec knows (`s3://bucket/folder`), or to a folder.

    Raises: as `push_to_hub` and `push_to_url`; ConfigError for a location that is not understood.
    """
    if where.startswith(SCHEME):
        location = HubLocation.parse(where)
        return push_to_hub(folder, location, public=public, allow_restricted=allow_restricted, title=title)
    target = parse_location(where)
    return push_to_url(folder, target, public=public, allow_restricted=allow_restricted, title=title)


def pull(where: str, folder: Path) -> Published | PublishedAtUrl:
    """Pull into a new folder what `push` pushed.

    Raises: as `pull_from_hub` and `pull_from_url`; ConfigError for a location that is not understood.
    """
    if where.startswith(SCHEME):
        return pull_from_hub(HubLocation.parse(where), folder)
    return pull_from_url(parse_location(where), folder)
