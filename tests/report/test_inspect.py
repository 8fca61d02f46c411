"""`worldline inspect`: verified artifacts, counts, the page with their pictures, and a filter's clips by reason."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.report.conftest import EPISODES, sample  # pyright: ignore[reportMissingImports]
from worldline_core.actions.overlays import ARM_COLOURS
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.data.video.clip import decode_video
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.report.inspect import KEPT_COLOUR, LOST_COLOUR, clips_by_reason, episode_of, inspect
from worldline_core.store.artifact_files import write_manifest
from worldline_core.store.atomic import write_json_atomic


@pytest.mark.parametrize(
    ("name", "kind", "says", "pictures"),
    [
        ("curate", "EpisodeSet", "quarantine: 1", {"contact_sheet.jpg"}),
        ("render_actions", "ActionTracks", "6 episodes", {"aloha_viperx-0_controls.jpg"}),
        ("rollout.shipped_causal", "RolloutSet", "method: shipped_causal 12", {"contact_sheet.jpg", "aloha_viperx-0_prediction.jpg"}),
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
            writer.add(*sample(name, *EPISODES[0][1:])[:2])
    one, two = (
        {path.name for path in inspect(tmp_path / "set", tmp_path / "out", episode_id=n).written} for n in names
    )
    assert one & two == {"index.html", "contact_sheet.jpg"}
    assert len(one - two) == len(two - one) == 1


def test_an_episode_is_shown_with_its_controls(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    folder, name = run_artifacts["render_actions"], "aloha_viperx-1"
    found = inspect(folder, tmp_path, episodes=run_artifacts["curate"], episode_id=name, video=True)
    assert [path.name for path in found.written] == ["index.html", f"{name}_controls.jpg", f"{name}.mp4"]
    video = decode_video(tmp_path / f"{name}.mp4")
    assert len(video) == 9
    assert video.shape[2] > 3 * 256  # three views side by side
    assert np.abs(video[0].astype(int) - video[-1]).max() > 100


def test_tracks_find_their_episodes_by_the_manifest(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    tracks = shutil.copytree(run_artifacts["render_actions"], tmp_path / "render_actions" / "key")
    without = inspect(tracks)
    assert [path.name for path in without.written] == ["index.html"]
    assert "--episodes FOLDER" in str(without)
    with pytest.raises(ArtifactError, match="--episodes FOLDER"):
        inspect(tracks, video=True)
    shutil.copytree(run_artifacts["curate"], tmp_path / "curate" / "key")
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


def test_without_kinematics_the_page_notes_it(tmp_path: Path) -> None:
    with EpisodeSetWriter(tmp_path / "set") as writer:
        writer.add(*sample("e", "no_such_robot", *EPISODES[0][2:])[:2])
    found = inspect(tmp_path / "set", tmp_path, episode_id="e")
    assert "no controls are shown" in (tmp_path / "index.html").read_text()
    assert [path.suffix for path in found.written] == [".html", ".jpg"]


def test_predictions_are_shown_beside_the_truth(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    folder, episodes = run_artifacts["rollout.shipped_causal"], run_artifacts["curate"]
    found = inspect(folder, tmp_path, episodes=episodes, episode_id="aloha_viperx-2", video=True)
    assert "aloha_viperx-2_head.mp4" in {path.name for path in found.written}
    for name in ("nobody", "ur5e_pair-0"):  # the second one was recorded, but not predicted
        with pytest.raises(DataError, match=name):
            inspect(folder, tmp_path, episodes=episodes, episode_id=name)
    alone = inspect(folder, tmp_path / "alone")
    assert [path.name for path in alone.written] == ["index.html", "contact_sheet.jpg"]
    with Image.open(tmp_path / "alone" / "contact_sheet.jpg") as picture:
        assert picture.width > 300


def test_unknown_episodes_kinds_and_folders_are_refused(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nobody"):
        inspect(run_artifacts["curate"], tmp_path, episode_id="nobody")
    with pytest.raises(ConfigError, match="Scores"):
        inspect(run_artifacts["evaluate_video"], tmp_path, video=True)
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(ArtifactError, match=r"notes\.txt"):
        inspect(tmp_path)
    with pytest.raises(ArtifactError, match="absent"):
        inspect(tmp_path / "absent")


CONFIG = FilterConfig(min_segment_frames=8)


@pytest.fixture(scope="module")
def filtered(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four episodes of one recording: healthy, dark in the middle, black throughout, and with a camera turned about."""
    root = tmp_path_factory.mktemp("artifacts")
    episodes = EpisodeSet.open(project_root / "artifacts" / "shipped" / "recordings")
    i = episodes.position("ur5e_silver-test-s1-00002")
    episode = episodes.episode(i)
    frames = {view: episodes.frames(i, view) for view in episodes.rows[i].views}
    dark = frames["head"].copy()
    dark[12:18] = dark[12:18] // 16
    head = episode.cameras["head"]
    turned = episode.cameras | {"head": replace(head, T_base_camera=np.linalg.inv(head.T_base_camera))}
    with EpisodeSetWriter(root / "curate" / "key") as writer:
        writer.add(replace(episode, episode_id="healthy"), frames)
        writer.add(replace(episode, episode_id="dark"), {**frames, "head": dark})
        writer.add(replace(episode, episode_id="black"), {**frames, "head": frames["head"] // 16})
        writer.add(replace(episode, episode_id="turned", cameras=turned), frames)
    folder = root / "filter" / "key"
    filter_episodes(CONFIG, {"episodes": root / "curate" / "key"}, folder)
    inputs = {"episodes": {"path": "curate/key", "digest": "0"}}
    write_json_atomic(folder / "manifest.json", {"config": CONFIG.model_dump(mode="json"), "inputs": inputs})
    return folder


def test_every_clip_stands_under_its_reasons(filtered: Path) -> None:
    found = clips_by_reason(filtered)
    assert (next(iter(found)), list(found)[-1], set(found["kept"])) == ("too_dark", "kept", {"healthy"})
    decisions = {name: clip.decision for name, clip in found["too_dark"].items()}
    assert decisions == {"black": "dropped whole", "dark": "6 frames cut"}
    assert "threshold bright level" in found["too_dark"]["dark"].numbers
    assert "turned" in {name for reason, clips in found.items() if reason != "kept" for name in clips}
    assert [len(found["too_dark"][name].kept) for name in ("black", "dark")] == [0, 2]
    assert [episode_of(name) for name in ("a@00012", "a@b", "a", "a@b@00001")] == ["a", "a@b", "a", "a@b"]


def test_a_page_shows_kept_and_dropped_clips(filtered: Path, tmp_path: Path) -> None:
    pictures = [path for path in inspect(filtered, tmp_path).written if path.name.startswith("reason_")]
    html = (tmp_path / "index.html").read_text()
    assert "4 segments of 4 episodes were kept" in html
    assert "2 episodes, 1 dropped whole" in html
    assert {"reason_too_dark.jpg", "reason_kept.jpg"} <= {path.name for path in pictures}
    for path in pictures:
        assert f'src="{path.name}"' in html
        with Image.open(path) as image:
            assert image.width > 800
    (filtered / "manifest.json").rename(tmp_path / "manifest.json")
    try:
        assert "dropped clips are not shown" in str(inspect(filtered, tmp_path / "out"))
    finally:
        (tmp_path / "manifest.json").rename(filtered / "manifest.json")


def test_the_timeline_has_the_dropped_frames_at_their_place(filtered: Path, tmp_path: Path) -> None:
    result = inspect(filtered, tmp_path, episode_id="dark")
    assert [path.name for path in result.written] == ["index.html", "reason_dark_too_dark.jpg"]
    with Image.open(tmp_path / "reason_dark_too_dark.jpg") as image:
        picture = np.asarray(image.convert("RGB"))
    row = next(r for r in picture if (np.abs(r.astype(int) - KEPT_COLOUR).max(axis=-1) < 8).mean() > 0.6)
    dropped = np.flatnonzero(np.abs(row.astype(int) - LOST_COLOUR).max(axis=-1) < 8)
    width = len(row) - 24
    assert abs((dropped[0] - 12) / width - 12 / 33) < 0.02
    assert abs((dropped[-1] - 12) / width - 18 / 33) < 0.02


def test_a_kept_episode_is_shown_with_its_controls_as_well(filtered: Path, tmp_path: Path) -> None:
    names = [path.name for path in inspect(filtered, tmp_path, episode_id="healthy").written]
    assert {"reason_healthy_kept.jpg", "contact_sheet.jpg", "healthy_controls.jpg"} <= set(names)
    segment = [path.name for path in inspect(filtered, tmp_path, episode_id="dark@00018").written]
    assert "reason_dark_too_dark.jpg" in segment
    assert any(name.startswith("dark_00018") and name.endswith("_controls.jpg") for name in segment)
    black = [path.name for path in inspect(filtered, tmp_path, episode_id="black").written]
    assert black == ["index.html", "reason_black_too_dark.jpg"]
    with pytest.raises(DataError, match="nobody"):
        inspect(filtered, tmp_path, episode_id="nobody")
