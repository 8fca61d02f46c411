"""A small episode whose geometry is computed here by hand, for tests of what is drawn."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.data.episodes.episode import VIEWS, CameraTrack, Episode
from worldline_core.exports.rerun_recording import RecordingContent

COUNT, HEIGHT, WIDTH = 5, 32, 48
CAMERA_MATRIX = np.array([[40.0, 0, 23.5], [0, 41.0, 15.5], [0, 0, 1]])


def rotation(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


def poses(count: int) -> np.ndarray:
    """Camera or tool poses that turn and move along x."""
    result = np.tile(np.eye(4), (count, 1, 1))
    for i in range(count):
        result[i, :3, :3] = rotation(0.3 + 0.1 * i)
        result[i, :3, 3] = (0.1 * i, 0.2, 0.3)
    return result


def tracks_of(uv: np.ndarray, valid: np.ndarray, gripper: float = 1.0, views: tuple[str, ...] = VIEWS) -> EpisodeTracks:
    """Tracks with tools 0.8 m before the camera at given pixels (n v a 2), axes along those of the camera."""
    n, v, a = valid.shape
    return EpisodeTracks(
        episode_id="robot/1",
        embodiment="ur5e_pair",
        views=views,
        arms=("left", "right")[:a] if a > 1 else ("right",),
        image_size=(HEIGHT, WIDTH),
        controls="action",
        camera_motion=("static",) * v,
        uv=uv.astype(np.float32),
        depth=np.full((n, v, a), 0.8, np.float32),
        rot6d=np.tile(np.array([1, 0, 0, 0, 1, 0], np.float32), (n, v, a, 1)),
        gripper=np.full((n, v, a), gripper, np.float32),
        valid=valid,
        T_base_tool=np.stack([poses(n)] * a, axis=1).astype(np.float32),
        T_base_camera=np.tile(np.eye(4, dtype=np.float32), (n, v, 1, 1)),
        K=np.stack([CAMERA_MATRIX] * v).astype(np.float32),
        capsules=np.tile(np.array([[[-0.1, 0, 0.8], [0.1, 0, 0.8]]], np.float32), (n, 1, 1, 1)),
        capsule_radii=np.array([0.05], np.float32),
    )


@pytest.fixture(scope="session")
def hand_tracks() -> Callable[..., EpisodeTracks]:
    """Makes tracks from pixels and validity; frames are 32 x 48, K as below."""
    return tracks_of


@pytest.fixture(scope="session")
def camera_matrix() -> np.ndarray:
    """The camera matrix of every view."""
    return CAMERA_MATRIX


@pytest.fixture(scope="session")
def content() -> RecordingContent:
    """Three views, two arms of which the right one is not valid in the last two frames, one prediction."""
    generator = np.random.default_rng(0)
    cameras = {v: CameraTrack(v, CAMERA_MATRIX, poses(1 if v == "head" else COUNT), WIDTH, HEIGHT) for v in VIEWS}
    state = generator.random((COUNT, 4)).astype(np.float32)
    episode = Episode(
        episode_id="robot/1", source="synthetic", embodiment="ur5e_pair", scene="s", task_family="lift", instruction="lift <it>",
        outcome="success", split="test", fps=8.0, state=state, action=state + 1, timestamps=np.arange(COUNT) / 8.0, cameras=cameras,
        state_names=("left/a", "left/gripper", "right/a", "right/gripper"),
    )  # fmt: skip
    frames = {v: generator.integers(0, 255, (COUNT, HEIGHT, WIDTH, 3), dtype=np.uint8) for v in VIEWS}
    uv = np.full((COUNT, 3, 2, 2), 20.0)
    uv[..., 1, 0] = 30.0
    valid = np.ones((COUNT, 3, 2), bool)
    valid[3:, :, 1] = False
    return RecordingContent(episode, frames, {"stage2": frames}, tracks_of(uv, valid))
