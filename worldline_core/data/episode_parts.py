"""Episodes waiting to be assembled into a set: one folder each, complete or absent, so a killed run can continue."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from worldline_core.data.episode import VIEWS, CameraTrack, Episode
from worldline_core.data.rejection import RejectedInputError
from worldline_core.data.statistics import image_histogram
from worldline_core.data.video import PixelFormat, encode_video
from worldline_core.errors import DataError


@dataclass(frozen=True)
class VideoSettings:
    """How images are encoded."""

    crf: int = 18
    preset: str = "slow"
    pixel_format: PixelFormat = "yuv420p"


def part_name(episode_id: str) -> str:
    """Folder name of an episode: any id is allowed, the name is safe and unique."""
    return sha256(episode_id.encode()).hexdigest()[:32]


def ordered_views(views: Iterable[str]) -> list[str]:
    """The project's fixed order, then any others by name."""
    given = set(views)
    return [view for view in VIEWS if view in given] + sorted(given - set(VIEWS))


def write_part(
    folder: Path,
    episode: Episode,
    frames: Mapping[str, np.ndarray],
    robot_masks: Mapping[str, np.ndarray] | None,
    video: VideoSettings,
) -> None:
    """Write one episode below `folder`; the part appears whole or not at all."""
    final = folder / part_name(episode.episode_id)
    working = folder / f".{final.name}.{os.getpid()}"
    shutil.rmtree(working, ignore_errors=True)
    working.mkdir(parents=True)
    arrays: dict[str, np.ndarray] = {
        "state": episode.state.astype(np.float32),
        "action": episode.action.astype(np.float32),
    }
    for view, camera in episode.cameras.items():
        arrays[f"K.{view}"] = camera.K.astype(np.float64)
        arrays[f"pose.{view}"] = camera.T_base_camera.astype(np.float64)
    if episode.T_base_ee is not None:
        arrays["T_base_ee"] = episode.T_base_ee.astype(np.float64)
    if episode.gripper is not None:
        arrays["gripper"] = episode.gripper.astype(np.float64)
    for view, mask in (robot_masks or {}).items():
        arrays[f"mask.{view}"] = np.packbits(mask.astype(bool))
    for view, images in frames.items():
        arrays[f"histogram.{view}"] = image_histogram(images)
        encode_video(
            working / f"{view}.mp4",
            images,
            episode.fps,
            crf=video.crf,
            preset=video.preset,
            pixel_format=video.pixel_format,
        )
    with (working / "arrays.npz").open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)
    description = {
        "episode_id": episode.episode_id,
        "source": episode.source,
        "embodiment": episode.embodiment,
        "scene": episode.scene,
        "task_family": episode.task_family,
        "instruction": episode.instruction,
        "outcome": episode.outcome,
        "split": episode.split,
        "fps": float(episode.fps),
        "bank": episode.bank,
        "candidate": episode.candidate,
        "primary_view": episode.primary_view,
        "state_names": None if episode.state_names is None else list(episode.state_names),
        "state_kind": episode.state_kind,
        "conventions": dict(episode.conventions),
        "num_frames": episode.num_frames,
        "video_frames": episode.num_video_frames,
        "views": [[view, *frames[view].shape[1:3]] for view in ordered_views(frames)],
        "cameras": {view: [camera.width, camera.height] for view, camera in episode.cameras.items()},
        "masks": {view: list(mask.shape) for view, mask in (robot_masks or {}).items()},
        "pixel_format": video.pixel_format,
    }
    (working / "part.json").write_text(json.dumps(description, sort_keys=True))
    shutil.rmtree(final, ignore_errors=True)
    working.rename(final)


class Part:
    """One waiting episode, read lazily."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.description: dict[str, Any] = json.loads((folder / "part.json").read_text())

    def __getitem__(self, key: str) -> Any:
        return self.description[key]

    @cached_property
    def arrays(self) -> dict[str, np.ndarray]:
        with np.load(self.folder / "arrays.npz", allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}

    @property
    def views(self) -> list[str]:
        return [view for view, _, _ in self["views"]]

    @property
    def image_sizes(self) -> dict[str, tuple[int, int]]:
        """(height, width) by view."""
        return {view: (height, width) for view, height, width in self["views"]}

    def video(self, view: str) -> Path:
        return self.folder / f"{view}.mp4"

    def mask(self, view: str) -> np.ndarray:
        """bool (N, H, W)."""
        shape = self.description["masks"][view]
        bits = np.unpackbits(self.arrays[f"mask.{view}"], count=int(np.prod(shape)))
        return bits.reshape(shape).astype(bool)

    def camera(self, view: str) -> CameraTrack:
        width, height = self.description["cameras"][view]
        return CameraTrack(view, self.arrays[f"K.{view}"], self.arrays[f"pose.{view}"], width, height)

    @property
    def signature(self) -> tuple[Any, ...]:
        """Episodes with equal signatures fit into one LeRobot dataset."""
        names = self["state_names"]
        return (
            self["embodiment"],
            self["fps"],
            tuple(tuple(item) for item in self["views"]),
            self.arrays["state"].shape[1],
            None if names is None else tuple(names),
            self["state_kind"],
        )


def read_parts(folder: Path) -> list[Part]:
    """Finished parts, by episode id."""
    if not folder.is_dir():
        return []
    found = [Part(path) for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")]
    return sorted(found, key=lambda part: part["episode_id"])


def check_frames(
    episode: Episode,
    frames: Mapping[str, np.ndarray],
    robot_masks: Mapping[str, np.ndarray] | None,
    image_size: tuple[int, int] | None,
) -> None:
    """Raises: DataError when images, masks and states of an episode do not belong together."""
    where = f"episode {episode.episode_id}"
    if not frames:
        raise DataError("Episode has no images", where=where, expected="at least one view", got="none")
    expected = episode.num_video_frames
    for view, images in frames.items():
        if images.dtype != np.uint8 or images.ndim != 4 or images.shape[3] != 3:
            raise DataError(
                "Images have a wrong type",
                where=f"{where}, view {view}",
                expected="uint8 (N, H, W, 3)",
                got=f"{images.dtype} {images.shape}",
            )
        if len(images) != expected:
            raise RejectedInputError(
                "length_mismatch",
                "Images and states differ in number",
                where=f"{where}, view {view}",
                expected=f"{expected} frames",
                got=f"{len(images)} frames",
            )
        if image_size is not None and tuple(images.shape[1:3]) != tuple(image_size):
            raise DataError(
                "Images have a wrong size",
                where=f"{where}, view {view}",
                expected=str(image_size),
                got=str(images.shape[1:3]),
            )
        camera = episode.cameras.get(view)
        if camera is not None and (camera.height, camera.width) != images.shape[1:3]:
            raise DataError(
                "Camera is calibrated for another image size",
                where=f"{where}, view {view}",
                expected=f"{images.shape[1]}x{images.shape[2]}",
                got=f"{camera.height}x{camera.width}",
                next_step="use CameraTrack.resized so that K follows the resize",
            )
    for view, mask in (robot_masks or {}).items():
        if view not in frames or mask.shape != frames[view].shape[:3]:
            raise DataError(
                "Robot masks do not match the images",
                where=f"{where}, view {view}",
                expected=str(frames[view].shape[:3]) if view in frames else "a view with images",
                got=str(mask.shape),
            )
