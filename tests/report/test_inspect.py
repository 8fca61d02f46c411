"""`worldline inspect`: verified artifacts, counts, the page with their pictures, and a filter's clips by reason."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from tests.report.conftest import EPISODES, sample  # pyright: ignore[reportMissingImports]
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.report.inspect import inspect
from worldline_core.store.artifact_files import write_manifest
from worldline_core.store.atomic import write_json_atomic


@pytest.mark.parametrize(
    ("name", "kind", "says", "pictures"),
    [
        ("curate", "EpisodeSet", "quarantine: 1", {"contact_sheet.jpg"}),
        ("rollout.shipped_causal", "RolloutSet", "method: shipped_causal 12", {"aloha_viperx-0_prediction.jpg"}),
        ("evaluate_video", "Scores", "robot_iou_exact", set()),
    ],
)  # fmt: skip
def test_kinds(
    run_artifacts: dict[str, Path], hostile_text: str, tmp_path: Path, name: str, kind: str, says: str, pictures: set[str]
) -> None:  # fmt: skip
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


def test_a_damaged_artifact_is_refused_before_it_is_read(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    folder = shutil.copytree(run_artifacts["curate"], tmp_path / "curate" / "key")
    write_manifest(folder, {"step": "curate"})
    found = inspect(folder)
    assert found.kind == "EpisodeSet"
    assert {path.relative_to(folder).parts[:2] for path in found.written} == {("run", "inspect")}
    (folder / "index.parquet").write_bytes((folder / "index.parquet").read_bytes()[:-9])
    with pytest.raises(ArtifactError, match=r"index\.parquet.*bytes"):
        inspect(folder)
    (folder / "index.parquet").unlink()
    with pytest.raises(ArtifactError, match=r"index\.parquet: missing"):
        inspect(folder)


def test_episodes_with_similar_names_get_different_files(tmp_path: Path) -> None:
    names = ("run 1", "run_1")
    with EpisodeSetWriter(tmp_path / "set") as writer:
        for name in names:
            episode, frames, *_ = sample(name, *EPISODES[0][1:])
            writer.add(episode, {"head": frames["head"]})
    one, two = (
        {path.name for path in inspect(tmp_path / "set", tmp_path / "out", episode_id=n).written} for n in names
    )
    assert one & two == {"index.html", "contact_sheet.jpg"}
    assert len(one - two) == len(two - one) == 1


def test_an_episode_is_shown_with_its_controls(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    folder, name = run_artifacts["render_actions"], "aloha_viperx-1"
    found = inspect(folder, tmp_path, episodes=run_artifacts["curate"], episode_id=name)
    assert (found.kind, [path.name for path in found.written]) == (
        "ActionTracks",
        ["index.html", f"{name}_controls.jpg"],
    )
    assert "6 episodes" in str(found)


def test_tracks_find_their_episodes_by_the_manifest(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    tracks = shutil.copytree(run_artifacts["render_actions"], tmp_path / "render_actions" / "key")
    without = inspect(tracks)
    assert [path.name for path in without.written] == ["index.html"]
    assert "--episodes FOLDER" in str(without)
    with pytest.raises(ArtifactError, match="--episodes FOLDER"):
        inspect(tracks, episode_id="aloha_viperx-0")
    shutil.copytree(run_artifacts["curate"], tmp_path / "curate" / "key")
    write_json_atomic(tracks / "manifest.json", {"inputs": {"episodes": {"path": "curate/key", "digest": "0"}}})
    assert "aloha_viperx-0_controls.jpg" in {path.name for path in inspect(tracks).written}


def test_without_kinematics_the_page_notes_it(tmp_path: Path) -> None:
    with EpisodeSetWriter(tmp_path / "set") as writer:
        writer.add(*sample("e", "no_such_robot", *EPISODES[0][2:])[:2])
    found = inspect(tmp_path / "set", tmp_path, episode_id="e")
    assert "no controls are shown" in (tmp_path / "index.html").read_text()
    assert [path.suffix for path in found.written] == [".html", ".jpg"]


def test_predictions_are_shown_beside_the_truth(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    folder, episodes = run_artifacts["rollout.shipped_causal"], run_artifacts["curate"]
    found = inspect(folder, tmp_path, episodes=episodes, episode_id="aloha_viperx-2")
    assert "aloha_viperx-2_prediction.jpg" in {path.name for path in found.written}
    for name in ("nobody", "ur5e_pair-0"):  # the second one was recorded, but not predicted
        with pytest.raises(DataError, match=name):
            inspect(folder, tmp_path, episodes=episodes, episode_id=name)
    alone = inspect(folder, tmp_path / "alone")
    assert [path.name for path in alone.written] == ["index.html"]
    assert "--episodes FOLDER" in str(alone)


def test_unknown_episodes_kinds_and_folders_are_refused(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nobody"):
        inspect(run_artifacts["curate"], tmp_path, episode_id="nobody")
    with pytest.raises(ConfigError, match="Scores"):
        inspect(run_artifacts["evaluate_video"], tmp_path, episode_id="e")
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(ArtifactError, match=r"notes\.txt"):
        inspect(tmp_path)
    with pytest.raises(ArtifactError, match="absent"):
        inspect(tmp_path / "absent")


CONFIG = FilterConfig(min_segment_frames=8)


@pytest.fixture(scope="module")
def filtered(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of one recording: healthy, dark in the middle, and black throughout."""
    root = tmp_path_factory.mktemp("artifacts")
    episodes = EpisodeSet.open(project_root / "artifacts" / "shipped" / "recordings")
    i = episodes.position("ur5e_silver-test-s1-00002")
    episode = episodes.episode(i)
    frames = episodes.frames(i, "head")
    dark = frames.copy()
    dark[12:18] = dark[12:18] // 16
    with EpisodeSetWriter(root / "curate" / "key") as writer:
        for name, shown in (("healthy", frames), ("dark", dark), ("black", frames // 16)):
            writer.add(replace(episode, episode_id=name), {"head": shown})
    folder = root / "filter" / "key"
    filter_episodes(CONFIG, {"episodes": root / "curate" / "key"}, folder)
    inputs = {"episodes": {"path": "curate/key", "digest": "0"}}
    write_json_atomic(folder / "manifest.json", {"config": CONFIG.model_dump(mode="json"), "inputs": inputs})
    return folder


def test_a_page_shows_dropped_and_cut_clips_by_reason(filtered: Path, tmp_path: Path) -> None:
    names = {path.name for path in inspect(filtered, tmp_path).written}
    assert {"reason_too_dark.jpg", "contact_sheet.jpg"} <= names
    with Image.open(tmp_path / "reason_too_dark.jpg") as image:
        assert image.width > 600
        assert image.height > 2 * 96  # black was dropped, of dark some frames
    (filtered / "manifest.json").rename(tmp_path / "manifest.json")
    try:
        assert "dropped clips are not shown" in str(inspect(filtered, tmp_path / "out"))
    finally:
        (tmp_path / "manifest.json").rename(filtered / "manifest.json")


def test_an_episode_of_a_filtered_set_is_shown_with_what_was_decided(filtered: Path, tmp_path: Path) -> None:
    def written(name: str) -> list[str]:
        return [path.name for path in inspect(filtered, tmp_path, episode_id=name).written]

    assert written("healthy") == ["index.html", "contact_sheet.jpg", "healthy_controls.jpg"]
    assert written("black") == written("dark") == ["index.html", "reason_too_dark.jpg"]
    assert any(name.startswith("dark_00018") and name.endswith("_controls.jpg") for name in written("dark@00018"))
    with pytest.raises(DataError, match="nobody"):
        inspect(filtered, tmp_path, episode_id="nobody")
