"""The step: an EpisodeSet in, tracks, counts, quarantine and previews out."""

from __future__ import annotations

import hashlib
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from tasks.render_actions import render_actions as render_actions_task
from tests.actions.conftest import make_episode
from worldline_core.actions.action_tracks import CAUSES, compute_tracks
from worldline_core.actions.actions_config import RenderActionsConfig
from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.actions.render_actions import render_actions
from worldline_core.data.episodes.episode import VIEWS, Episode
from worldline_core.data.episodes.episode_index import read_index, read_quarantine, write_index
from worldline_core.data.episodes.episode_set import EpisodeSetWriter
from worldline_core.data.episodes.episode_set_writer import part_name
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.store.artifact_files import read_json
from worldline_core.store.store import ArtifactStore

N = 5
NUMBERS = ("uv", "depth", "rot6d", "gripper", "T_base_tool", "T_base_camera", "capsules", "capsule_radii")


def episode_of(embodiment: str, number: int) -> Episode:
    kinematics = ArmKinematics(load_embodiment(embodiment))
    action = np.linspace(0, 0.3, N)[:, None] * np.ones(kinematics.embodiment.state_size) * (1 + 0.1 * number)
    K = np.array([[60.0, 0, 47.5], [0, 60.0, 31.5], [0, 0, 1]])
    head = np.array([[0.0, 0, -1, 2.5], [1, 0, 0, 0], [0, -1, 0, 0.4], [0, 0, 0, 1]])
    return make_episode(kinematics, action, action, f"{embodiment}-{number}", K, head)


def write_set(root: Path, *episodes: Episode) -> Path:
    with EpisodeSetWriter(root) as writer:
        for episode in episodes:
            writer.add(episode, dict.fromkeys(episode.cameras or VIEWS[2:], np.full((N, 64, 96, 3), 90, np.uint8)))
    return root


@pytest.fixture(scope="module")
def episode_set(tmp_path_factory) -> Path:
    good = [episode_of("ur5e_pair", 0), episode_of("ur5e_pair", 1), episode_of("so101", 0)]
    unknown = replace(good[0], episode_id="alien-0", embodiment="alien")
    return write_set(tmp_path_factory.mktemp("episodes"), *good, unknown)


CONFIG = RenderActionsConfig.model_validate({"previews": 2, "episodes_per_shard": 2})


def digests(root: Path) -> dict[str, str]:
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file() and "run" not in path.relative_to(root).parts
    }


@pytest.fixture(scope="module")
def rendered(episode_set, tmp_path_factory) -> tuple[Path, dict]:
    output = tmp_path_factory.mktemp("tracks")
    return output, render_actions(CONFIG, {"episodes": episode_set}, output)


def test_every_episode_is_kept_or_quarantined(rendered):
    output, summary = rendered
    assert (summary["found"], summary["kept"], summary["quarantined"]) == (4, 3, 1)
    assert ActionTracks.open(output).episode_ids == ["so101-0", "ur5e_pair-0", "ur5e_pair-1"]
    assert [(row.episode_id, row.reason) for row in read_quarantine(output)] == [("alien-0", "unknown_embodiment")]
    samples = summary["samples"]
    assert sum(samples[cause] for cause in CAUSES) == samples["samples"] == N * (2 * 6 + 2)
    assert samples["valid"] > 0
    assert (samples["episodes"], summary["by_embodiment"]["so101"]["samples"]) == (3, N * 2)
    # Previews show each embodiment first.
    names = {path.name for path in (output / "previews").iterdir()}
    assert names == {f"{part_name(name)}.png" for name in ("so101-0", "ur5e_pair-0")}


def test_stored_tracks_are_those_computed(rendered):
    tracks = ActionTracks.open(rendered[0]).tracks("ur5e_pair-1")
    computed, _ = compute_tracks(episode_of("ur5e_pair", 1), ArmKinematics(load_embodiment("ur5e_pair")))
    assert (tracks.image_size, tracks.arms, tracks.num_frames) == ((64, 96), ("left", "right"), N)
    for name in (*NUMBERS, "valid"):
        stored, expected = getattr(tracks, name), getattr(computed, name)
        assert stored.dtype == expected.dtype
        np.testing.assert_array_equal(stored, expected)


def test_interrupted_work_continues_to_the_same_bytes(rendered, episode_set, tmp_path):
    output, summary = rendered
    again = tmp_path / "again"
    shutil.copytree(output, again)
    (again / "index.parquet").unlink()
    (again / "tracks-00001.safetensors").unlink()
    untouched = (again / "tracks-00000.safetensors").stat().st_mtime_ns
    assert render_actions(CONFIG, {"episodes": episode_set}, again) == summary
    assert (again / "tracks-00000.safetensors").stat().st_mtime_ns == untouched
    assert digests(again) == digests(output)


