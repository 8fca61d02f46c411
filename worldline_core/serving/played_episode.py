"""What was played, as recordings that every other command reads: an EpisodeSet, and from it MCAP or Rerun files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.episodes.episode_set_writer import EpisodeSetWriter
from worldline_core.data.episodes.view_recording import RecordedView
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.video.frames import Frames
from worldline_core.errors import DataError
from worldline_core.exports.export import export
from worldline_core.geometry.rotations import nearest_rotation
from worldline_core.rollout.observation import project_controls
from worldline_core.serving.recorded_starts import RecordedStart

SAVED_AS = ("episodes", "mcap", "rrd")


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
        formats: some of `SAVED_AS`; the EpisodeSet is always written.
        notes: conventions of the episode: who drove, the model, the seed.

    Raises: DataError for an unknown format, or when the name is taken.
    """
    unknown = sorted(set(formats) - set(SAVED_AS))
    if unknown:
        raise DataError("Unknown format", expected=", ".join(SAVED_AS), got=", ".join(unknown))
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
    with EpisodeSetWriter(root / "episodes", fps=fps, pixel_format="yuv444p", video_preset="veryfast") as writer:
        views = {view: RecordedView(pictures.__iter__, len(pictures)) for view, pictures in frames.items()}
        writer.add(episode, views)
    others = [wanted for wanted in formats if wanted != "episodes"]
    return [root / "episodes", *(export(root / "episodes", root, others) if others else [])]
