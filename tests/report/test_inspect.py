"""Inspection tells what an artifact is and shows it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image
from rerun.chunk import RrdReader

from worldline_core.actions.overlays import ARM_COLOURS
from worldline_core.data.video.frame_decoder import decode_video
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.report.inspect import inspect
from worldline_core.store.atomic import write_json_atomic


@pytest.mark.parametrize(
    ("name", "kind", "says", "pictures"),
    [
        ("curate", "EpisodeSet", "quarantine: 1", True),
        ("render_actions", "ActionTracks", "6 episodes", True),
        ("rollout.shipped_causal", "RolloutSet", "method: shipped_causal 12", True),
        ("evaluate_video", "Scores", "robot_iou_exact", False),
    ],
)
def test_kinds(run_artifacts: dict[str, Path], tmp_path: Path, name: str, kind: str, says: str, pictures: bool) -> None:
    found = inspect(run_artifacts[name], tmp_path, episodes=run_artifacts["curate"])
    assert found.kind == kind
    assert says in str(found)
    assert (tmp_path / "contact_sheet.png").is_file() == pictures
    if pictures:
        with Image.open(tmp_path / "contact_sheet.png") as picture:
            assert picture.width > 300


def test_report_is_recognised(full_report: Path, tmp_path: Path) -> None:
    assert inspect(full_report, tmp_path).kind == "Report"


def test_pictures_go_to_run_by_default(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    folder = tmp_path / "set"
    shutil.copytree(run_artifacts["curate"], folder)
    found = inspect(folder, rerun=True)
    assert [path.relative_to(folder).parts[0] for path in found.written] == ["run", "run"]
    assert found.written[1].suffix == ".rrd"


def test_an_episode_is_shown_with_its_controls(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    found = inspect(
        run_artifacts["render_actions"],
        tmp_path,
        episodes=run_artifacts["curate"],
        episode_id="aloha_viperx-1",
        video=True,
        rerun=True,
    )
    assert [path.name for path in found.written] == ["contact_sheet.png", "aloha_viperx-1.mp4", "aloha_viperx-1.rrd"]
    video = decode_video(tmp_path / "aloha_viperx-1.mp4")
    assert len(video) == 9
    assert video.shape[2] > 3 * 256  # three views side by side
    assert np.abs(video[0].astype(int) - video[-1]).max() > 100
    entities = {chunk.entity_path for chunk in RrdReader(tmp_path / "aloha_viperx-1.rrd").stream()}
    assert {"/world/cameras/head/points", "/world/cameras/head/axes", "/world/cameras/head/actions"} <= entities


def test_tracks_find_their_episodes_by_the_manifest(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    tracks, episodes = tmp_path / "render_actions" / "key", tmp_path / "curate" / "key"
    shutil.copytree(run_artifacts["render_actions"], tracks)
    without = inspect(tracks)
    assert without.written == []
    assert "--episodes FOLDER" in str(without)
    with pytest.raises(ArtifactError, match=r"(?s)belongs to are not known.*--episodes FOLDER"):
        inspect(tracks, video=True)
    shutil.copytree(run_artifacts["curate"], episodes)
    write_json_atomic(tracks / "manifest.json", {"inputs": {"episodes": {"path": "curate/key", "digest": "0"}}})
    assert [path.name for path in inspect(tracks).written] == ["contact_sheet.png"]


@pytest.mark.slow
def test_an_episode_set_is_shown_with_tracks_of_its_commands(project_root: Path, tmp_path: Path) -> None:
    name = "ur5e_silver-test-s1-00000"
    found = inspect(project_root / "artifacts/shipped/recordings", tmp_path, episode_id=name, video=True)
    assert [path.name for path in found.written] == ["contact_sheet.png", f"{name}.mp4"]
    video = decode_video(tmp_path / f"{name}.mp4")
    # The left arm's colour is nowhere in a recording, and in every frame of the overlay.
    orange = (np.abs(video.astype(int) - ARM_COLOURS["left"]).max(axis=-1) < 40).sum(axis=(1, 2))
    assert orange.min() > 100


def test_without_kinematics_frames_are_shown_and_it_is_said(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    folder = tmp_path / "set"
    shutil.copytree(run_artifacts["curate"], folder)
    index = pq.read_table(folder / "index.parquet")
    robots = pa.array(["no_such_robot"] * index.num_rows)
    index = index.set_column(index.column_names.index("embodiment"), "embodiment", robots)
    pq.write_table(index, folder / "index.parquet")
    found = inspect(folder, tmp_path, episode_id="aloha_viperx-0", rerun=True)
    assert "no controls are drawn" in str(found)
    assert "the recording has no controls in 3-D" in str(found)
    assert [path.suffix for path in found.written] == [".png", ".rrd"]
    with pytest.raises(ConfigError, match="no_such_robot"):
        inspect(folder, tmp_path, video=True)


@pytest.mark.slow
def test_the_page_shows_each_episode_or_says_why_not(
    run_artifacts: dict[str, Path], hostile_text: str, tmp_path: Path
) -> None:
    tracks = tmp_path / "tracks"
    shutil.copytree(run_artifacts["render_actions"], tracks)
    index = pq.read_table(tracks / "index.parquet")
    pq.write_table(index.slice(1), tracks / "index.parquet")
    missing = index["episode_id"][0].as_py()
    found = inspect(tracks, tmp_path / "out", episodes=run_artifacts["curate"], page=0)
    assert found.written[-1] == tmp_path / "out" / "page" / "index.html"
    html = found.written[-1].read_text()
    assert "6 of 6 episodes" in html
    assert hostile_text not in html
    assert "No action tracks of this episode" in html
    videos = sorted((tmp_path / "out" / "page" / "videos").iterdir())
    assert len(videos) == html.count("<video") == 5
    assert missing not in {path.stem for path in videos}


def test_predictions_are_shown_beside_the_truth(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    folder = run_artifacts["rollout.shipped_causal"]
    found = inspect(
        folder, tmp_path, episodes=run_artifacts["curate"], episode_id="aloha_viperx-2", video=True, rerun=True
    )
    names = [path.name for path in found.written]
    assert names[0] == "contact_sheet.png"
    assert "aloha_viperx-2_head.mp4" in names
    assert names[-1] == "aloha_viperx-2.rrd"
    with pytest.raises(DataError, match=r"(?s)No prediction of this episode.*nobody"):
        inspect(folder, tmp_path, episode_id="nobody")


def test_unknown_episodes_and_kinds_without_pictures_are_refused(
    run_artifacts: dict[str, Path], tmp_path: Path
) -> None:
    with pytest.raises(DataError, match=r"(?s)No such episode.*nobody"):
        inspect(run_artifacts["curate"], tmp_path, episode_id="nobody")
    with pytest.raises(ConfigError, match=r"(?s)no pictures of this kind.*Scores"):
        inspect(run_artifacts["evaluate_video"], tmp_path, video=True)


def test_unknown_folders_are_named(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(ArtifactError, match=r"(?s)known kind.*notes\.txt"):
        inspect(tmp_path)
    with pytest.raises(ArtifactError, match="No such artifact"):
        inspect(tmp_path / "absent")
