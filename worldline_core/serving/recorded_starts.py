"""Simulations that begin where a recording begins: its first pictures, cameras and commands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.geometry.kinematics import ArmKinematics, KinematicsByName
from worldline_core.rollout.observation import Camera
from worldline_core.rollout.simulation import Simulation
from worldline_core.rollout.worldline import WorldLine


@dataclass(frozen=True)
class RecordedStart:
    """The first moment of a recording.

    Attributes:
        images: ``uint8 (H, W, 3)`` by view, of one size.
    """

    episode: Episode
    images: dict[str, np.ndarray]
    cameras: dict[str, Camera]
    kinematics: ArmKinematics

    @property
    def image_size(self) -> tuple[int, int]:
        height, width = next(iter(self.images.values())).shape[:2]
        return height, width


class RecordedStarts:
    """Recordings of an EpisodeSet from which a model can start: of its rate, with its first view and with controls."""

    def __init__(self, folder: Path, world: WorldLine) -> None:
        self._world = world
        self._episodes = EpisodeSet.open(folder)
        self._kinematics = KinematicsByName({})
        self._positions = {
            row.episode_id: position
            for position, row in enumerate(self._episodes.rows)
            if row.fps == world.contract.fps
            and world.views[0] in row.views
            and row.stage2_reason in (None, "missing_view")
        }

    def listed(self) -> list[dict[str, str]]:
        """``id``, ``embodiment``, ``task`` and ``instruction`` of each; bodies and cameras that no model has seen come last."""
        rows = [self._episodes.rows[position] for position in self._positions.values()]
        rows.sort(key=lambda row: row.split == "ood_test")
        return [
            {
                "id": row.episode_id,
                "embodiment": row.embodiment,
                "task": row.task_family,
                "instruction": row.instruction,
            }
            for row in rows
        ]

    def kinematics(self, embodiment: str) -> ArmKinematics:
        """Of an embodiment by its name, built once; raises as `ArmKinematics`."""
        return self._kinematics.get(embodiment)

    def read(self, episode_id: str) -> RecordedStart:
        """The first moment of a recording.

        Raises: DataError when there is none of this name, or it cannot be read.
        """
        if episode_id not in self._positions:
            raise DataError(
                "No recording of this name to start from", where=self._episodes.root, got=episode_id,
                expected=f"one of {', '.join(sorted(self._positions)[:8])} ...",
            )  # fmt: skip
        position = self._positions[episode_id]
        episode = self._episodes.episode(position)
        kinematics = self.kinematics(episode.embodiment)
        mounted = {arm.camera_view for arm in kinematics.embodiment.arms if arm.wrist_camera is not None}
        views = [view for view in self._world.views if view in episode.cameras]
        images = {view: self._episodes.frames(position, view, [0])[0] for view in views}
        cameras = {
            view: Camera(track.K, None if view in mounted else track.T_base_camera[0])
            for view, track in episode.cameras.items()
            if view in images
        }
        return RecordedStart(episode, images, cameras, kinematics)

    def simulate(self, start: RecordedStart, seeds: Sequence[int]) -> Simulation:
        """Clips that begin there, one for each seed."""
        count = len(seeds)
        return self._world.start(
            [start.images] * count, [start.cameras] * count, embodiment=start.kinematics,
            state=np.repeat(start.episode.action[:1], count, axis=0), seed=list(seeds),
        )  # fmt: skip
