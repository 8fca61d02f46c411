"""A small episode whose geometry is computed here by hand, for tests of what is drawn."""

from __future__ import annotations

import numpy as np
import pytest

from tests.data.conftest import make_sample  # pyright: ignore[reportMissingImports]
from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.exports.rerun_recording import RecordingContent

COUNT, HEIGHT, WIDTH = 5, 32, 48
CAMERA_MATRIX = np.array([[40.0, 0, 23.5], [0, 41.0, 15.5], [0, 0, 1]])


def poses(count: int) -> np.ndarray:
    """Camera or tool poses that turn and move along x."""
    result = np.tile(np.eye(4), (count, 1, 1))
    for i, pose in enumerate(result):
        c, s = np.cos(0.3 + 0.1 * i), np.sin(0.3 + 0.1 * i)
        pose[:3, :3] = [[c, 0, s], [s, 0, -c], [0, 1, 0]]
        pose[:3, 3] = (0.1 * i, 0.2, 0.3)
    return result


def tracks_of(uv: np.ndarray, valid: np.ndarray, gripper: float = 1.0, views: tuple[str, ...] = VIEWS) -> EpisodeTracks:
    """Tracks with tools 0.8 m before the camera at given pixels (n v a 2), axes along those of the camera."""
    n, v, a = valid.shape
    return EpisodeTracks(
        episode_id="robot/1", embodiment="ur5e_pair", views=views, arms=("left", "right")[-a:],
        image_size=(HEIGHT, WIDTH), controls="action", camera_motion=("static",) * v, uv=uv.astype(np.float32),
        depth=np.full((n, v, a), 0.8, np.float32), rot6d=np.tile(np.array([1, 0, 0, 0, 1, 0], np.float32), (n, v, a, 1)),
        gripper=np.full((n, v, a), gripper, np.float32), valid=valid,
        T_base_tool=np.stack([poses(n)] * a, axis=1).astype(np.float32),
        T_base_camera=np.tile(np.eye(4, dtype=np.float32), (n, v, 1, 1)), K=np.array([CAMERA_MATRIX] * v, np.float32),
        capsules=np.tile(np.array([[[-0.1, 0, 0.8], [0.1, 0, 0.8]]], np.float32), (n, 1, 1, 1)), capsule_radii=np.array([0.05], np.float32),
    )  # fmt: skip


@pytest.fixture(scope="session")
def content() -> RecordingContent:
    """Three views, two arms of which the right one is not valid in the last two frames, one prediction."""
    episode, frames, _ = make_sample(0, num_frames=COUNT, episode_id="robot/1", instruction="lift <it>")
    uv = np.full((COUNT, 3, 2, 2), 20.0)
    uv[..., 1, 0] = 30.0
    valid = np.ones((COUNT, 3, 2), bool)
    valid[3:, :, 1] = False
    return RecordingContent(episode, frames, frames, "stage2", tracks_of(uv, valid))
