"""What evaluation reads from other artifacts: recorded videos, exact masks, projected tool centres, predictions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode import VIEWS, Episode
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ArtifactError, DataError
from worldline_core.rollout.rollout_set import RolloutSet

ROLLOUT_PREFIX = "rollouts."
TRUE_METHOD = "true"


@dataclass(frozen=True)
class SeenVideo:
    """One recorded or predicted video, as judges and selectors are given it.

    Attributes:
        frames: by view, uint8 (n, h, w, 3); the views are synchronised.
        num_frames: of the shortest view.
        points: (num_frames, arms, 2) projected tool centres in the head view [px], NaN where not valid; or None.
    """

    frames: Mapping[str, np.ndarray]
    num_frames: int
    points: np.ndarray | None


@dataclass(frozen=True)
class Recordings:
    """An EpisodeSet looked up by episode_id."""

    episodes: EpisodeSet
    position: Mapping[str, int]

    @classmethod
    def open(cls, root: Path) -> Recordings:
        """The recordings of an EpisodeSet's folder."""
        episodes = EpisodeSet.open(root)
        return cls(episodes, {row.episode_id: index for index, row in enumerate(episodes.rows)})

    def episode(self, episode_id: str) -> Episode:
        """Raises DataError for an episode that was predicted but is not in the set."""
        if episode_id not in self.position:
            raise DataError(
                "A predicted episode is not in the EpisodeSet",
                where=episode_id,
                expected="rollouts and episodes of the same recordings",
                next_step="give the EpisodeSet that the rollouts were made from",
            )
        return self.episodes.episode(self.position[episode_id])

    def views(self, episode_id: str, wanted: Sequence[str]) -> tuple[str, ...]:
        """Those of ``wanted`` that were recorded; a robot with one arm has one wrist camera."""
        recorded = self.episodes.rows[self.position[episode_id]].views
        return tuple(view for view in wanted if view in recorded)

    def frames(self, episode_id: str, view: str, num_frames: int | None = None) -> np.ndarray:
        """uint8 (n, h, w, 3), the first ``num_frames`` frames.

        Raises: DataError when fewer were recorded.
        """
        frames = self.episodes.frames(self.position[episode_id], view)
        return _leading(frames, num_frames, f"recorded video of {episode_id}, view {view}")

    def seen_video(
        self,
        episode_id: str,
        wanted: Sequence[str],
        *,
        rollout: RolloutSet | None,
        seed: int,
        tracks: ActionTracks | None,
    ) -> SeenVideo:
        """The recorded video of an episode in the ``wanted`` views, or its prediction in ``rollout``."""
        frames = {
            view: self.frames(episode_id, view) if rollout is None else rollout.frames(episode_id, view, seed)
            for view in self.views(episode_id, wanted)
        }
        count = min(len(video) for video in frames.values())
        points = None if tracks is None else tool_points(tracks, episode_id, "head", count)
        return SeenVideo(frames, count, points)

    def robot_masks(self, episode_id: str, view: str, num_frames: int | None = None) -> np.ndarray | None:
        """Exact bool masks (n, h, w) where the recording carries them, otherwise None."""
        masks = self.episodes.robot_masks(self.position[episode_id], view)
        return None if masks is None else _leading(masks, num_frames, f"robot masks of {episode_id}, view {view}")


def _leading(values: np.ndarray, count: int | None, where: str) -> np.ndarray:
    if count is None:
        return values
    if len(values) < count:
        raise DataError(
            "A prediction is longer than its recording", where=where, expected=f"<= {len(values)}", got=count
        )
    return values[:count]


def open_tracks(root: Path | None) -> ActionTracks | None:
    """The ActionTracks of an optional input."""
    return None if root is None else ActionTracks.open(root)


def tool_points(tracks: ActionTracks, episode_id: str, view: str, num_frames: int) -> np.ndarray:
    """Projected tool centres (n, arms, 2) [px of the recording's frame]; NaN where not valid."""
    track = tracks.tracks(episode_id)
    column = VIEWS.index(view)
    points = np.array(track.uv[:num_frames, column], dtype=np.float64)
    points[~np.asarray(track.valid[:num_frames, column], dtype=bool)] = np.nan
    return points


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
