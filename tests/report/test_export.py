"""Export of one prediction from artifacts on disk."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.clip import decode_video
from worldline_core.errors import ArtifactError, DataError
from worldline_core.exports.export import export, export_worldarena
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.store.artifact_files import write_manifest


@pytest.mark.slow
def test_a_prediction_is_exported_in_every_format(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    folder = shutil.copytree(run_artifacts["rollout.shipped_causal"], tmp_path / "set")
    inputs = {"episodes": run_artifacts["curate"], "tracks": run_artifacts["render_actions"]}
    facts = {name: {"path": str(path.resolve()), "digest": "1"} for name, path in inputs.items()}
    write_manifest(folder, {"step": "rollout", "inputs": facts})
    written = export(folder, tmp_path / "out", ["mp4", "rrd", "mcap"], episode_ids=["aloha_viperx-1"])
    assert sorted(path.suffix for path in written) == [".jpg"] * 3 + [".mcap"] + [".mp4"] * 3 + [".rrd"]
    assert all(path.stat().st_size > 500 for path in written)


def test_predictions_are_exported_in_the_layout_of_worldarena(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    folder = run_artifacts["rollout.shipped_causal"]
    rollouts = RolloutSet.open(folder)
    with pytest.raises(DataError, match=r"(?s)No prediction of this episode.*none"):
        export(folder, tmp_path, ["worldarena"], episode_ids=["none"], episodes=run_artifacts["curate"])
    written = export(folder, tmp_path, ["worldarena"], episodes=run_artifacts["curate"])
    ids = json.loads((tmp_path / "episodes.json").read_text())
    assert sorted(ids.values()) == sorted(rollouts.episode_ids)
    videos = tmp_path / f"{rollouts.method}_sort"
    assert {path.name for path in videos.iterdir()} == {f"{n}.mp4" for n in ids}
    summary = json.loads((tmp_path / "summary.json").read_text())
    for entry, (stem, name) in zip(summary, ids.items(), strict=True):
        assert re.fullmatch(r"lift_episode_\d+", stem)
        predicted = decode_video(videos / f"{stem}.mp4")
        np.testing.assert_array_equal(predicted, rollouts.frames(name, "head"))
        assert len(decode_video(Path(entry["gt_path"]))) == len(predicted)
        assert Path(entry["image"]).read_bytes().startswith(b"\x89PNG")
        assert list(entry) == ["gt_path", "image", "prompt"]
    assert set(written) == {path for path in tmp_path.rglob("*") if path.is_file() and not path.name.startswith(".")}


@pytest.mark.parametrize(
    ("column", "value", "match"),
    [
        ("fps", 1e6, "Another rate"),  # its first frame was shown again and again
        ("num_frames", 10**9, "Longer than its recording"),
        ("path", "gone.mp4", "is missing"),
        ("path", "videos", "no regular file"),
        ("path", "index.parquet", "no video container"),
        ("path", "a\0b", "outside"),
    ],
)
def test_predictions_that_do_not_fit_or_are_no_videos_are_refused(
    run_artifacts: dict[str, Path], tmp_path: Path, column: str, value: float | str, match: str
) -> None:
    folder = shutil.copytree(run_artifacts["rollout.shipped_causal"], tmp_path / "rollout")
    rows = [{**row, column: value} for row in pq.read_table(folder / "index.parquet").to_pylist()]
    pq.write_table(pa.Table.from_pylist(rows), folder / "index.parquet")
    rollouts, episodes = RolloutSet.open(folder), EpisodeSet.open(run_artifacts["curate"])
    with pytest.raises((DataError, ArtifactError), match=match):
        export_worldarena(rollouts, episodes, rollouts.episode_ids[:1], tmp_path / "out")
    assert not list((tmp_path / "out").rglob("*.mp4"))
