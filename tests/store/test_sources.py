"""Folders that are no artifacts of a store, as inputs: whatever changes in them means new work."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from worldline_core.config import StrictModel
from worldline_core.errors import ArtifactError
from worldline_core.store import artifact_files
from worldline_core.store.artifact_files import VerifyMode, write_manifest
from worldline_core.store.store import Artifact, ArtifactStore


class CopyConfig(StrictModel):
    pass


def copy(config: CopyConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    del config
    for path in inputs["source"].rglob("*.txt"):
        (output / path.name).write_bytes(path.read_bytes())
    return {}


def read(store: Path, source: Path, mode: VerifyMode = "full") -> Artifact:
    """A step that reads a folder, in a process that has read nothing yet."""
    artifact_files._digests.clear()
    return ArtifactStore(store, mode).run("copy", 1, copy, CopyConfig(), {"source": source})


FOREIGN = ['{"episodes": 3}', '{"digest": "0123", "files": {}}', "[1, 2]", "no JSON", ""]


@pytest.fixture
def source(tmp_path: Path) -> Path:
    for name in ("a.txt", "run/b.txt", "run/deep/c.txt"):
        (tmp_path / "source" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "source" / name).write_text(name)
    return tmp_path / "source"


@pytest.mark.parametrize("manifest", FOREIGN)
@pytest.mark.parametrize("changed", ["a.txt", "run/b.txt", "run/deep/c.txt", "manifest.json"])
def test_a_source_with_a_manifest_of_its_own_is_read_again_when_it_changes(
    tmp_path: Path, source: Path, manifest: str, changed: str
) -> None:
    (source / "manifest.json").write_text(manifest)
    first = read(tmp_path / "store", source)
    assert read(tmp_path / "store", source).cached
    (source / changed).write_text('{"another": "content"}')
    second = read(tmp_path / "store", source)
    assert not second.cached
    assert second.key != first.key


@pytest.mark.parametrize("vanished", ["a.txt", "run/deep/c.txt", "run"])
def test_a_source_is_read_again_when_a_part_of_it_is_gone(tmp_path: Path, source: Path, vanished: str) -> None:
    read(tmp_path / "store", source)
    gone = source / vanished
    shutil.rmtree(gone) if gone.is_dir() else gone.unlink()
    assert not read(tmp_path / "store", source).cached


@pytest.mark.parametrize("mode", ["full", "fast"])
@pytest.mark.parametrize("damage", ["change", "remove", "add"])
def test_recordings_with_our_manifest_are_compared_with_it_even_where_the_step_is_finished(
    tmp_path: Path, source: Path, mode: VerifyMode, damage: str
) -> None:
    write_manifest(source, {"step": "record_episodes"})
    read(tmp_path / "store", source)
    path = source / ("new.txt" if damage == "add" else "a.txt")
    path.unlink() if damage == "remove" else path.write_text("A.txt")
    if damage != "remove":
        later = (source / "manifest.json").stat().st_mtime_ns + 10**9
        os.utime(path, ns=(later, later))
    with pytest.raises(ArtifactError, match=f"{path.name}: "):
        read(tmp_path / "store", source, mode)
    # What the owner meant becomes another input once the manifest is gone, as the message says.
    (source / "manifest.json").unlink()
    assert not read(tmp_path / "store", source, mode).cached
