"""Small recordings for a rehearsal: shipped ones at the rate and length of real ones, with three views and with two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.episode_set_writer import EpisodeSetWriter
from worldline_core.geometry.rotations import nearest_rotation
from worldline_core.shipped import shipped_folder

FPS, FRAMES = 30.0, 129
THREE_VIEWS = tuple(
    f"ur5e_silver-{name}"
    for name in ("train-s1-00003", "train-s1-00004", "validation-s1-00000", "test-s1-00001", "test-s1-00004")
)
"""One body: successes and failures to train on, one to validate, and of one task a success and a failure to test."""
TWO_VIEWS = ("xarm7_single-train-s1-00000", "xarm7_single-train-s1-00001")
"""A head and a wrist camera, a failure and a success; here they are for evaluation alone."""


def write_recordings(folder: Path, episodes: Sequence[str], *, split: str | None = None) -> None:
    """Write shipped recordings as an EpisodeSet of 30 frames a second and 129 frames, the same bytes every time.

    States, commands, camera poses and pictures between two recorded moments are interpolated; the movement takes a twentieth
    longer than it did.

    Args:
        split: given to all of them; by default each keeps its own.
    """
    shipped = EpisodeSet.open(shipped_folder() / "recordings")
    with EpisodeSetWriter(folder, fps=FPS, video_crf=10, video_preset="ultrafast") as writer:
        for name in episodes:
            position = shipped.position(name)
            episode = shipped.episode(position)
            moments = np.linspace(0, episode.num_frames - 1, FRAMES)
            frames = {view: _between(shipped.frames(position, view), moments) for view in shipped.rows[position].views}
            changed = resampled(episode, moments)
            writer.add(
                replace(changed, split=split or episode.split),
                {view: np.rint(values).astype(np.uint8) for view, values in frames.items()},
            )


def resampled(episode: Episode, moments: np.ndarray) -> Episode:
    """The episode at 30 frames a second, one for each of ``moments`` (frame numbers with fractions)."""
    return replace(
        episode,
        fps=FPS,
        timestamps=np.arange(len(moments)) / FPS,
        video_frames=None,
        cameras={view: _moved(camera, moments) for view, camera in episode.cameras.items()},
        **{name: _poses(values, moments) if name == "T_base_ee" else _between(values, moments)
           for name, values in episode.arrays().items()},
    )  # fmt: skip


def _moved(camera: CameraTrack, moments: np.ndarray) -> CameraTrack:
    return replace(camera, T_base_camera=_poses(camera.T_base_camera, moments)) if camera.moving else camera


def _poses(poses: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Poses (..., 4, 4) between recorded ones: positions linearly, rotations as the nearest to the mixed matrices."""
    mixed = _between(poses, moments)
    mixed[..., :3, :3] = nearest_rotation(mixed[..., :3, :3])
    return mixed


def _between(values: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Rows of ``values`` at frame numbers with fractions, linearly."""
    before = np.floor(moments).astype(int)
    after = np.minimum(before + 1, len(values) - 1)
    share = (moments - before).reshape(-1, *[1] * (values.ndim - 1))
    return values[before] * (1 - share) + values[after] * share
