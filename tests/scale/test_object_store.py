"""Recordings elsewhere: the same bytes as from a folder, through every misbehaviour of a store; and sets that are pushed there."""

from __future__ import annotations

import errno
import shutil
import stat
from collections import Counter
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import Mock

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from fsspec.implementations.memory import MemoryFileSystem
from upath import UPath

from tests.data.conftest import make_sample  # pyright: ignore[reportMissingImports]
from tests.data.curating import record, run
from tests.scale.conftest import BUCKET, ObjectStore
from tools.corrupted import lerobot_v21, mcap
from tools.corrupted.content import HEIGHT, WIDTH
from tools.corrupted.one_of_each import write_one_of_each
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_set import EpisodeSetWriter
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import inside, parse_location
from worldline_core.errors import ArtifactError
from worldline_core.publishing import pull, push
from worldline_core.scale.account import read_account
from worldline_core.scale.mapping import RunnerConfig, SerialMapper
from worldline_core.store.artifact_files import digest_folder
from worldline_core.store.remote import RemoteCache, UnreachableInputError, list_files
from worldline_core.store.store import ArtifactStore


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(
        tmp_path_factory.mktemp("recorded") / "raw", [make_sample(number, views=("head",)) for number in (0, 1)]
    )


def curated_digest(path: object, output: Path) -> str:
    source = {"kind": "episode_set", "path": str(path), "name": "raw"}
    config = CurateConfig.model_validate({"sources": [source], "image_size": (16, 24), "fps": 8})
    curate(config, {}, output, SerialMapper(RunnerConfig(episodes_per_shard=1, retries=1, retry_seconds=0.01)))
    return digest_folder(output)


