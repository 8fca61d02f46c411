"""WorldArena's track 1 from its set to its archive: recordings, predictions, the archive, read back and measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.data.curating import run
from tests.data.test_source_worldarena import HEIGHT, TASK, WIDTH, T, settings, write_track_1
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.clip import video_size
from worldline_core.errors import DataError
from worldline_core.evaluation.evaluation_config import VideoEvaluationConfig
from worldline_core.evaluation.video.evaluate_video import evaluate_video
from worldline_core.exports.export import export_worldarena_archive
from worldline_core.rollout.import_rollouts import import_rollouts
from worldline_core.rollout.rollout_config import ImportRolloutsConfig
from worldline_core.rollout.rollout_set import RolloutSet, RolloutSetWriter

NUMBERS = (1, 12)


def recorded(root: Path, *numbers: int, scale: int = 1) -> EpisodeSet:
    for number in numbers:
        write_track_1(root / "raw", number, scale=scale)
    return run(root, settings(root / "raw"))[1]


def predicted(root: Path, episodes: EpisodeSet, method: str, change: Any = lambda frames: frames) -> RolloutSet:
    writer = RolloutSetWriter(root, method, 24.0)
    for position, row in enumerate(episodes.rows):
        writer.add(row.episode_id, 42, {"head": change(episodes.frames(position, "head"))})
    writer.close()
    return RolloutSet.open(root)


@pytest.mark.slow
def test_an_archive_is_read_back_and_measured(tmp_path: Path) -> None:
    episodes = recorded(tmp_path, *NUMBERS, scale=10)
    for method in ("ours_v2_test", "ours_v2_test_1", "ours_v2_10data"):
        rollouts = predicted(tmp_path / method, episodes, method)
        export_worldarena_archive(rollouts, episodes, rollouts.episode_ids, tmp_path)
    archive = tmp_path / "ours_v2_eval"
    assert sorted(str(path.relative_to(archive)) for path in archive.rglob("*") if path.is_file()) == sorted(
        ["model_README.md"]
        + [f"ours_v2_{part}/episode{number}.mp4" for part in ("test", "test_1") for number in NUMBERS]
        + [f"ours_v2_10data/{TASK}_episode{number}.mp4" for number in NUMBERS]
    )
    assert video_size(archive / "ours_v2_test/episode12.mp4") == (480, 640, 24.0)
    assert "Model name**: ours_v2" in (archive / "model_README.md").read_text()
    for part in ("test", "10data"):
        inputs = {"videos": archive / f"ours_v2_{part}", "episodes": episodes.root}
        config = ImportRolloutsConfig.model_validate({"method": "theirs", "layout": "worldarena"})
        import_rollouts(config, inputs, tmp_path / "read" / part)
        found = RolloutSet.open(tmp_path / "read" / part)
        for position, row in enumerate(episodes.rows):
            difference = found.frames(row.episode_id, "head").astype(int) - episodes.frames(position, "head")
            assert np.abs(difference).mean() < 3
    measured = {"episodes": episodes.root, "rollouts.theirs": tmp_path / "read/test"}
    evaluate_video(VideoEvaluationConfig.model_validate({"views": ["head"]}), measured, tmp_path / "scores")
    scores = pq.read_table(tmp_path / "scores/scores.parquet").to_pylist()
    assert {"psnr", "ssim"} <= {score["metric"] for score in scores}


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> EpisodeSet:
    return recorded(tmp_path_factory.mktemp("small"), 1)


def enlarged(frames: np.ndarray, factor: int = 10) -> np.ndarray:
    return frames.repeat(factor, axis=1).repeat(factor, axis=2)


@pytest.mark.parametrize(
    ("method", "change", "match"),
    [
        ("ours", lambda f: f, r"(?s)named by its sets.*MODEL_test"),
        (
            "ours_test",
            lambda f: enlarged(f)[:-1],
            rf"(?s)Not the length.*{T} \(its trajectory\), or 121.*{T - 1} frames",
        ),
        ("ours_test", lambda f: enlarged(f, 5), r"(?s)Not the pictures.*640 x 480.*320 x 240"),
        ("ours_test", lambda f: enlarged(f)[:, :, :480], r"(?s)Not the pictures.*480 x 480"),
    ],
)
def test_what_worldarena_does_not_take_is_not_archived(
    small: EpisodeSet, tmp_path: Path, method: str, change: Any, match: str
) -> None:
    rollouts = predicted(tmp_path / "set", small, method, change)
    with pytest.raises(DataError, match=match):
        export_worldarena_archive(rollouts, small, rollouts.episode_ids, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_episode_of_another_set_is_not_archived(small: EpisodeSet, tmp_path: Path) -> None:
    writer = RolloutSetWriter(tmp_path, "ours_test", 24.0)
    writer.add("lift-the-cube", 42, {"head": np.zeros((T, HEIGHT, WIDTH, 3), np.uint8)})
    writer.close()
    with pytest.raises(DataError, match=r"(?s)Not a prediction of an episode of WorldArena.*kind: worldarena"):
        export_worldarena_archive(RolloutSet.open(tmp_path), small, ["lift-the-cube"], tmp_path / "out")
