"""A source whose recordings depart from the contract's conventions, read as if they did not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from worldline_core.data.episodes.conventions import RecordedConventions, apply_conventions, image_frames
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.sources.base import EpisodeSource, LoadedEpisode


class RepairedSource:
    """Wraps a source and repairs each episode it loads; the episode's own conventions say which fields were used."""

    def __init__(self, source: EpisodeSource, conventions: RecordedConventions) -> None:
        self._source = source
        self._conventions = conventions

    def episode_ids(self) -> list[str]:
        return self._source.episode_ids()

    def load(self, episode_id: str) -> LoadedEpisode:
        return repair(self._source.load(episode_id), self._conventions)


def repair(loaded: LoadedEpisode, conventions: RecordedConventions) -> LoadedEpisode:
    """The loaded episode in the contract's conventions; images and masks follow a lag.

    Raises: RejectedInputError where the conventions do not apply to the episode.
    """
    if not conventions.departures:
        return loaded
    recorded, episode_id = loaded.episode, loaded.episode.episode_id
    images = image_frames(recorded.num_frames, conventions)
    lagging = bool(conventions.camera_lag_frames or conventions.image_lag_frames)
    declared = {f"declared_{field}": str(getattr(conventions, field)) for field in conventions.departures}
    repaired = apply_conventions(recorded, conventions)

    def cut(values: np.ndarray, view: str) -> np.ndarray:
        if not lagging:
            return values
        if len(values) != recorded.num_video_frames:
            raise RejectedInputError(
                "length_mismatch",
                "Video and states differ in length",
                where=f"episode {episode_id}, view {view}",
                expected=f"{recorded.num_video_frames} frames",
                got=f"{len(values)} frames",
                evidence={"states": recorded.num_video_frames, "frames": len(values)},
            )
        return values[images]

    def cut_images(view: str) -> Iterator[np.ndarray]:
        kept = range(recorded.num_video_frames)[images] if lagging else range(recorded.num_video_frames)
        return (image for number, image in enumerate(loaded.each_image(view)) if number in kept)

    def masks(view: str) -> np.ndarray | None:
        recorded_masks = loaded.robot_masks(view)
        return None if recorded_masks is None else cut(recorded_masks, view)

    return replace(
        loaded,
        episode=replace(repaired, conventions={**repaired.conventions, **declared}),
        frames=lambda view: cut(loaded.frames(view), view),
        robot_masks=masks,
        clips={view: clip.cut(images.start, images.stop) if lagging else clip for view, clip in loaded.clips.items()},
        images=cut_images,
    )
