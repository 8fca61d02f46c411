"""Frames to start a simulation from: of recordings, or one given as files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import batched
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from worldline_core.config import read_yaml
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.recorded_poses import RecordedCameras
from worldline_core.data.sources.calibration_file import add_camera, mounted_poses, read_calibration, still_poses
from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import Embodiment
from worldline_core.model.tokenizers import resized_frames
from worldline_core.rollout.observation import Camera
from worldline_core.store.artifact_files import verify_artifact


@dataclass(frozen=True)
class RecordedStart:
    """A frame of a recording.

    Attributes:
        images: ``uint8 (H, W, 3)`` by view.
        cameras: of the views that have one, at the first frame of the recording.
        state: ``(state size)``, the first command.
        earlier: ``(frame, state size)``, the commands from there to the frame of the images.
    """

    episode_id: str
    instruction: str
    images: dict[str, np.ndarray]
    cameras: dict[str, Camera]
    state: np.ndarray
    earlier: np.ndarray

    @property
    def commands(self) -> np.ndarray:
        """``(1 + frame, state size)``: all so far."""
        return np.concatenate((self.state[None], self.earlier))


_SAME_START = "from the same start as another"


class RecordedStarts:
    """Starts of the recordings that a model can go on from, in the order of the set; each bank (attempts from one initial
    state) is one start, that of its first recording. By name every recording can be begun, at any frame.

    Args:
        view_sets: of the model; a start shows the first one whose views are all recorded and calibrated.
        fps: of the model's controls.
        needs_cameras: of every view; False: of a model that knows control vectors.
        embodiment, splits: of the recordings; None: all.

    Attributes:
        rows: recordings that are starts.
        left_out: why, by the names of the others.
    """

    def __init__(
        self,
        recordings: Path,
        *,
        view_sets: Sequence[Sequence[str]],
        fps: float,
        needs_cameras: bool = True,
        embodiment: str | None = None,
        splits: Sequence[str] | None = None,
    ) -> None:
        verify_artifact(recordings, what="Set of recordings")
        self._episodes, self._view_sets = EpisodeSet.open(recordings), view_sets
        self._rows = {row.episode_id: row for row in self._episodes.rows}
        self.left_out: dict[str, str] = {}
        self.rows: list[EpisodeRow] = []
        self._needs_cameras = needs_cameras
        fit = {None, "missing_view", *(() if needs_cameras else ("missing_calibration",))}
        banks: set[str] = set()
        for row in self._episodes.rows:
            reasons = {
                "of another robot": embodiment is not None and row.embodiment != embodiment,
                "of another split": splits is not None and row.split not in splits,
                "without all views": not any(set(views) <= set(row.views) for views in view_sets),
                "of another rate": row.fps != fps,
                "without calibration or commands": row.stage2_reason not in fit,
                _SAME_START: row.bank in banks,
            }
            reason = next((reason for reason, holds in reasons.items() if holds), None)
            if reason is None:
                self.rows.append(row)
                banks |= {row.bank} if row.bank else set()
            else:
                self.left_out[row.episode_id] = reason
        self._start = lru_cache(maxsize=64)(self._read)
        self._before = lru_cache(maxsize=8)(self._read_before)

    @property
    def embodiment(self) -> str:
        """The one robot of the recordings.

        Raises: DataError when no recording fits, or those that do are of several robots.
        """
        robots = {row.embodiment for row in self.rows}
        if len(robots) != 1:
            recorded = ", ".join(sorted({row.embodiment for row in self._episodes.rows}))
            raise DataError(
                "Starts are needed of one robot", where=self._episodes.root,
                got=f"{', '.join(sorted(robots)) or 'none'}; left out: {dict(Counter(self.left_out.values()))}",
                next_step=f"name an embodiment of the recordings ({recorded}), or give others",
            )  # fmt: skip
        return robots.pop()

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, number: int) -> RecordedStart:
        return self.at(self.rows[number].episode_id)

    def at(self, episode_id: str, frame: int = 0) -> RecordedStart:
        """A frame of the recording of this name.

        Raises: DataError when there is no such recording or frame.
        """
        row = self.row(episode_id)
        if isinstance(frame, bool) or not isinstance(frame, int | np.integer) or not 0 <= frame < row.video_frames:
            raise DataError(
                "No such frame of a recording to start from", where=f"episode {episode_id}",
                expected=f"an integer, 0 to {row.video_frames - 1}", got=frame,
            )  # fmt: skip
        return self._start(episode_id, int(frame))

    def before(self, start: RecordedStart, size: tuple[int, int]) -> dict[str, Any]:
        """Recorded pictures before a start, ``uint8 (frame, H, W, 3)`` by view at this size (H, W)."""
        return self._before(start.episode_id, len(start.earlier), tuple(start.images), size)

    def robot_state(self, start: RecordedStart) -> np.ndarray:
        """``(state size)``: where the robot was at a start, as it was measured."""
        return self._episode(start.episode_id).state[len(start.earlier)]

    def row(self, episode_id: str) -> EpisodeRow:
        """The recording of this name.

        Raises: DataError when there is none that fits.
        """
        row = self._rows.get(episode_id) if isinstance(episode_id, str) else None
        reason = self.left_out.get(episode_id) if row else None
        if row is None or reason not in (None, _SAME_START):
            raise DataError(
                "No recording of this name to start from", where=self._episodes.root,
                expected=f"one of {', '.join(row.episode_id for row in self.rows[:8])} ...",
                got=f"{episode_id}, {reason}" if row else episode_id,
            )  # fmt: skip
        return row

    def commands(self, number: int) -> np.ndarray:
        """``(n, state size)``: what was commanded after the first frame of the recording of a start."""
        return np.asarray(self._episode(self.rows[number].episode_id).action[1:], np.float64)

    def _episode(self, episode_id: str) -> Episode:
        return self._episodes.episode(self._episodes.position(episode_id))

    def _read(self, episode_id: str, frame: int) -> RecordedStart:
        position, episode = self._episodes.position(episode_id), self._episode(episode_id)
        recorded = set(self._rows[episode_id].views)
        usable = recorded & set(episode.cameras) if self._needs_cameras else recorded
        views = next((views for views in self._view_sets if set(views) <= usable), None)
        if views is None:
            raise DataError(
                "A recording lacks the camera of a view to start from", where=f"episode {episode.episode_id}",
                expected=" or ".join(" + ".join(views) for views in self._view_sets), got=" + ".join(sorted(usable)),
                next_step="add its calibration, or start from another recording",
            )  # fmt: skip
        known = {view: episode.cameras[view] for view in views if view in episode.cameras}
        cameras = {view: Camera(camera.K, camera.T_base_camera[0]) for view, camera in known.items()}
        images = {view: self._episodes.frames(position, view, [frame])[0] for view in views}
        commands = np.asarray(episode.action[: frame + 1], np.float64)
        return RecordedStart(episode_id, episode.instruction, images, cameras, commands[0], commands[1:])

    def _read_before(self, episode_id: str, frame: int, views: Sequence[str], size: tuple[int, int]) -> dict[str, Any]:
        position = self._episodes.position(episode_id)
        video = {view: np.empty((frame, *size, 3), np.uint8) for view in views}
        for view, pictures in video.items():
            for numbers in batched(range(frame), 64):  # recordings may be large, and long
                pictures[list(numbers)] = resized_frames(self._episodes.frames(position, view, numbers), size)
        return video


def read_start(
    folder: Path, embodiment: Embodiment, views: Sequence[str], *, needs_cameras: bool = True
) -> RecordedStart:
    """An observation as files: ``<view>.png`` of each view, ``calibration.yaml`` (docs/sources.md), and ``state.yaml``, the
    command that belongs to the pictures: a number for each name of the embodiment's state, in its units.

    Args:
        needs_cameras: False: the calibration may lack views, or be missing.

    Raises:
        DataError: a file, view or number is missing, or cannot be used.
    """
    path, cameras = folder / "calibration.yaml", RecordedCameras()
    calibration = read_calibration(folder, path.name) if needs_cameras or path.is_file() else {}
    named, names = read_yaml(folder / "state.yaml"), embodiment.state_names
    if set(named) != set(names) or not all(isinstance(value, int | float) for value in named.values()):
        raise DataError(
            "Not the robot's state",
            where=folder / "state.yaml",
            expected=f"a number each: {', '.join(names)}",
            got=named,
        )
    state = np.array([named[name] for name in names], np.float64)
    images: dict[str, np.ndarray] = {}
    for view in views:
        try:
            images[view] = np.asarray(Image.open(folder / f"{view}.png").convert("RGB"))
        except (OSError, ValueError) as error:
            raise DataError("Not a picture to start from", where=folder / f"{view}.png", got=str(error)) from error
        entry = calibration.get(view)
        if entry is None and not needs_cameras:
            continue
        at = f"{path}, view {view}"
        if entry is None or entry.T_feature is not None or entry.distortion is not None:
            raise DataError(
                "A start needs the pinhole camera of each view", where=at, expected="K, a pose and no distortion",
                got="nothing" if entry is None else "T_feature or distortion", next_step="write K and T; undistort the picture",
            )  # fmt: skip
        poses = mounted_poses(view, entry, embodiment, state[None], at) if entry.on_hand else still_poses(entry, 1, at)
        height, width = images[view].shape[:2]
        add_camera(cameras, view, entry, poses, (height, width), at)
    return RecordedStart(
        folder.name, "", images, {view: Camera(track.K, track.T_base_camera[0]) for view, track in cameras.tracks.items()},
        state, np.empty((0, len(names))),
    )  # fmt: skip
