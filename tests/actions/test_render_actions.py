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
from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.actions_config import RenderActionsConfig
from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.actions.render_actions import render_actions
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.episodes.episode_index import read_index, read_quarantine, write_index
from worldline_core.data.episodes.episode_set import EpisodeSetWriter
from worldline_core.data.episodes.episode_set_writer import part_name
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.store.artifact_files import read_json
from worldline_core.store.store import ArtifactStore

N = 5


def episode_of(embodiment: str, number: int) -> Episode:
    kinematics = ArmKinematics(load_embodiment(embodiment))
    size = kinematics.embodiment.state_size
    action = np.linspace(0, 0.3, N)[:, None] * np.ones(size) * (1 + 0.1 * number)
    K = np.array([[60.0, 0, 47.5], [0, 60.0, 31.5], [0, 0, 1]])
    head = np.array([[0.0, 0, -1, 2.5], [1, 0, 0, 0], [0, -1, 0, 0.4], [0, 0, 0, 1]])
    cameras = {"head": CameraTrack("head", K, head[None], 96, 64)}
    for view, poses in kinematics.wrist_camera_poses(action).items():
        cameras[view] = CameraTrack(view, K, poses.numpy(), 96, 64)
    return Episode(
        episode_id=f"{embodiment}-{number}",
        source="test",
        embodiment=embodiment,
        scene="s",
        task_family="lift",
        instruction="lift the cube",
        outcome="unknown",
        split="train",
        fps=8.0,
        state=action.astype(np.float32),
        action=action.astype(np.float32),
        timestamps=np.arange(N) / 8.0,
        cameras=cameras,
    )


