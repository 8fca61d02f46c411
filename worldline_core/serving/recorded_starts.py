"""Simulations that begin where a recording begins, at its first pictures, cameras and commands; and what was played, as
recordings that every other command reads: an EpisodeSet, and from it MCAP or Rerun files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.episode_set_writer import EpisodeSetWriter
from worldline_core.data.episodes.view_recording import RecordedView
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.video.frames import Frames
from worldline_core.errors import DataError
from worldline_core.exports.export import export
from worldline_core.geometry.kinematics import ArmKinematics, KinematicsByName
from worldline_core.geometry.transforms import nearest_rotation
from worldline_core.rollout.observation import Camera, project_controls
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
        self.kinematics = KinematicsByName({})
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
        kinematics = self.kinematics.get(episode.embodiment)
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


def save_played(
    folder: Path,
    name: str,
    start: RecordedStart,
    frames: Mapping[str, Frames],
    states: np.ndarray,
    commands: np.ndarray,
    *,
    fps: float,
    formats: Sequence[str],
    notes: Mapping[str, str | int],
) -> list[Path]:
    """Write one played episode below ``folder / name`` and return what was written.

    Args:
        frames: by view ``uint8 (n, H, W, 3)``, the observed frame first.
        states, commands: ``(n, j)``.
        formats: "mcap" and "rrd" are written beside the EpisodeSet ("episodes"), which always is.
        notes: conventions of the episode: who drove, the model, the seed.

    Raises: DataError when the name is taken.
    """
    recorded, embodiment = start.episode, start.kinematics.embodiment
    tracks = project_controls(start.cameras, start.image_size, start.kinematics, controls=commands, fps=fps)
    height, width = next(iter(frames.values())).shape[1:3]
    cameras = {}
    for view in frames:
        v = tracks.views.index(view)
        poses = tracks.T_base_camera[:, v].astype(np.float64)
        poses[:, :3, :3] = nearest_rotation(poses[:, :3, :3])
        poses = poses[:1] if tracks.camera_motion[v] == "static" else poses
        track = CameraTrack(view, tracks.K[v].astype(np.float64), poses, start.image_size[1], start.image_size[0])
        cameras[view] = track.resized(width, height)
    episode = Episode(
        episode_id=safe_stem(name), source="worldline_play", embodiment=embodiment.name, scene=recorded.scene,
        task_family=recorded.task_family, instruction=recorded.instruction, outcome="unknown", split="test", fps=fps,
        state=states.astype(np.float32), action=commands.astype(np.float32), timestamps=np.arange(len(states)) / fps,
        cameras=cameras, state_names=embodiment.state_names, primary_view=next(iter(frames)),
        conventions={"pictures": "predicted", "started_at": recorded.episode_id, **notes},
    )  # fmt: skip
    root = folder / safe_stem(name)
    with EpisodeSetWriter(root / "episodes", pixel_format="yuv444p", video_preset="veryfast") as writer:
        views = {view: RecordedView(pictures.__iter__, len(pictures)) for view, pictures in frames.items()}
        writer.add(episode, views)
    others = [wanted for wanted in formats if wanted != "episodes"]
    return [root / "episodes", *(export(root / "episodes", root, others) if others else [])]
