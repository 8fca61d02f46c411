"""Published sets of strangers: names, links, sizes and digests of their own making; and two who pull at once."""

from __future__ import annotations

import hashlib
import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tools.corrupted import lerobot_v21
from worldline_core import publishing
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_index import read_index, write_index
from worldline_core.errors import ArtifactError, DataError
from worldline_core.publishing import FILE_LIST, pull, push


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The place that a curated set was pushed to."""
    root = tmp_path_factory.mktemp("published")
    _, source = lerobot_v21.write(root / "corpus/set", 2, 0, np.random.default_rng(0))
    curate(CurateConfig.model_validate({"sources": [source]}), {}, root / "set")
    push(root / "set", str(root / "place"))
    return root / "place"


@pytest.fixture
def place(published: Path, tmp_path: Path) -> Path:
    """A copy of the place, for a test to change."""
    return shutil.copytree(published, tmp_path / "place")


def change_list(place: Path, name: str, content: bytes, **changes: int) -> None:
    listed = json.loads((place / FILE_LIST).read_text())
    listed["files"][name] = {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()} | changes
    (place / FILE_LIST).write_text(json.dumps(listed))


@pytest.mark.parametrize(
    "name",
    [
        "../x", "/etc/x", "a/../../x", "a\\..\\..\\x", "\\\\host\\x", "x\0y", "a\nb", "", ".", "./x", "a//b", "a/./b", "run/x",
        "manifest.JSON/../x", "..\\..\\x", "a/..", "a\u202eb", "a\u200fb", "a/", FILE_LIST,
        "index.parquet/x", ".cache/huggingface/x",
    ],
)  # fmt: skip
def test_names_that_lead_out_of_the_folder(name: str, place: Path, tmp_path: Path) -> None:
    change_list(place, name, b"x")
    before = set(tmp_path.rglob("*"))
    with pytest.raises(ArtifactError, match="unsafe or taken"):
        pull(str(place), tmp_path / "back")
    assert not (tmp_path / "back").exists()
    assert {path for path in tmp_path.rglob("*") if "back" not in str(path)} == before


@pytest.mark.parametrize("listed", [1, 1 << 60])
def test_files_of_another_size_than_listed_are_not_fetched(listed: int, place: Path, tmp_path: Path) -> None:
    (place / "large.bin").write_bytes(bytes(1000))
    change_list(place, "large.bin", bytes(1000), size=listed)
    with pytest.raises(ArtifactError, match=r"not those of the set[\s\S]*large\.bin"):
        pull(str(place), tmp_path / "back")
    assert [path.name for path in (tmp_path / "back.partial").rglob("*")] == ["run", ".lock"]


def test_a_set_that_reads_its_neighbours_is_not_taken_in(place: Path, tmp_path: Path) -> None:
    first, *others = read_index(place)
    write_index(place, [replace(first, dataset="../../secret"), *others])
    change_list(place, "index.parquet", (place / "index.parquet").read_bytes())
    with pytest.raises((ArtifactError, DataError), match=r"refers to datasets of another artifact|outside"):
        pull(str(place), tmp_path / "back")
    assert not (tmp_path / "back").exists()


@pytest.mark.parametrize(
    "content",
    [
        b"", b"[]", b"null", b"[" * 100_000, b"\xff", b'{"version": 3, "files": 3}', b'{"version": 2, "files": {}}',
        b'{"version": 3, "files": {"a": {"size": -1, "sha256": "0"}}}',
    ],
)  # fmt: skip
def test_lists_that_are_none(content: bytes, place: Path, tmp_path: Path) -> None:
    (place / FILE_LIST).write_bytes(content)
    with pytest.raises(ArtifactError, match="List of files is damaged"):
        pull(str(place), tmp_path / "back")


def test_a_list_is_read_up_to_its_bound_only(place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publishing, "MAX_LIST_BYTES", (place / FILE_LIST).stat().st_size)
    pull(str(place), tmp_path / "whole")
    monkeypatch.setattr(publishing, "MAX_LIST_BYTES", 1000)
    with (place / FILE_LIST).open("r+b") as stream:
        stream.truncate(3 << 30)  # sparse; read whole it would not fit into the tests' memory
    with pytest.raises(ArtifactError, match="List of files is too large"):
        pull(str(place), tmp_path / "back")
    with pytest.raises(ArtifactError, match="List of files is too large"):
        push(tmp_path / "whole", str(place))


def test_files_of_another_set_that_was_begun_here_are_removed(place: Path, tmp_path: Path) -> None:
    (tmp_path / "back.partial/a").mkdir(parents=True)
    for name in ("manifest.json", "a/b.bin", "index.parquet"):
        (tmp_path / "back.partial" / name).write_text("of another set")
    listed = pull(str(place), tmp_path / "back").files
    found = {
        path.relative_to(tmp_path / "back").as_posix() for path in (tmp_path / "back").rglob("*") if path.is_file()
    }
    assert found == set(listed)


def test_two_who_pull_into_one_folder_at_once(place: Path, tmp_path: Path) -> None:
    def work(_: int) -> str:
        try:
            pull(str(place), tmp_path / "back")
        except ArtifactError as error:
            return str(error)
        return ""

    with ThreadPoolExecutor(4) as threads:
        failed = [text for text in threads.map(work, range(4)) if text]
    assert len(failed) == 3
    assert all("exists already" in text or "Another command" in text for text in failed)
    assert read_index(tmp_path / "back") == read_index(place)
