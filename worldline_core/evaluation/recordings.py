"""What evaluation reads from other artifacts: recorded videos, exact masks, projected tool centres, predictions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ArtifactError, DataError
from worldline_core.rollout.rollout_set import RolloutSet

ROLLOUT_PREFIX = "rollouts."
TRUE_METHOD = "true"
HEAD = "head"


@dataclass(frozen=True)
class Trajectory:
    """One recorded or predicted video, as judges and selectors are given it; nothing in it tells the recorded outcome.

    Attributes:
        frames: by view, uint8 (n, h, w, 3); the views are synchronised.
        points: (num_frames, arms, 2) projected tool centres in the head view [px], NaN where not valid; or None.
    """

    instruction: str
    frames: Mapping[str, np.ndarray]
    fps: float
    points: np.ndarray | None = None

    @property
    def num_frames(self) -> int:
        return min(len(frames) for frames in self.frames.values())


def rows_of(episodes: EpisodeSet, episode_ids: Iterable[str]) -> list[EpisodeRow]:
    """Rows of episodes that were predicted, in the order of their ids.

    Raises: DataError for an episode that is not in the set.
    """
    rows = {row.episode_id: row for row in episodes.rows}
    wanted = sorted(episode_ids)
    missing = [name for name in wanted if name not in rows]
    if missing:
        raise DataError(
            "A predicted episode is not in the EpisodeSet",
            where=missing[0],
            expected="rollouts and episodes of the same recordings",
            next_step="give the EpisodeSet that the rollouts were made from",
        )
    return [rows[name] for name in wanted]


def leading(values: np.ndarray, count: int, where: str) -> np.ndarray:
    """The first ``count`` recorded frames or masks.

    Raises: DataError when fewer were recorded.
    """
    if len(values) < count:
        raise DataError(
            "A prediction is longer than its recording", where=where, expected=f"<= {len(values)}", got=count
        )
    return values[:count]


def trajectory_of(
    episodes: EpisodeSet,
    row: EpisodeRow,
    views: Sequence[str],
    *,
    rollout: RolloutSet | None,
    seed: int,
    tracks: ActionTracks | None,
) -> Trajectory:
    """The recorded video of an episode in those of ``views`` that it has, or its prediction in ``rollout``."""
    position = episodes.position(row.episode_id)
    frames = {
        view: episodes.frames(position, view) if rollout is None else rollout.frames(row.episode_id, view, seed)
        for view in views
        if view in row.views
    }
    count = min(len(video) for video in frames.values())
    points = None if tracks is None else tool_points(tracks, row.episode_id, count)
    return Trajectory(row.instruction, frames, row.fps, points)


def tool_points(tracks: ActionTracks, episode_id: str, num_frames: int) -> np.ndarray:
    """Projected tool centres in the head view (n, arms, 2) [px of the recording's frame]; NaN where not valid."""
    track = tracks.tracks(episode_id)
    column = VIEWS.index(HEAD)
    points = np.array(track.uv[:num_frames, column], dtype=np.float64)
    points[~np.asarray(track.valid[:num_frames, column], dtype=bool)] = np.nan
    return points


def open_tracks(inputs: Mapping[str, Path]) -> ActionTracks | None:
    """The ActionTracks among a step's inputs; None where there are none."""
    return ActionTracks.open(inputs["tracks"]) if "tracks" in inputs else None


def open_rollouts(inputs: Mapping[str, Path]) -> dict[str, RolloutSet]:
    """The RolloutSets among a step's inputs (``rollouts.<method>``), by method.

    Raises: ArtifactError without any.
    """
    sets = {
        name.removeprefix(ROLLOUT_PREFIX): RolloutSet.open(path)
        for name, path in sorted(inputs.items())
        if name.startswith(ROLLOUT_PREFIX)
    }
    if not sets:
        raise ArtifactError(
            "No predicted videos to evaluate", expected=f"inputs named {ROLLOUT_PREFIX}<method>", got=sorted(inputs)
        )
    if TRUE_METHOD in sets:
        raise ArtifactError(
            f"A method cannot be called {TRUE_METHOD!r}", next_step="that name stands for the recordings"
        )
    return sets
