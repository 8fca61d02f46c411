"""A set pushed to an object store comes back with the same digest, also after interruptions; anything else is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from object_store import BUCKET, ObjectStore

from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.errors import ArtifactError
from worldline_core.publishing import pull, push
from worldline_core.store.artifact_files import digest_folder
from worldline_core.store.remote import UnreachableInputError

pytestmark = pytest.mark.usefixtures("short_pauses")


@pytest.fixture
def finished(tmp_path: Path, sample: Callable[..., tuple]) -> Path:
    with EpisodeSetWriter(tmp_path / "set", video_crf=8) as writer:
        for number in range(2):
            writer.add(*sample(number))
    return tmp_path / "set"


@pytest.mark.parametrize("kind", ["store", "folder"])
def test_there_and_back(tmp_path: Path, finished: Path, store: ObjectStore, kind: str) -> None:
    where = f"s3://{BUCKET}/there" if kind == "store" else str(tmp_path / "there")
    store.upload(tmp_path / "nothing", "x")  # makes the bucket
    pushed = push(finished, where)
    pulled = pull(where, tmp_path / "back")
    assert digest_folder(tmp_path / "back") == digest_folder(finished)
    assert pulled == pushed
    assert [row.episode_id for row in EpisodeSet.open(tmp_path / "back").rows] == ["episode-000", "episode-001"]
    with pytest.raises(ArtifactError, match="Folder exists already"):
        pull(where, tmp_path / "back")


@pytest.mark.parametrize("refused", [".json", ".txt"])
def test_an_interrupted_second_push_goes_on(tmp_path: Path, finished: Path, store: ObjectStore, refused: str) -> None:
    """Files that the second set lacks are removed and those of another content sent, also after an interruption."""
    store.upload(tmp_path / "nothing", "x")
    where = f"s3://{BUCKET}/again{refused}"
    (finished / "first.txt").write_text("of the first push alone")
    (finished / "both.txt").write_text("one")
    push(finished, where)
    (finished / "first.txt").unlink()
    (finished / "both.txt").write_text("two")
    (finished / "second.txt").write_text("of the second push alone")
    store.misbehave = lambda method, path: "broken" if method == "PUT" and path.endswith(refused) else None
    with pytest.raises(UnreachableInputError, match="A store could not be reached"):
        push(finished, where)
    store.misbehave = lambda method, path: None
    push(finished, where)
    pull(where, tmp_path / "back")
    assert digest_folder(tmp_path / "back") == digest_folder(finished)
