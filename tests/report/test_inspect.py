"""`worldline inspect`: verified artifacts, counts, and the page with their pictures."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from tests.report.conftest import EPISODES, episode, frames  # pyright: ignore[reportMissingImports]
from worldline_core.actions.overlays import ARM_COLOURS
from worldline_core.data.episodes.episode_set import EpisodeSetWriter
from worldline_core.data.video.clip import decode_video
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.report.inspect import inspect
from worldline_core.store.artifact_files import write_manifest
from worldline_core.store.atomic import write_json_atomic


@pytest.mark.parametrize(
    ("name", "kind", "says", "pictures"),
    [
        ("curate", "EpisodeSet", "quarantine: 1", {"contact_sheet.jpg"}),
        ("render_actions", "ActionTracks", "6 episodes", {"aloha_viperx-0_controls.jpg"}),
        (
            "rollout.shipped_causal",
            "RolloutSet",
            "method: shipped_causal 12",
            {"contact_sheet.jpg", "aloha_viperx-0_prediction.jpg"},
        ),
        ("evaluate_video", "Scores", "robot_iou_exact", set()),
    ],
)
def test_kinds(
    run_artifacts: dict[str, Path],
    hostile_text: str,
    tmp_path: Path,
    name: str,
    kind: str,
    says: str,
    pictures: set[str],
) -> None:
    found = inspect(run_artifacts[name], tmp_path, episodes=run_artifacts["curate"])
    assert found.kind == kind
    assert says in str(found)
    assert {path.name for path in found.written} >= pictures
    assert (tmp_path / "index.html").is_file() == bool(pictures)
    if pictures:
        page = (tmp_path / "index.html").read_text()
        assert says in page
        assert hostile_text not in page
        assert all(f'"{name}"' in page for name in pictures)


def test_the_page_goes_to_run_by_default(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    folder = tmp_path / "set"
    shutil.copytree(run_artifacts["curate"], folder)
    assert {path.relative_to(folder).parts[:2] for path in inspect(folder).written} == {("run", "inspect")}


def test_a_damaged_artifact_is_refused_before_it_is_read(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    folder = tmp_path / "curate" / "key"
    shutil.copytree(run_artifacts["curate"], folder)
    write_manifest(folder, {"step": "curate"})
    assert inspect(folder).kind == "EpisodeSet"
    (folder / "index.parquet").write_bytes((folder / "index.parquet").read_bytes()[:-9])
    with pytest.raises(ArtifactError, match=r"index\.parquet.*bytes"):
        inspect(folder)
    (folder / "index.parquet").unlink()
    with pytest.raises(ArtifactError, match=r"index\.parquet: missing"):
        inspect(folder)


def test_episodes_with_similar_names_get_different_files(tmp_path: Path) -> None:
    with EpisodeSetWriter(tmp_path / "set") as writer:
        for name in ("run 1", "run_1"):
            writer.add(episode(name, *EPISODES[0][1:]), frames(0))
    names = [
        {path.name for path in inspect(tmp_path / "set", tmp_path / "out", episode_id=name, video=True).written}
        for name in ("run 1", "run_1")
    ]
    assert names[0] & names[1] == {"index.html", "contact_sheet.jpg"}
    assert all(any(name.endswith(".mp4") for name in found) for found in names)


def test_an_episode_is_shown_with_its_controls(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    folder, name = run_artifacts["render_actions"], "aloha_viperx-1"
    found = inspect(folder, tmp_path, episodes=run_artifacts["curate"], episode_id=name, video=True)
    assert [path.name for path in found.written] == ["index.html", f"{name}_controls.jpg", f"{name}.mp4"]
    video = decode_video(tmp_path / "aloha_viperx-1.mp4")
    assert len(video) == 9
    assert video.shape[2] > 3 * 256  # three views side by side
    assert np.abs(video[0].astype(int) - video[-1]).max() > 100


def test_tracks_find_their_episodes_by_the_manifest(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    tracks, episodes = tmp_path / "render_actions" / "key", tmp_path / "curate" / "key"
    shutil.copytree(run_artifacts["render_actions"], tracks)
    without = inspect(tracks)
    assert [path.name for path in without.written] == ["index.html"]
    assert "--episodes FOLDER" in str(without)
    with pytest.raises(ArtifactError, match="--episodes FOLDER"):
        inspect(tracks, video=True)
    shutil.copytree(run_artifacts["curate"], episodes)
    write_json_atomic(tracks / "manifest.json", {"inputs": {"episodes": {"path": "curate/key", "digest": "0"}}})
    assert "aloha_viperx-0_controls.jpg" in {path.name for path in inspect(tracks).written}


@pytest.mark.slow
def test_an_episode_set_is_shown_with_tracks_of_its_commands(project_root: Path, tmp_path: Path) -> None:
    name = "ur5e_silver-test-s1-00000"
    inspect(project_root / "artifacts/shipped/recordings", tmp_path, episode_id=name, video=True)
    video = decode_video(tmp_path / f"{name}.mp4")
    # The left arm's colour is nowhere in a recording, and in every frame of the overlay.
    orange = (np.abs(video.astype(int) - ARM_COLOURS["left"]).max(axis=-1) < 40).sum(axis=(1, 2))
    assert orange.min() > 100


def test_without_kinematics_the_page_notes_it(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    folder = tmp_path / "set"
    shutil.copytree(run_artifacts["curate"], folder, ignore=shutil.ignore_patterns("manifest.json"))
    index = pq.read_table(folder / "index.parquet")
    robots = pa.array(["no_such_robot"] * index.num_rows)
    index = index.set_column(index.column_names.index("embodiment"), "embodiment", robots)
    pq.write_table(index, folder / "index.parquet")
    found = inspect(folder, tmp_path, episode_id="aloha_viperx-0")
    assert "no controls are shown" in (tmp_path / "index.html").read_text()
    assert [path.suffix for path in found.written] == [".html", ".jpg"]


def test_predictions_are_shown_beside_the_truth(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    folder = run_artifacts["rollout.shipped_causal"]
    found = inspect(folder, tmp_path, episodes=run_artifacts["curate"], episode_id="aloha_viperx-2", video=True)
    names = [path.name for path in found.written]
    assert "aloha_viperx-2_head.mp4" in names
    for name in ("nobody", "ur5e_pair-0"):  # the second one was recorded, but not predicted
        with pytest.raises(DataError, match=name):
            inspect(folder, tmp_path, episodes=run_artifacts["curate"], episode_id=name)
    alone = inspect(folder, tmp_path / "alone")
    assert [path.name for path in alone.written] == ["index.html", "contact_sheet.jpg"]
    with Image.open(tmp_path / "alone" / "contact_sheet.jpg") as picture:
        assert picture.width > 300


def test_unknown_episodes_and_kinds_without_pictures_are_refused(
    run_artifacts: dict[str, Path], tmp_path: Path
) -> None:
    with pytest.raises(DataError, match="nobody"):
        inspect(run_artifacts["curate"], tmp_path, episode_id="nobody")
    with pytest.raises(ConfigError, match="Scores"):
        inspect(run_artifacts["evaluate_video"], tmp_path, video=True)


def test_unknown_folders_are_named(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(ArtifactError, match=r"notes\.txt"):
        inspect(tmp_path)
    with pytest.raises(ArtifactError, match="absent"):
        inspect(tmp_path / "absent")
