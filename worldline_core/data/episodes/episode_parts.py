"""Waiting episodes of a set that is being written: one folder each, whole or absent."""

from __future__ import annotations

import json
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import numpy as np

from worldline_core.data.episodes.episode import ARRAYS, VIEWS, CameraTrack, Episode, EpisodeDescription
from worldline_core.data.episodes.lerobot_writer import EpisodeVideo


def part_name(episode_id: str) -> str:
    """Folder name of an episode: any id is allowed, the name is safe and unique."""
    return sha256(episode_id.encode()).hexdigest()[:32]


class Part:
    """One waiting episode. Its description is read at once (`part["split"]`, `part["fingerprint"]`), its arrays when asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.description: dict[str, Any] = json.loads((folder / "part.json").read_text())

    def __getitem__(self, key: str) -> Any:
        return self.description[key]

    @cached_property
    def _arrays(self) -> dict[str, np.ndarray]:
        with np.load(self.folder / "arrays.npz", allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}

    @cached_property
    def episode(self) -> Episode:
        """The episode as the set stores it: its times follow from its rate."""
        arrays: dict[str, Any] = self._arrays
        cameras = {
            view: CameraTrack(view, arrays[f"K.{view}"], arrays[f"pose.{view}"], width, height)
            for view, (width, height) in self["cameras"].items()
        }
        return Episode(
            **EpisodeDescription.arguments(self.description),
            **{name: arrays[name] for name in ARRAYS if name in arrays},
            timestamps=np.arange(self["num_frames"]) / self["fps"],
            cameras=cameras,
            video_frames=self["video_frames"],
        )

    @cached_property
    def videos(self) -> dict[str, EpisodeVideo]:
        """By view: first the project's own in their order, then any others by name."""
        found = self["videos"]
        return {
            view: EpisodeVideo(
                path=self.folder / f"{view}.mp4",
                histogram=self._arrays[f"histogram.{view}"],
                **found[view] | {"size": tuple(found[view]["size"])},
            )
            for view in sorted(found, key=lambda view: (VIEWS.index(view) if view in VIEWS else len(VIEWS), view))
        }

    def packed(self, kind: Literal["masks", "things"]) -> dict[str, tuple[list[int], bytes]]:
        """By view the shape (N, H, W) of its robot masks or labels of things, and themselves as `packed_images`."""
        return {view: (shape, self._arrays[f"{kind}.{view}"].tobytes()) for view, shape in self[kind].items()}

    @property
    def signature(self) -> tuple[Any, ...]:
        """Episodes with equal signatures fit into one LeRobot dataset."""
        episode = self.episode
        videos = tuple((view, video.size, video.codec, video.pixel_format) for view, video in self.videos.items())
        columns = episode.state.shape[1]
        return episode.embodiment, episode.fps, videos, columns, episode.state_names, episode.state_kind


def read_parts(folder: Path) -> list[Part]:
    """Finished parts, by episode id."""
    if not folder.is_dir():
        return []
    found = [Part(path) for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")]
    return sorted(found, key=lambda part: part["episode_id"])
