"""Datasets that change while they are read, and places where nothing can be written."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.data.curating import rejected
from tools.corrupted.content import FPS, pictures
from worldline_core.data.curation import curate as curate_step
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_index import read_index, read_quarantine
from worldline_core.data.episodes.episode_set_writer import EpisodeSetWriter
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import local_file, unchanged_files
from worldline_core.data.video.encoder import encode_video
from worldline_core.store.artifact_files import digest_folder

pytestmark = pytest.mark.usefixtures("reading_in_this_process")


Make = Callable[[int], tuple[Path, CurateConfig]]


def linked(root: Path) -> None:
    """A file becomes a link to one outside between check and use."""
    video, secret = next((root / "videos/chunk-000").glob("*top/episode_000001.mp4")), root.parents[1] / "secret.mp4"
    encode_video(secret, pictures(np.random.default_rng(7)), FPS, preset="ultrafast")
    video.unlink()
    video.symlink_to(secret)


def during(episode: str, change: Callable[[], None], monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `change` happen once the values of an episode were read, and before its pictures are."""
    check = curate_step.check_episode

    def changed(config: CurateConfig, loaded: LoadedEpisode) -> None:
        check(config, loaded)
        if loaded.episode.episode_id == episode:
            change()

    monkeypatch.setattr(curate_step, "check_episode", changed)


def rewritten(root: Path) -> None:
    table = root / "data/chunk-000/episode_000001.parquet"
    pq.write_table(pq.read_table(table).slice(0, 20), table)


def cut(root: Path) -> None:
    os.truncate(next((root / "videos/chunk-000").glob("*top/episode_000001.mp4")), 900)


def exchanged(root: Path) -> None:
    """An equally long video."""
    video = next((root / "videos/chunk-000").glob("*wrist/episode_000001.mp4"))
    other = video.with_suffix(".new.mp4")
    encode_video(other, pictures(np.random.default_rng(99)), FPS, preset="ultrafast")
    other.replace(video)


@pytest.mark.parametrize("change", [rewritten, cut, exchanged, linked])
def test_a_file_changed_while_its_episode_is_read(
    dataset: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: Callable[[Path], None]
) -> None:
    root, config = dataset(3)
    during("set-000001", lambda: change(root), monkeypatch)
    curate(config, {}, tmp_path / "out")
    (row,) = read_quarantine(tmp_path / "out")
    assert row.episode_id == "set-000001"
    assert row.reason in ("changed_while_reading", "path_traversal" if change is linked else "")
    assert change is linked or "episode_000001." in row.detail
    assert str(tmp_path) not in row.detail
    assert [row.episode_id for row in read_index(tmp_path / "out")] == ["set-000000", "set-000002"]
    assert not list((tmp_path / "out" / "run").rglob("*.mp4"))


def test_nothing_changed_nothing_said(dataset: Make, tmp_path: Path) -> None:
    root, config = dataset(3)
    curate(config, {}, tmp_path / "first")
    assert not read_quarantine(tmp_path / "first")
    for path in root.rglob("*"):
        os.utime(path)  # a copy, say: between two runs a dataset may change
    curate(config, {}, tmp_path / "second")
    assert digest_folder(tmp_path / "first") == digest_folder(tmp_path / "second")


def test_a_watched_block(tmp_path: Path) -> None:
    file = tmp_path / "a"
    file.write_text("one")
    with unchanged_files("e"):
        local_file(file)
    with rejected("changed_while_reading", "Files changed"), unchanged_files("e"):
        local_file(file)
        file.unlink()
        raise RejectedInputError("missing_file", "it is gone")
    with pytest.raises(ZeroDivisionError, match="division"), unchanged_files("e"):
        local_file(tmp_path / "never")
        _ = 1 / 0


def test_a_full_disk_ends_the_run_and_what_is_done_stays(
    dataset: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is no fault of the recordings: none of them may be quarantined for it."""
    _, config = dataset(4)
    add, calls = EpisodeSetWriter.add, []

    def full(self: EpisodeSetWriter, *arguments: Any, **named: Any) -> None:
        calls.append(1)
        if len(calls) == 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        add(self, *arguments, **named)

    with monkeypatch.context() as patch:
        patch.setattr(EpisodeSetWriter, "add", full)
        with pytest.raises(Exception, match="No space left on device"):
            curate(config, {}, tmp_path / "out")
    assert not (tmp_path / "out" / "index.parquet").exists()
    counts = curate(config, {}, tmp_path / "out")
    assert (counts["found"], counts["kept"]) == (4, 4)
    curate(config, {}, tmp_path / "undisturbed")
    assert digest_folder(tmp_path / "out") == digest_folder(tmp_path / "undisturbed")