@pytest.fixture(scope="module")
def digest(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Digest of the curated recordings, read from their folder."""
    return curated_digest(recordings, tmp_path_factory.mktemp("local"))


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["busy", "broken", "hang up"])
def test_a_store_that_flickers_gives_the_bytes_of_a_folder(
    tmp_path: Path, recordings: Path, digest: str, store: ObjectStore, fault: str
) -> None:
    url = store.upload(recordings, f"flicker-{fault.replace(' ', '-')}")
    asked: Counter[str] = Counter()

    def every_third(_method: str, path: str) -> str | None:
        # Counted by path: with one count for all, what others ask meanwhile could fail every retry of the same request.
        asked[path] += 1
        return fault if asked[path] % 3 == 1 else None

    store.misbehave = every_third
    assert curated_digest(url, tmp_path) == digest
    assert len(asked) > 3


@pytest.mark.slow
def test_a_store_that_stays_away_is_no_reason_to_quarantine(
    tmp_path: Path, recordings: Path, digest: str, store: ObjectStore
) -> None:
    url = store.upload(recordings, "away")
    store.misbehave = lambda method, path: "broken" if method == "GET" and path.endswith(".mp4") else None
    with pytest.raises(UnreachableInputError, match="shards could not read all of their inputs"):
        curated_digest(url, tmp_path)
    writer = EpisodeSetWriter(tmp_path)
    assert (writer.kept(), writer.rejected()) == ([], [])
    store.misbehave = lambda method, path: None
    assert curated_digest(url, tmp_path) == digest
    assert {row.status for row in read_account(tmp_path)} == {"kept"}


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
    with monkeypatch.context() as patch, pytest.raises(UnreachableInputError, match="could not be reached"):
        patch.setattr(fs, "info", Mock(side_effect=TimeoutError))  # for which fsspec says that nothing is there
        list_files(location)
    assert list(list_files(location)) == ["a.txt", "one/b.txt"]
    assert list_files(location / "none") == {}


@pytest.mark.parametrize("relative", ["../other/x.mp4", "a/../../x", "/etc/passwd", "s3://other/x", "a\0b"])
def test_metadata_cannot_lead_out_of_the_location(relative: str) -> None:
    root = parse_location("memory://bucket/set")
    with pytest.raises(RejectedInputError, match="Path leads outside of the dataset folder"):
        inside(root, relative)
    assert str(inside(root, "videos/x.mp4")).endswith("set/videos/x.mp4")


def test_copies_stay_within_their_bound_in_a_private_folder(tmp_path: Path, store: ObjectStore) -> None:
    for number in range(6):
        (tmp_path / f"{number}.bin").write_bytes(bytes([number]) * 1000)
    root = parse_location(store.upload(tmp_path, "bound"))
    cache = RemoteCache(max_bytes=2500)
    assert stat.S_IMODE(cache.folder.stat().st_mode) == 0o700
    for number in (0, 1, 0, 2, 3, 0, 4, 5):
        assert cache.fetch(root / f"{number}.bin").read_bytes() == bytes([number]) * 1000
        assert sum(path.stat().st_size for path in cache.folder.rglob("*") if path.is_file()) <= 2500
    asked = [path for method, path in store.requests if method == "GET" and "/bound/" in path]
    assert len(asked) == 7  # 0 was asked for three times: once it was still there


def test_the_key_of_a_remote_input_follows_its_content(tmp_path: Path, store: ObjectStore) -> None:
    artifacts = ArtifactStore(tmp_path / "artifacts")
    (tmp_path / "raw").mkdir()
    digests = []
    for content in ("one", "one", "two"):
        (tmp_path / "raw" / "index.parquet").write_text(content)
        url: Any = parse_location(store.upload(tmp_path / "raw", "key"))
        url.fs.invalidate_cache()
        digests.append(artifacts.input_digest(url))
    assert digests[0] == digests[1] != digests[2]
    assert not [path for method, path in store.requests if method == "GET" and "/key/" in path]  # listings say enough


@pytest.mark.usefixtures("store")
def test_a_set_is_pushed_and_pulled(tmp_path: Path, recordings: Path) -> None:
    where = f"s3://{BUCKET}/there"
    pushed = push(recordings, where)
    assert pull(where, tmp_path / "back") == pushed
    assert digest_folder(tmp_path / "back") == digest_folder(recordings)
    with pytest.raises(ArtifactError, match="Folder exists already"):
        pull(where, tmp_path / "back")


def test_in_a_folder_the_card_takes_the_place_of_a_page_that_is_gone(tmp_path: Path, recordings: Path) -> None:
    folder = shutil.copytree(recordings, tmp_path / "set")
    (folder / "README.md").write_text("of its own")
    push(folder, str(tmp_path / "there"))
    (folder / "README.md").unlink()
    push(folder, str(tmp_path / "there"))
    assert (tmp_path / "there/README.md").read_text().startswith("---\n")
    pull(str(tmp_path / "there"), tmp_path / "back")
    assert digest_folder(tmp_path / "back") == digest_folder(recordings)


@pytest.mark.slow
@pytest.mark.parametrize("refused", [".json", ".txt"])
def test_an_interrupted_second_push_goes_on(tmp_path: Path, recordings: Path, store: ObjectStore, refused: str) -> None:
    """Files that the second set lacks are removed and those of another content sent, also after an interruption."""
    where, folder = f"s3://{BUCKET}/again{refused}", shutil.copytree(recordings, tmp_path / "set")
    (folder / "first.txt").write_text("of the first push alone")
    (folder / "both.txt").write_text("one")
    push(folder, where)
    (folder / "first.txt").rename(folder / "second.txt")
    (folder / "both.txt").write_text("two")
    store.misbehave = lambda method, path: "broken" if method == "PUT" and path.endswith(refused) else None
    with pytest.raises(ArtifactError, match="did not finish the push"):
        push(folder, where)
    store.misbehave = lambda method, path: None
    push(folder, where)
    pull(where, tmp_path / "back")
    assert digest_folder(tmp_path / "back") == digest_folder(folder)


@pytest.fixture(scope="module")
def one_of_each(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    pytest.importorskip("h5py", reason="the extra `hdf5` is not installed")
    return write_one_of_each(tmp_path_factory.mktemp("layouts"))


@pytest.mark.usefixtures("reading_in_this_process")  # which alone has a file system in memory
@pytest.mark.parametrize(
    "layout",
    [
        "lerobot_v21",
        "mcap",
        "robomind",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("robotwin", "video_folder", "droid_annotation")),
    ],
)
def test_the_same_bytes_from_a_folder_and_from_elsewhere(
    tmp_path: Path, request: pytest.FixtureRequest, layout: str
) -> None:
    if layout == "lerobot_v21":
        source = lerobot_v21.write(tmp_path / layout, 2, 0, np.random.default_rng(0))[1]
        for number, table in enumerate(sorted(tmp_path.rglob("data/chunk-000/*.parquet"))):  # whole, and cut
            pq.write_table(pq.read_table(table).drop(["frame_index"]).slice(0, (99, 9)[number]), table)
        camera = {"width": WIDTH, "height": HEIGHT, "K": [[80, 0, 48], [0, 80, 36], [0, 0, 1]], "T": np.eye(4).tolist()}
        views = dict.fromkeys(source["views"].values(), camera | {"maps": "camera_to_base", "axes": "opencv"})
        (Path(source["path"]) / "meta/cameras.yaml").write_text(yaml.safe_dump({"views": views}))
        source |= {"calibration": "meta/cameras.yaml", "collection": True}
    elif layout == "mcap":
        source = mcap.write(tmp_path / layout, 1, 0, np.random.default_rng(0))[1]
    else:
        source = request.getfixturevalue("one_of_each")[layout]
    local = Path(source["path"])
    if layout == "robomind":
        (local / "texts.csv").write_text("task,instruction\nopen_drawer,pull it open\n")
        source |= {"instructions": "texts.csv"}
    if broken := {"mcap": "broken.mcap", "video_folder": "broken.mp4"}.get(layout):
        (local / broken).write_bytes(b"no recording")
    remote = UPath(f"memory://{tmp_path.name}/{local.name}")
    remote.fs.put(f"{local}/", remote.path, recursive=True)
    made = []
    for number, path in enumerate((local, remote)):
        counts, curated = run(tmp_path / str(number), source | {"path": str(path), "name": "rec"}, min_frames=1)
        made.append((counts, digest_folder(curated.root)))
    assert made[0][0]["kept"] == 1
    assert made[0][0]["quarantined"] == (layout in ("lerobot_v21", "mcap", "video_folder"))
    assert made[0] == made[1]
