"""Export of one prediction from artifacts on disk."""

from __future__ import annotations

from pathlib import Path

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.exports.rollout import export_rollout
from worldline_core.rollout.rollout_set import RolloutSet


def test_a_prediction_is_exported_in_every_format(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    rollouts = RolloutSet.open(run_artifacts["rollout.shipped_causal"])
    episodes = EpisodeSet.open(run_artifacts["curate"])
    tracks = ActionTracks.open(run_artifacts["render_actions"])
    written = export_rollout(rollouts, episodes, tracks, "aloha_viperx-1", tmp_path)
    assert sorted(path.suffix for path in written) == [".jpg"] * 3 + [".mcap"] + [".mp4"] * 3 + [".rrd"]
    assert all(path.stat().st_size > 500 for path in written)
