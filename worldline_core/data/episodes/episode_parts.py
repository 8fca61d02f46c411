"""Episodes waiting to be assembled into a set: one folder each, complete or absent, so a killed run can continue."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import numpy as np

from worldline_core.data.episodes.episode import ARRAYS, VIEWS, CameraTrack, Episode, EpisodeDescription
from worldline_core.data.episodes.fingerprint import fingerprint
from worldline_core.data.episodes.view_recording import (
    RECORDED_SIZE,
    RecordedView,
    VideoSettings,
    recorded_size,
    store_view,
    thumbnails_beside,
)
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.lerobot.v3_writer import EpisodeVideo
from worldline_core.data.video.frames import Frames, packed_images
from worldline_core.data.video.thumbnails import ViewThumbnails
from worldline_core.errors import DataError


def part_name(episode_id: str) -> str:
    """Folder name of an episode: any id is allowed, the name is safe and unique."""
    return sha256(episode_id.encode()).hexdigest()[:32]


def write_part(
    folder: Path,
    episode: Episode,
    views: Mapping[str, RecordedView],
    robot_masks: Mapping[str, Frames],
    video: VideoSettings,
    described: Callable[[Mapping[str, ViewThumbnails]], Episode] | None,
    thing_labels: Mapping[str, Frames],
) -> None:
    """Write one episode below `folder`, its videos as they are decoded; the part appears whole or not at all.

    Args:
        described: gives the episode as it is stored, where its description depends on what its views show.

    Raises: RejectedInputError where the recordings cannot be read or do not belong to the states; DataError where images,
        cameras and masks do not fit each other.
    """
    final = folder / part_name(episode.episode_id)
    working = folder / f".{final.name}.{os.getpid()}"
    shutil.rmtree(working, ignore_errors=True)
    working.mkdir(parents=True)
    try:
        stored: dict[str, EpisodeVideo] = {}
        thumbnails: dict[str, ViewThumbnails] = {}
        enlarged: dict[str, str] = {}
        for view, recorded in views.items():
            path, before = working / f"{view}.mp4", recorded_size(episode.conventions, view)
            stored[view], thumbnails[view], size = store_view(recorded, path, episode.fps, video, before)
            if size != stored[view].size:
                enlarged[f"{RECORDED_SIZE}{view}"] = f"{size[0]}x{size[1]}"
        _check_sizes(episode, stored, robot_masks, thing_labels)
        if described is not None:
            episode = described(thumbnails)
        others = {name: value for name, value in episode.conventions.items() if not name.startswith(RECORDED_SIZE)}
        episode = replace(episode, conventions=others | enlarged)
        arrays = {name: values.astype(ARRAYS[name].dtype) for name, values in episode.arrays().items()}
        for view, camera in episode.cameras.items():
            arrays[f"K.{view}"] = camera.K.astype(np.float64)
            arrays[f"pose.{view}"] = camera.T_base_camera.astype(np.float64)
        arrays |= {f"masks.{view}": packed_images(masks, bool, 9) for view, masks in robot_masks.items()}
        arrays |= {f"things.{view}": packed_images(labels, np.uint8, 6) for view, labels in thing_labels.items()}
        arrays |= {f"histogram.{view}": kept.histogram for view, kept in stored.items()}
        with (working / "arrays.npz").open("wb") as stream:
            np.savez(stream, allow_pickle=False, **arrays)
        description = {
            **episode.described(),
            "fps": float(episode.fps),
            "num_frames": episode.num_frames,
            "video_frames": episode.num_video_frames,
            "videos": {
                view: {"size": kept.size, "codec": kept.codec, "pixel_format": kept.pixel_format, "copied": kept.copied}
                for view, kept in stored.items()
            },
            "cameras": {view: [camera.width, camera.height] for view, camera in episode.cameras.items()},
            "masks": {view: list(mask.shape) for view, mask in robot_masks.items()},
            "things": {view: list(labels.shape) for view, labels in thing_labels.items()},
            "fingerprint": fingerprint(episode, thumbnails),
        }
        (working / "part.json").write_text(json.dumps(description, sort_keys=True))
        shutil.rmtree(final, ignore_errors=True)
        working.rename(final)
    finally:
        shutil.rmtree(working, ignore_errors=True)


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
                thumbnails=thumbnails_beside(self.folder / f"{view}.mp4"),
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


def _check_sizes(
    episode: Episode,
    stored: Mapping[str, EpisodeVideo],
    robot_masks: Mapping[str, Frames],
    thing_labels: Mapping[str, Frames],
) -> None:
    where = f"episode {episode.episode_id}"
    for view, kept in stored.items():
        camera = episode.cameras.get(view)
        if camera is not None and (camera.height, camera.width) != kept.size:
            raise RejectedInputError(
                "missing_calibration",
                "Camera is calibrated for another image size",
                where=f"{where}, view {view}",
                expected=f"{kept.size[0]}x{kept.size[1]}",
                got=f"{camera.height}x{camera.width}",
                next_step="use CameraTrack.resized so that K follows the resize",
                evidence={"view": view, "images": list(kept.size), "calibrated": [camera.height, camera.width]},
            )
    for what, images in (("Robot masks", robot_masks), ("Labels of things", thing_labels)):
        for view, values in images.items():
            expected = (episode.num_video_frames, *stored[view].size) if view in stored else "a view with images"
            if values.shape != expected:
                raise DataError(
                    f"{what} do not match the images",
                    where=f"{where}, view {view}",
                    expected=expected,
                    got=values.shape,
                )
