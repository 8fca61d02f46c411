"""Readers of other artifacts: recorded videos, exact masks, projected tool centres, predictions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from worldline_core.actions.episode_tracks import ActionTracks, EpisodeTracks
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.frames import VideoFrames
from worldline_core.errors import ArtifactError, DataError
from worldline_core.evaluation.scores import TRUE_METHOD
from worldline_core.rollout.rollout_set import RolloutSet

if TYPE_CHECKING:
    from worldline_core.rollout.simulation import Simulation

ROLLOUT_PREFIX = "rollouts."
HEAD = "head"


class Pictures(Protocol):
    """Frames of a video, uint8 (n, h, w, 3): an array, or a `VideoFrames`."""

    def __len__(self) -> int: ...

    def __getitem__(self, indices: list[int]) -> NDArray[Any]: ...


@dataclass(frozen=True)
class Trajectory:
    """One recorded or predicted video, as judges and selectors see it, without its outcome.

    Attributes:
        frames: by view; the views are synchronised. Only the frames that are asked for are decoded.
        points: (num_frames, arms, 2) projected tool centres in the head view [px], NaN where not valid; or None.
    """

    instruction: str
    frames: Mapping[str, Pictures]
    fps: float
    points: NDArray[Any] | None = None

    @property
    def num_frames(self) -> int:
        return min(len(frames) for frames in self.frames.values())

    def at(
        self, indices: Iterable[int], views: Sequence[str] = VIEWS
    ) -> tuple[dict[str, NDArray[Any]], NDArray[Any] | None]:
        """Chosen frames of those of ``views`` that there are, and the tool centres in them."""
        chosen = list(indices)
        frames = {view: video[chosen] for view, video in self.frames.items() if view in views}
        return frames, None if self.points is None else self.points[chosen]


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


def stride_of(rollout: RolloutSet, row: EpisodeRow) -> int:
    """Recorded frames from one frame of a prediction to the next.

    Raises: DataError where the rate of the predictions is no whole part of the recording's.
    """
    stride = round(row.fps / rollout.fps)
    if stride < 1 or abs(stride * rollout.fps - row.fps) > 1e-3 * row.fps:
        raise DataError(
            "Predictions have another frame rate than their recording",
            where=f"{rollout.root}, episode {row.episode_id}",
            expected=f"{row.fps:g} frames per second, or a whole part of it",
            got=rollout.fps,
        )
    return stride


def trajectory_of(
    episodes: EpisodeSet,
    row: EpisodeRow,
    views: Sequence[str],
    *,
    rollout: RolloutSet | None,
    seed: int,
    tracks: ActionTracks | None,
) -> Trajectory:
    """The recorded video of an episode in those of ``views`` that it has, or its prediction in ``rollout``.

    Raises: DataError when it has none of them.
    """
    position, name = episodes.position(row.episode_id), row.episode_id
    present = row.views if rollout is None else rollout.views(name)
    stride = 1 if rollout is None else stride_of(rollout, row)
    frames = {
        view: VideoFrames(episodes.clip(position, view) if rollout is None else rollout.clip(name, view, seed))
        for view in views
        if view in row.views and view in present
    }
    if not frames:
        raise DataError("A video has none of the views that are judged", where=name, expected=views, got=present)
    count = min(len(video) for video in frames.values())
    points = None if tracks is None else tool_points(tracks, name, count, stride)
    return Trajectory(row.instruction, frames, row.fps / stride, points)


def tool_points(tracks: ActionTracks, episode_id: str, num_frames: int, stride: int = 1) -> np.ndarray:
    """Projected tool centres in the head view (n, arms, 2) [px of the recording's frame]; NaN where not valid."""
    track = tracks.tracks(episode_id)
    column = VIEWS.index(HEAD)
    frames = slice(0, stride * num_frames, stride)
    points = np.array(track.uv[frames, column], dtype=np.float64)
    points[~np.asarray(track.valid[frames, column], dtype=bool)] = np.nan
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


def simulated_points(simulation: Simulation, clip: int) -> np.ndarray:
    """Tools in the head view of the last step ``(n, arms, 2)`` [px of the simulated picture], NaN where not seen."""
    return shown_points(simulation.tracks[clip], simulation.image_size)


def shown_points(tracks: EpisodeTracks, size: tuple[int, int]) -> np.ndarray:
    """Tools in the head view ``(n, arms, 2)`` [px of a picture of this size (H, W)], NaN where not seen."""
    column = tracks.views.index(HEAD)
    scale = np.array(size[::-1]) / np.array(tracks.image_size[::-1])
    points = (tracks.uv[:, column] + 0.5) * scale - 0.5
    points[~tracks.valid[:, column]] = np.nan
    return points
