"""Changed files of finished artifacts are named before a step reads them; whatever changes in other inputs means new work."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from flows.command_line import main
from tests.data.conftest import make_sample
from tests.data.curating import record
from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode_index import read_index, write_index
from worldline_core.errors import ArtifactError
from worldline_core.rollout.recorded_starts import RecordedStarts
from worldline_core.rollout.worldline import WorldLine
from worldline_core.store import artifact_files
from worldline_core.store.artifact_files import VerifyMode, check_artifacts, find_damage, folder_files, write_manifest
from worldline_core.store.store import Artifact, ArtifactStore

Capsys, Run = pytest.CaptureFixture[str], dict[str, Path]


class WriteConfig(StrictModel):
    text: str = "abc"


def write(config: WriteConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    (output / "below").mkdir(exist_ok=True)
    for name in ("one", "two", "below/three"):
        (output / name).write_text(config.text + "".join(str(len(list(path.rglob("*")))) for path in inputs.values()))
    return {"counts": {2: 1, 10: 0.1}}


def next_step(store: Path, folder: Path, mode: VerifyMode = "full") -> Artifact:
    """A step that reads an artifact, in a process that has read nothing yet."""
    artifact_files._digests.clear()
    return ArtifactStore(store, mode).run("next", 1, write, WriteConfig(), {"episodes": folder})


@contextmanager
def flipped(path: Path, position: int, bit: int) -> Iterator[None]:
    """One bit of a file turned over, as a disk does it: size and time of change stay what they were."""
    content, stat = path.read_bytes(), path.stat()
    changed = bytearray(content)
    changed[position] ^= 1 << bit
    path.write_bytes(changed)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    yield
    path.write_bytes(content)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A set of one recording as curation leaves it, and one like a filter's, which shares its videos."""
    store = ArtifactStore(tmp_path_factory.mktemp("store"))

    def curate(config: StrictModel, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
        record(output, [make_sample()])
        return {}

    def keep(config: StrictModel, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
        above = os.path.relpath(inputs["episodes"], output)
        write_index(output, [replace(row, dataset=f"{above}/{row.dataset}") for row in read_index(inputs["episodes"])])
        return {}

    curated = store.run("curate", 1, curate, StrictModel(), {}).path
    return {"curate": curated, "filter": store.run("filter", 1, keep, StrictModel(), {"episodes": curated}).path}


@pytest.mark.parametrize("kind", ["curate", "filter"])
def test_a_flipped_byte_is_named_before_it_is_used(run: Run, kind: str, tmp_path: Path) -> None:
    folder = run[kind]
    for path in [*folder_files(folder).values(), folder / "manifest.json"]:
        size = path.stat().st_size
        for place, position in enumerate(sorted({0, 4 * size // 5} & set(range(size)))):
            with flipped(path, position, 0 if path.suffix == ".json" else place):
                with pytest.raises(ArtifactError, match="damaged") as error:
                    next_step(tmp_path, folder)
                assert path.relative_to(folder).as_posix() in str(error.value)
                assert f"worldline task {folder.parent.name}" in str(error.value)
    assert not next_step(tmp_path, folder).cached


READERS = [
    "inspect {set}", "inspect {set} --episode x", "card {set}", "push {set} {out}", "export {set} --format lerobot --output {out}",
    "export {set} --format mcap --episode x --output {out}", "calibrate check --artifact {set} --output {out}", "compare {set} {set}",
]  # fmt: skip


@pytest.mark.parametrize("kind", ["curate", "filter"])
def test_no_command_step_or_simulation_reads_a_flipped_byte(
    run: Run, tmp_path: Path, kind: str, capsys: Capsys
) -> None:
    """A filtered set shares the videos of the curated one."""
    video, out = next(run["curate"].rglob("*.mp4")), tmp_path / "out"
    with flipped(video, video.stat().st_size // 2, 3):
        for command in READERS:
            artifact_files._digests.clear()
            with pytest.raises(SystemExit, match=r"[12]"):
                main(command.format(set=run[kind], out=out).split())
            assert f"{video.name}: sha256" in capsys.readouterr().err, command
        assert [path.name for path in out.rglob("*")] == ["run", ".lock"]
        with pytest.raises(ArtifactError, match=rf"{video.name}: sha256"):
            next_step(tmp_path, run[kind])
        artifact_files._digests.clear()
        with pytest.raises(ArtifactError, match=rf"{video.name}: sha256"):
            RecordedStarts(run[kind], view_sets=[("head",)], fps=8)


def test_no_command_reads_a_damaged_model(project_root: Path, tmp_path: Path, capsys: Capsys) -> None:
    copy = shutil.copytree(project_root / "artifacts/shipped/models/causal", tmp_path / "model")
    weights = next(copy.glob("*.safetensors"))
    with flipped(weights, weights.stat().st_size - 1, 3):
        for command in ("card {set}", "export {set} --format model --output {out}", "inspect {set}"):
            artifact_files._digests.clear()
            with pytest.raises(SystemExit, match="1"):
                main(command.format(set=copy, out=tmp_path / "out").split())
            assert f"{weights.name}: sha256" in capsys.readouterr().err
        with pytest.raises(ArtifactError, match=f"{weights.name}: sha256"):
            WorldLine.from_pretrained(copy)


@pytest.fixture
def artifact(tmp_path: Path) -> Path:
    return ArtifactStore(tmp_path).run("write", 1, write, WriteConfig(), {}).path


def test_files_that_are_missing_added_or_of_another_size_are_named(artifact: Path, tmp_path: Path) -> None:
    (artifact / "below" / "three").unlink()
    (artifact / "new").write_text("new")
    (artifact / "two").write_text("abcd")
    (artifact / "run").mkdir()
    (artifact / "run" / "log").write_text("belongs to no digest")
    with pytest.raises(ArtifactError, match="below/three: missing") as error:
        next_step(tmp_path, artifact)
    assert "new: not listed" in str(error.value)
    assert "two: 4 bytes instead of 3" in str(error.value)
    assert "one:" not in str(error.value)


def test_fast_reads_only_what_was_changed_after_the_manifest(artifact: Path, tmp_path: Path) -> None:
    artifact_files._digests.clear()
    assert not find_damage(artifact, "fast")
    assert not artifact_files._digests
    (artifact / "one").write_text("abd")
    os.utime(artifact / "one", ns=(0, (artifact / "manifest.json").stat().st_mtime_ns + 1))
    with pytest.raises(ArtifactError, match="one: sha256"):
        next_step(tmp_path, artifact, "fast")
    (artifact / "one").write_text("ab")
    os.utime(artifact / "one", ns=(0, 0))
    with pytest.raises(ArtifactError, match="one: 2 bytes"):
        next_step(tmp_path, artifact, "fast")
    assert not next_step(tmp_path, artifact, "off").cached


def test_a_process_reads_each_file_once(artifact: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    next_step(tmp_path, artifact)
    read: list[Path] = []
    monkeypatch.setattr(artifact_files, "digest_file", lambda path: read.append(path) or "")
    assert not find_damage(artifact)
    assert not read


def test_verify_names_damaged_files_and_how_to_rebuild(artifact: Path, tmp_path: Path, capsys: Capsys) -> None:
    other = next_step(tmp_path, artifact).path
    command = ["verify", "--artifacts", str(tmp_path)]
    with pytest.raises(SystemExit, match="0"):
        main(command)
    assert "2 artifacts, 0 damaged" in capsys.readouterr().out
    (artifact / "two").write_text("abd")
    with pytest.raises(SystemExit, match="1"):
        main(command)
    assert f"delete {artifact}" in (printed := capsys.readouterr().out)
    assert f"whole  {other}" in printed
    with pytest.raises(SystemExit, match="1"):
        main(["verify", str(tmp_path)])
    assert "Not a finished artifact" in capsys.readouterr().err


def test_shipped_files_are_those_of_their_manifests(project_root: Path) -> None:
    shipped = project_root / "artifacts" / "shipped"
    folders = [shipped / "recordings", shipped / "banks", *sorted((shipped / "models").iterdir())]
    damaged = [folder for folder, damage in check_artifacts(folders).items() if damage]
    assert not damaged, "changed on purpose? python -m tools.state_files FOLDER..."


FOREIGN = ['{"episodes": 3}', '{"digest": "0123", "files": {}}', "[1, 2]", "no JSON", ""]


@pytest.fixture
def source(tmp_path: Path) -> Path:
    for name in ("a.txt", "run/b.txt", "run/deep/c.txt"):
        (tmp_path / "source" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "source" / name).write_text(name)
    return tmp_path / "source"


@pytest.mark.parametrize("manifest", FOREIGN)
def test_a_source_with_its_own_manifest_is_read_again_when_it_changes(
    tmp_path: Path, source: Path, manifest: str
) -> None:
    (source / "manifest.json").write_text(manifest)
    keys = {next_step(tmp_path / "store", source).key}
    assert next_step(tmp_path / "store", source).cached
    changed = ("a.txt", "run/b.txt", "run/deep/c.txt", "manifest.json")
    for name in changed:
        (source / name).write_text('{"another": "content"}')
        keys.add(next_step(tmp_path / "store", source).key)
    gone = ("a.txt", "run/deep/c.txt", "run")
    for name in gone:
        shutil.rmtree(source / name) if (source / name).is_dir() else (source / name).unlink()
        keys.add(next_step(tmp_path / "store", source).key)
    assert len(keys) == 1 + len(changed) + len(gone)


@pytest.mark.parametrize("mode", ["full", "fast"])
@pytest.mark.parametrize("damage", ["change", "remove", "add"])
def test_recordings_are_compared_with_our_manifest(tmp_path: Path, source: Path, mode: VerifyMode, damage: str) -> None:
    write_manifest(source, {"step": "record_episodes"})
    next_step(tmp_path / "store", source)
    path = source / ("new.txt" if damage == "add" else "a.txt")
    path.unlink() if damage == "remove" else path.write_text("A.txt")
    if damage != "remove":
        later = (source / "manifest.json").stat().st_mtime_ns + 10**9
        os.utime(path, ns=(later, later))
    with pytest.raises(ArtifactError, match=rf"{path.name}: [\s\S]*git checkout"):  # it is not to be deleted
        next_step(tmp_path / "store", source, mode)
    # What the owner meant becomes another input once the manifest is gone, as the message says.
    (source / "manifest.json").unlink()
    assert not next_step(tmp_path / "store", source, mode).cached
