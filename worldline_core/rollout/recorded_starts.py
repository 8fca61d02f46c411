"""First frames to start a simulation from: of recordings, or one given as files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from PIL import Image

from worldline_core.config import read_yaml
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.recorded_poses import RecordedCameras
from worldline_core.data.sources.calibration_file import add_calibrated_view, read_calibration
from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import Embodiment
from worldline_core.rollout.observation import Camera


@dataclass(frozen=True)
class RecordedStart:
    """The first frame of a recording.

    Attributes:
        images: ``uint8 (H, W, 3)`` by view, with a camera each.
        state: ``(state size)``, the first command.
    """

    episode_id: str
    instruction: str
    images: dict[str, np.ndarray]
    cameras: dict[str, Camera]
    state: np.ndarray


class RecordedStarts:
    """Starts of the recordings that a model can go on from, in the order of the set; each bank (attempts from one initial
    state) is one start, that of its first recording.

    Args:
        view_sets: of the model; a start shows the first one whose views are all recorded and calibrated.
        fps: of the model's controls.
        embodiment, splits: of the recordings; None: all.
    """

    def __init__(
        self,
        recordings: Path,
        *,
        view_sets: Sequence[Sequence[str]],
        fps: float,
        embodiment: str | None = None,
        splits: Sequence[str] | None = None,
    ) -> None:
        self._episodes, self._view_sets = EpisodeSet.open(recordings), view_sets
        positions: list[int] = []
        self._left_out: Counter[str] = Counter()
        banks: set[str] = set()
        for position, row in enumerate(self._episodes.rows):
            reasons = {
                "of another robot": embodiment is not None and row.embodiment != embodiment,
                "of another split": splits is not None and row.split not in splits,
                "without all views": not any(set(views) <= set(row.views) for views in view_sets),
                "of another rate": row.fps != fps,
                "without calibration or commands": row.stage2_reason not in (None, "missing_view"),
                "from the same start as another": row.bank in banks,
            }
            reason = next((reason for reason, holds in reasons.items() if holds), None)
            if reason is None:
                positions.append(position)
                banks |= {row.bank} if row.bank else set()
            else:
                self._left_out[reason] += 1
        self.rows = [self._episodes.rows[position] for position in positions]
        self._positions = positions
        self._start = lru_cache(maxsize=64)(self._read)

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
                got=f"{', '.join(sorted(robots)) or 'none'}; left out: {dict(self._left_out)}",
                next_step=f"name an embodiment of the recordings ({recorded}), or give others",
            )  # fmt: skip
        return robots.pop()

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, number: int) -> RecordedStart:
        return self._start(number)

    def named(self, episode_id: str) -> tuple[EpisodeRow, RecordedStart]:
        """The recording of this name and its start.

        Raises: DataError when there is none.
        """
        for number, row in enumerate(self.rows):
            if row.episode_id == episode_id:
                return row, self[number]
        raise DataError(
            "No recording of this name to start from", where=self._episodes.root, got=episode_id,
            expected=f"one of {', '.join(row.episode_id for row in self.rows[:8])} ...",
        )  # fmt: skip

    def commands(self, number: int) -> np.ndarray:
        """``(n, state size)``: what was commanded after the first frame of the recording of a start."""
        return np.asarray(self._episodes.episode(self._positions[number]).action[1:], np.float64)

    def _read(self, number: int) -> RecordedStart:
        position = self._positions[number]
        episode = self._episodes.episode(position)
        usable = set(episode.cameras) & set(self._episodes.rows[position].views)
        views = next((views for views in self._view_sets if set(views) <= usable), None)
        if views is None:
            raise DataError(
                "A recording lacks the camera of a view to start from", where=f"episode {episode.episode_id}",
                expected=" or ".join(" + ".join(views) for views in self._view_sets), got=" + ".join(sorted(usable)),
                next_step="add its calibration, or start from another recording",
            )  # fmt: skip
        cameras = {view: Camera(episode.cameras[view].K, episode.cameras[view].T_base_camera[0]) for view in views}
        images = {view: self._episodes.frames(position, view, [0])[0] for view in views}
        return RecordedStart(
            episode.episode_id, episode.instruction, images, cameras, np.asarray(episode.action[0], np.float64)
        )


def read_start(folder: Path, embodiment: Embodiment, views: Sequence[str]) -> RecordedStart:
    """An observation as files: ``<view>.png`` of each view, ``calibration.yaml`` (docs/sources.md), and ``state.yaml``, the
    command that belongs to the pictures: a number for each name of the embodiment's state, in its units.

    Raises:
        DataError: a file, view or number is missing, or cannot be used.
    """
    calibration, cameras = read_calibration(folder / "calibration.yaml").views, RecordedCameras()
    images: dict[str, np.ndarray] = {}
    for view in views:
        try:
            images[view] = np.asarray(Image.open(folder / f"{view}.png").convert("RGB"))
        except (OSError, ValueError) as error:
            raise DataError("Not a picture to start from", where=folder / f"{view}.png", got=str(error)) from error
        entry = calibration.get(view)
        if entry is None or entry.T is None or entry.distortion is not None:
            raise DataError(
                "A start needs the pinhole camera of each view", where=f"{folder / 'calibration.yaml'}, view {view}",
                expected="K, T and no distortion", got="nothing" if entry is None else "T_feature or distortion",
                next_step="write K and T; undistort the picture",
            )  # fmt: skip
        height, width = images[view].shape[:2]
        add_calibrated_view(
            cameras, view, entry, image_size=(height, width), num_frames=1, read_feature=lambda _: np.empty(0),
            where=str(folder),
        )  # fmt: skip
    state = read_yaml(folder / "state.yaml")
    names = embodiment.state_names
    if set(state) != set(names) or not all(isinstance(value, int | float) for value in state.values()):
        raise DataError(
            "Not the robot's state",
            where=folder / "state.yaml",
            expected=f"a number each: {', '.join(names)}",
            got=state,
        )
    return RecordedStart(
        folder.name, "", images, {view: Camera(track.K, track.T_base_camera[0]) for view, track in cameras.tracks.items()},
        np.array([state[name] for name in names], np.float64),
    )  # fmt: skip