def test_what_cannot_be_read_or_rendered_is_named(rendered, tmp_path):
    with pytest.raises(DataError, match=r"No action tracks[\s\S]*nobody"):
        ActionTracks.open(rendered[0]).tracks("nobody")
    with pytest.raises(ArtifactError, match="Not an ActionTracks"):
        ActionTracks.open(tmp_path)
    with pytest.raises(ConfigError, match="EpisodeSet"):
        render_actions(CONFIG, {}, tmp_path)
    shutil.copytree(rendered[0], tmp_path / "tracks")
    (tmp_path / "tracks" / "tracks-00000.safetensors").write_bytes(b"broken")
    with pytest.raises(ArtifactError, match="tracks-00000"):
        list(ActionTracks.open(tmp_path / "tracks"))


@pytest.fixture
def linked(episode_set, tmp_path) -> tuple[Path, Path]:
    """An index over a curated set of a store, as filter writes it, and that set."""
    curated, filtered = tmp_path / "store" / "curate" / ("a" * 16), tmp_path / "store" / "filter" / ("b" * 16)
    shutil.copytree(episode_set, curated)
    rows = read_index(curated)
    filtered.mkdir(parents=True)
    write_index(filtered, [replace(row, dataset=f"../../curate/{curated.name}/{row.dataset}") for row in rows])
    return filtered, curated


@pytest.mark.parametrize("mode", ["full", "off"])
def test_data_that_is_gone_is_no_verdict_on_an_episode(linked, tmp_path, mode):
    filtered, curated = linked
    store = ArtifactStore(tmp_path / "store", mode)
    curated.rename(tmp_path / "elsewhere")
    with pytest.raises(ArtifactError, match="missing, with recordings"):
        render_actions_task.run(store, CONFIG, {"episodes": filtered})
    (tmp_path / "elsewhere").rename(curated)
    tracks = render_actions_task.run(store, CONFIG, {"episodes": filtered})
    assert read_json(tracks.path / "manifest.json")["metrics"]["kept"] == 3


DAMAGE = {
    "gone": Path.unlink,
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-9]),
    "empty": lambda path: path.write_bytes(b""),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
    "a link to nothing": lambda path: (path.unlink(), path.symlink_to("/nowhere")),
    "a pipe": lambda path: (path.unlink(), os.mkfifo(path)),
    "something else": lambda path: path.write_bytes(b"PAR1" + bytes(200) + b"PAR1"),
}


@pytest.mark.parametrize(
    ("kind", "file"),
    [*((kind, "cameras.parquet") for kind in DAMAGE), ("gone", "file-000.parquet"), ("cut", "file-000.parquet")],
)
def test_damaged_data_is_no_verdict_on_an_episode(linked, tmp_path, kind, file):
    filtered, curated = linked
    DAMAGE[kind](next(path for path in sorted(curated.rglob(file)) if "episodes" not in path.parts))
    with pytest.raises(ArtifactError, match="An input of this step is missing or damaged"):
        render_actions_task.run(ArtifactStore(tmp_path / "store", "off"), CONFIG, {"episodes": filtered})
    assert not list((tmp_path / "store" / "render_actions").glob("*/manifest.json"))


def test_tracks_that_are_no_numbers_are_refused(rendered, tmp_path):
    """Whoever reads them (a rollout, a training): they never become maps, nor a video."""
    shutil.copytree(rendered[0], tmp_path / "tracks")
    tracks = ActionTracks.open(tmp_path / "tracks")
    for value, name in [*((np.nan, name) for name in NUMBERS), (np.inf, "uv"), (-np.inf, "depth")]:
        shards = sorted(rendered[0].glob("tracks-*.safetensors"))
        path, arrays = next((path, found) for path in shards if "ur5e_pair-0/uv" in (found := load_file(path)))
        arrays[f"ur5e_pair-0/{name}"].flat[-1] = value
        save_file(arrays, tmp_path / "tracks" / path.name)
        with pytest.raises(ArtifactError, match=rf"not finite[\s\S]*ur5e_pair-0[\s\S]*{name}"):
            tracks.tracks("ur5e_pair-0")
        assert tracks.tracks("ur5e_pair-1").num_frames == N


@pytest.mark.parametrize(
    ("changes", "reason", "said"),
    [
        ({"cameras": {}}, "no_calibration", ""),
        ({"embodiment": "none"}, "unknown_embodiment", r"embodiment list[\s\S]*got: embodiment: none[\s\S]*Stage I"),
    ],
)
def test_a_set_without_any_tracks_is_an_error(tmp_path, changes, reason, said):
    episodes = [replace(episode_of("so101", number), **changes) for number in range(2)]
    with pytest.raises(DataError, match=rf"2 quarantined \(2 {reason}\)[\s\S]*{said}"):
        render_actions(CONFIG, {"episodes": write_set(tmp_path / "set", *episodes)}, tmp_path / "tracks")
    assert [row.reason for row in read_quarantine(tmp_path / "tracks")] == [reason] * 2
    assert not (tmp_path / "tracks" / "index.parquet").exists()
