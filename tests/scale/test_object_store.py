"""Recordings in an S3-compatible store: the same set as from a folder, through every misbehaviour of the store."""

from __future__ import annotations

import errno
import stat
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest
from fsspec.implementations.memory import MemoryFileSystem
from object_store import ObjectStore
from upath import UPath

from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_set import EpisodeSetWriter
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import inside, local_file, parse_location
from worldline_core.scale.account import read_account
from worldline_core.scale.mapping import RunnerConfig, SerialMapper
from worldline_core.store.artifact_files import digest_folder
from worldline_core.store.remote import RemoteCache, UnreachableInputError, list_files
from worldline_core.store.store import ArtifactStore

Make = Callable[..., tuple]

pytestmark = pytest.mark.usefixtures("short_pauses")


@pytest.fixture
def recordings(tmp_path: Path, sample: Make) -> Path:
    with EpisodeSetWriter(tmp_path / "raw", video_crf=8) as writer:
        for number in range(5):
            writer.add(*sample(number))
    return tmp_path / "raw"


def config(path: object, **changes: Any) -> CurateConfig:
    source = {"kind": "episode_set", "path": str(path), "name": "raw"}
    return CurateConfig.model_validate({"sources": [source], "image_size": (16, 24), "fps": 8, **changes})


def curated_digest(configured: CurateConfig, output: Path) -> str:
    curate(configured, {}, output, SerialMapper(RunnerConfig(episodes_per_shard=2, retries=1, retry_seconds=0.01)))
    return digest_folder(output)


def test_a_set_in_the_store_gives_the_bytes_of_one_in_a_folder(
    tmp_path: Path, recordings: Path, store: ObjectStore
) -> None:
    url = store.upload(recordings, "same")
    assert curated_digest(config(url), tmp_path / "remote") == curated_digest(config(recordings), tmp_path / "local")


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["busy", "broken", "hang up"])
def test_a_store_that_flickers_changes_nothing(
    tmp_path: Path, recordings: Path, store: ObjectStore, fault: str
) -> None:
    url = store.upload(recordings, f"flicker-{fault.replace(' ', '-')}")
    asked: Counter[str] = Counter()

    def every_third(_method: str, path: str) -> str | None:
        # Counted by path: with one count for all, what others ask meanwhile could fail every retry of the same request.
        asked[path] += 1
        return fault if asked[path] % 3 == 1 else None

    store.misbehave = every_third
    remote = curated_digest(config(url), tmp_path / "remote")
    assert len(asked) > 3
    assert remote == curated_digest(config(recordings), tmp_path / "local")


@pytest.mark.slow
def test_a_store_that_stays_away_is_no_reason_to_quarantine(
    tmp_path: Path, recordings: Path, store: ObjectStore
) -> None:
    url = store.upload(recordings, "away")
    store.misbehave = lambda method, path: "broken" if method == "GET" and path.endswith(".mp4") else None
    with pytest.raises(UnreachableInputError, match="shards could not read all of their inputs"):
        curated_digest(config(url), tmp_path / "out")
    writer = EpisodeSetWriter(tmp_path / "out")
    assert (writer.kept(), writer.rejected()) == ([], [])
    store.misbehave = lambda method, path: None
    assert curated_digest(config(url), tmp_path / "out") == curated_digest(config(recordings), tmp_path / "local")
    assert {row.status for row in read_account(tmp_path / "out")} == {"kept"}


class Forgetful(MemoryFileSystem):
    """Lists folder by folder, and every second listing fails."""

    protocol = "forgetful"
    store: ClassVar[dict[str, Any]] = {}
    asked = 0

    def ls(self, path: str, detail: bool = True, **options: Any) -> Any:
        type(self).asked += 1
        if self.asked % 2 == 0:
            raise OSError(errno.EIO, "try again")
        return super().ls(path, detail=detail, **options)


def test_a_folder_that_could_not_be_listed_is_not_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    fs = Forgetful()
    for name in ("a.txt", "one/b.txt"):
        fs.pipe_file(f"/bucket/{name}", b"x")
    location: Any = UPath("memory://bucket")
    monkeypatch.setattr(type(location), "fs", fs)
    with pytest.raises(UnreachableInputError, match="could not be reached"):  # every attempt in the second folder
        list_files(location)
    monkeypatch.setattr(Forgetful, "ls", MemoryFileSystem.ls)
    assert list(list_files(location)) == ["a.txt", "one/b.txt"]
    assert list_files(location / "none") == {}


@pytest.mark.parametrize("relative", ["../other/x.mp4", "a/../../x", "/etc/passwd", "s3://other/x", "a\0b"])
def test_metadata_cannot_lead_out_of_the_location(relative: str) -> None:
    root = parse_location("memory://bucket/set")
    with pytest.raises(RejectedInputError, match="Path leads outside of the dataset folder"):
        inside(root, relative)
    assert str(inside(root, "videos/x.mp4")).endswith("set/videos/x.mp4")


def test_copies_stay_within_their_bound_in_a_private_folder(tmp_path: Path, store: ObjectStore) -> None:
    folder = tmp_path / "files"
    folder.mkdir()
    for number in range(6):
        (folder / f"{number}.bin").write_bytes(bytes([number]) * 1000)
    root = parse_location(store.upload(folder, "bound"))
    cache = RemoteCache(max_bytes=2500)
    assert stat.S_IMODE(cache.folder.stat().st_mode) == 0o700
    for number in (0, 1, 0, 2, 3, 0, 4, 5):
        copy = cache.fetch(root / f"{number}.bin")
        assert copy.read_bytes() == bytes([number]) * 1000
        assert sum(path.stat().st_size for path in cache.folder.rglob("*") if path.is_file()) <= 2500
    asked = [path for method, path in store.requests if method == "GET" and "/bound/" in path]
    assert len(asked) == 7  # 0 was asked for three times: once it was still there


def test_a_cut_download_is_noticed(tmp_path: Path, store: ObjectStore, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "a.bin").write_bytes(b"x" * 5000)
    root: Any = parse_location(store.upload(tmp_path / "files", "cut"))
    fetched = 0
    whole = root.fs.get_file

    def cut(source: str, target: str) -> None:
        nonlocal fetched
        fetched += 1
        whole(source, target)
        if fetched < 3:
            Path(target).write_bytes(b"x" * 100)

    monkeypatch.setattr(root.fs, "get_file", cut)
    assert local_file(root / "a.bin").stat().st_size == 5000
    assert fetched == 3


def test_the_key_of_a_remote_input_follows_its_content(tmp_path: Path, recordings: Path, store: ObjectStore) -> None:
    artifacts = ArtifactStore(tmp_path / "artifacts")
    url: Any = parse_location(store.upload(recordings, "key"))
    first = artifacts.input_digest(url)
    fetched = [path for method, path in store.requests if method == "GET" and "/key/" in path]
    assert fetched == []  # the listing says enough
    store.upload(recordings, "key")
    url.fs.invalidate_cache()
    assert artifacts.input_digest(url) == first
    (recordings / "index.parquet").write_bytes(b"other")
    store.upload(recordings, "key")
    url.fs.invalidate_cache()
    assert artifacts.input_digest(url) != first
