"""Where simulated episodes begin: the first observation of recorded ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.rollout.observation import Camera


@dataclass(frozen=True)
class Start:
    """What is known at the first frame of a recording, and what was to be done.

    Attributes:
        images: ``uint8 (H, W, 3)`` by view, with a camera each.
        state: ``(state size)``, the first command.
    """

    episode_id: str
    instruction: str
    images: dict[str, np.ndarray]
    cameras: dict[str, Camera]
    state: np.ndarray


class EpisodeStarts:
    """Starts of the recordings of one robot that a model can go on from, in the order of the set.

    Args:
        embodiment: of the recordings; None where all that fit have one.
        splits: of the recordings.
        views: of the model; each must be recorded and calibrated.
        fps: of the model's controls.

    Raises:
        DataError: no recording fits, or those that do are of several robots.
    """

    def __init__(
        self, recordings: Path, *, embodiment: str | None, splits: Sequence[str], views: Sequence[str], fps: float
    ) -> None:
        self._episodes = EpisodeSet.open(recordings)
        self._views = tuple(views)
        self._positions: list[int] = []
        left_out: Counter[str] = Counter()
        robots: set[str] = set()
        for position, row in enumerate(self._episodes.rows):
            reasons = {
                "of another robot": embodiment is not None and row.embodiment != embodiment,
                "of another split": row.split not in splits,
                "without all views": not set(views) <= set(row.views),
                "of another rate": row.fps != fps,
                "without calibration or commands": not row.stage2_ok,
            }
            reason = next((reason for reason, holds in reasons.items() if holds), None)
            if reason is None:
                self._positions.append(position)
                robots.add(row.embodiment)
            else:
                left_out[reason] += 1
        if len(robots) != 1:
            raise DataError(
                "An environment is of one robot",
                where=recordings,
                expected=f"recordings of {embodiment or 'one embodiment'} in {', '.join(splits)} with {', '.join(views)}",
                got=f"{', '.join(sorted(robots)) or 'none'}; left out: {dict(left_out)}",
                next_step="name the embodiment, or give other recordings",
            )
        self.embodiment = robots.pop()
        self._read = lru_cache(maxsize=64)(self._start)

    def __len__(self) -> int:
        return len(self._positions)

    def __getitem__(self, number: int) -> Start:
        return self._read(self._positions[number])

    def _start(self, position: int) -> Start:
        episode = self._episodes.episode(position)
        cameras = {
            view: Camera(episode.cameras[view].K, episode.cameras[view].T_base_camera[0]) for view in self._views
        }
        images = {view: self._episodes.frames(position, view, [0])[0] for view in self._views}
        return Start(
            episode.episode_id, episode.instruction, images, cameras, np.asarray(episode.action[0], np.float64)
        )
