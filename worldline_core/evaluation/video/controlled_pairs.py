"""Predictions of one start under true and under changed controls, compared: do the videos follow the controls?"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from worldline_core.actions.changed_controls import changed_tracks
from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation.evaluation_config import VideoEvaluationConfig
from worldline_core.evaluation.metric_registry import requested
from worldline_core.evaluation.recordings import HEAD, stride_of, tool_points
from worldline_core.evaluation.video.tool_paths import ControlledPair
from worldline_core.rollout.rollout_set import RolloutSet

Measured = tuple[str, EpisodeRow, dict[str, Any]]
"""A method, an episode, and what was measured of its predictions."""


def check_changed_controls(config: VideoEvaluationConfig, methods: Sequence[str]) -> None:
    """Raises ConfigError where a method of ``changed_controls`` was not predicted."""
    named = {name for method, changes in config.changed_controls.items() for name in (method, *changes.values())}
    if missing := sorted(named - set(methods)):
        raise ConfigError(
            "Methods of evaluate_video.changed_controls were not predicted", expected=f"some of {sorted(methods)}",
            got=missing, next_step="add them to rollouts (actions: mirrored, delayed or shuffled), or leave them out",
        )  # fmt: skip


def controlled_values(
    config: VideoEvaluationConfig, records: Sequence[Measured], tracks: ActionTracks, rollouts: Mapping[str, RolloutSet]
) -> Iterator[tuple[str, EpisodeRow, int, str, float]]:
    """(method, episode, seed, ``metric[change]``, value) of every pair of predictions of the head view.

    Raises: DataError when both were not predicted at one rate.
    """
    metrics = {name: m for name, m in requested(config.metrics).items() if m.needs == "changed_controls"}
    tools: dict[tuple[str, str], dict[int, np.ndarray]] = {}
    for method, row, content in records:
        found = {
            item["seed"]: np.array(item["tools"], dtype=np.float64) for item in content["measured"] if "tools" in item
        }
        tools[method, row.episode_id] = found
    for method, row, _ in records:
        for change, other in sorted(config.changed_controls.get(method, {}).items()):
            own, changed = (tools.get((name, row.episode_id), {}) for name in (method, other))
            for seed in sorted(own.keys() & changed.keys()):
                strides = [stride_of(rollouts[name], row) for name in (method, other)]
                if strides[0] != strides[1]:
                    raise DataError(
                        "Predictions under true and changed controls have different rates",
                        where=f"{method} and {other}, episode {row.episode_id}", got=f"strides {strides}",
                    )  # fmt: skip
                pair = _pair(tracks, row, change, own[seed], changed[seed], strides[0])
                for name, metric in metrics.items():
                    value = metric.load()(pair)
                    if value is not None:
                        yield method, row, seed, f"{name}[{change}]", value


def _pair(
    tracks: ActionTracks, row: EpisodeRow, change: str, own: np.ndarray, changed: np.ndarray, stride: int
) -> ControlledPair:
    """Both predictions over the frames that both have; of shuffled controls it is not known where they lead."""
    count, recorded = min(len(own), len(changed)), tracks.tracks(row.episode_id)
    scale, commanded = 100.0 / recorded.image_size[0], None
    if change == "mirrored" or change == "delayed":
        seen, view = changed_tracks(recorded, change), VIEWS.index(HEAD)
        frames = slice(0, stride * count, stride)
        commanded = scale * np.where(seen.valid[frames, view, :, None], seen.uv[frames, view], np.nan)
    true = scale * tool_points(tracks, row.episode_id, count, stride)
    return ControlledPair(true, own[:count], changed[:count], commanded)