@pytest.fixture(scope="module")
def episode_set(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("episodes")
    good = [episode_of("ur5e_pair", 0), episode_of("ur5e_pair", 1), episode_of("so101", 0)]
    unknown = replace(good[0], episode_id="alien-0", embodiment="alien")
    with EpisodeSetWriter(root) as writer:
        for episode in [*good, unknown]:
            frames = {view: np.full((N, 64, 96, 3), 90, np.uint8) for view in episode.cameras}
            writer.add(episode, frames)
    return root


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
    (row,) = read_quarantine(output)
    assert (row.episode_id, row.reason) == ("alien-0", "unknown_embodiment")
    samples = summary["samples"]
    causes = ("valid", "behind_camera", "outside_image", "invalid_calibration")
    assert sum(samples[cause] for cause in causes) == samples["samples"] == N * (2 * 6 + 2)
    assert samples["valid"] > 0
    assert samples["episodes"] == 3
    assert summary["by_embodiment"]["so101"]["samples"] == N * 2


def test_stored_tracks_are_those_computed(rendered):
    output, _ = rendered
    tracks = ActionTracks.open(output).tracks("ur5e_pair-1")
    kinematics = ArmKinematics(load_embodiment("ur5e_pair"))
    episode = episode_of("ur5e_pair", 1)
    np.testing.assert_allclose(
        tracks.T_base_tool, kinematics.tool_poses(episode.action.astype(np.float64)).numpy(), atol=1e-6
    )
    assert tracks.image_size == (64, 96)
    assert tracks.arms == ("left", "right")
    assert tracks.valid.dtype == bool
    assert tracks.uv.dtype == np.float64
    assert tracks.depth.dtype == tracks.rot6d.dtype == tracks.capsules.dtype == np.float32
    computed, _ = compute_tracks(episode, kinematics)
    for name in ("uv", "depth", "rot6d", "gripper", "valid", "capsules"):
        np.testing.assert_array_equal(getattr(tracks, name), getattr(computed, name))
    assert tracks.capsules.shape[0] == N


def test_previews_show_each_embodiment_first(rendered):
    output, _ = rendered
    names = {path.name for path in (output / "previews").iterdir()}
    assert names == {f"{part_name(name)}.png" for name in ("so101-0", "ur5e_pair-0")}


def test_interrupted_work_continues_to_the_same_bytes(rendered, episode_set, tmp_path):
    output, summary = rendered
    again = tmp_path / "again"
    again.mkdir()
    render_actions(CONFIG, {"episodes": episode_set}, again)
    (again / "index.parquet").unlink()
    (again / "tracks-00001.safetensors").unlink()
    untouched = (again / "tracks-00000.safetensors").stat().st_mtime_ns
    assert render_actions(CONFIG, {"episodes": episode_set}, again) == summary
    assert (again / "tracks-00000.safetensors").stat().st_mtime_ns == untouched
    assert digests(again) == digests(output)


def test_unknown_episode_is_named(rendered):
    with pytest.raises(DataError, match=r"No action tracks of this episode[\s\S]*nobody"):
        ActionTracks.open(rendered[0]).tracks("nobody")


def test_another_folder_is_no_action_tracks(tmp_path):
    with pytest.raises(ArtifactError, match="Not an ActionTracks artifact"):
        ActionTracks.open(tmp_path)


def test_damaged_shard_is_named(rendered, tmp_path):
    for path in rendered[0].glob("*.*"):
        if path.is_file():
            (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "tracks-00000.safetensors").write_bytes(b"broken")
    with pytest.raises(ArtifactError, match=r"cannot be read[\s\S]*tracks-00000|tracks-00000[\s\S]*cannot be read"):
        list(ActionTracks.open(tmp_path))


@pytest.fixture
def linked(episode_set, tmp_path) -> tuple[Path, Path]:
    """An index over a curated set of a store, as filter writes it, and that set."""
    curated, filtered = tmp_path / "store" / "curate" / ("a" * 16), tmp_path / "store" / "filter" / ("b" * 16)
    shutil.copytree(episode_set, curated)
    rows = read_index(curated)
    filtered.mkdir(parents=True)
    write_index(filtered, [replace(row, dataset=f"../../curate/{curated.name}/{row.dataset}") for row in rows])
    return filtered, curated


@pytest.mark.parametrize("mode", ["full", "fast", "off"])
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


@pytest.mark.parametrize("file", ["cameras.parquet", "file-000.parquet"])
@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_damaged_data_is_no_verdict_on_an_episode(linked, tmp_path, damage, file):
    filtered, curated = linked
    damage(next(path for path in sorted(curated.rglob(file)) if "episodes" not in path.parts))
    with pytest.raises(ArtifactError, match="An input of this step is missing or damaged"):
        render_actions_task.run(ArtifactStore(tmp_path / "store", "off"), CONFIG, {"episodes": filtered})
    assert not list((tmp_path / "store" / "render_actions").glob("*/manifest.json"))


NUMBERS = ("uv", "depth", "rot6d", "gripper", "T_base_tool", "T_base_camera", "capsules", "capsule_radii")


@pytest.mark.parametrize(("value", "name"), [*((np.nan, name) for name in NUMBERS), (np.inf, "uv"), (-np.inf, "depth")])
def test_tracks_that_are_no_numbers_are_refused(rendered, tmp_path, value, name):
    """Whoever reads them (a rollout, a training): they never become maps, nor a video."""
    shutil.copytree(rendered[0], tmp_path / "tracks")
    shards = sorted((tmp_path / "tracks").glob("tracks-*.safetensors"))
    path, arrays = next((path, found) for path in shards if "ur5e_pair-0/uv" in (found := load_file(path)))
    arrays[f"ur5e_pair-0/{name}"].flat[-1] = value
    save_file(arrays, path)
    tracks = ActionTracks.open(tmp_path / "tracks")
    with pytest.raises(ArtifactError, match=rf"not finite[\s\S]*ur5e_pair-0[\s\S]*{name}"):
        tracks.tracks("ur5e_pair-0")
    assert tracks.tracks("ur5e_pair-1").num_frames == N


def test_a_set_without_any_tracks_is_an_error(tmp_path):
    with EpisodeSetWriter(tmp_path / "set") as writer:
        for number in range(2):
            blind = replace(episode_of("so101", number), cameras={})
            writer.add(blind, {"right_wrist": np.full((N, 64, 96, 3), 90, np.uint8)})
    with pytest.raises(DataError, match=r"No episode got action tracks[\s\S]*2 quarantined \(2 no_calibration\)"):
        render_actions(CONFIG, {"episodes": tmp_path / "set"}, tmp_path / "tracks")
    assert [row.reason for row in read_quarantine(tmp_path / "tracks")] == ["no_calibration"] * 2
    assert not (tmp_path / "tracks" / "index.parquet").exists()


def test_a_robot_without_description_is_named_with_its_use(tmp_path):
    with EpisodeSetWriter(tmp_path / "set") as writer:
        episode = replace(episode_of("so101", 0), embodiment="none")
        writer.add(episode, {view: np.full((N, 64, 96, 3), 90, np.uint8) for view in episode.cameras})
    with pytest.raises(
        DataError, match=r"unknown_embodiment\)[\s\S]*embodiment list[\s\S]*got: embodiment: none[\s\S]*Stage I"
    ):
        render_actions(CONFIG, {"episodes": tmp_path / "set"}, tmp_path / "tracks")


def test_input_is_needed(tmp_path):
    with pytest.raises(ConfigError, match="needs an EpisodeSet"):
        render_actions(CONFIG, {}, tmp_path)
