"""On the recordings that the repository carries: kinematics, calibration and masks agree with what was rendered."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.robot_masks import kinematic_robot_masks
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics

EMBODIMENTS = (
    "panda_ivory", "ur5e_silver", "ur5e_slate", "viperx_graphite", "viperx_pearl", "xarm7_bronze", "xarm7_single", "xarm7_white"
)  # fmt: skip
GRID = (8, 12)


@pytest.fixture(scope="module")
def recordings(project_root):
    root = project_root / "artifacts" / "shipped" / "recordings"
    if not (root / "index.parquet").is_file():
        pytest.skip("the shipped recordings are not here")
    defects = root / "injected_defects.json"
    return EpisodeSet.open(root), json.loads(defects.read_text()) if defects.is_file() else {}


def sound_episode(recordings, embodiment: str) -> int:
    episodes, defects = recordings
    sound = [i for i in episodes.select(embodiment=embodiment) if episodes.rows[i].episode_id not in defects]
    if not sound:
        pytest.skip(f"no recording of {embodiment}")
    return sound[0]


@pytest.mark.parametrize("embodiment", EMBODIMENTS)
def test_kinematics_of_the_state_give_the_recorded_wrist_cameras(recordings, embodiment):
    episode = recordings[0].episode(sound_episode(recordings, embodiment))
    kinematics = ArmKinematics(load_embodiment(embodiment))
    found = kinematics.wrist_camera_poses(episode.state.astype(np.float64))
    assert set(found) == set(episode.cameras) - {"head"}
    for view, poses in found.items():
        np.testing.assert_allclose(poses.numpy(), episode.cameras[view].T_base_camera, atol=1e-5)


@pytest.mark.parametrize("embodiment", EMBODIMENTS)
def test_kinematic_masks_cover_the_rendered_robot(recordings, embodiment):
    position = sound_episode(recordings, embodiment)
    episode = recordings[0].episode(position)
    tracks, _ = compute_tracks(episode, ArmKinematics(load_embodiment(embodiment)))
    views = [v for v, view in enumerate(tracks.views) if view in episode.cameras]
    batched = [torch.from_numpy(x)[None] for x in (tracks.capsules, tracks.capsule_radii, tracks.K[views])]
    cameras = torch.from_numpy(tracks.T_base_camera[:, views])[None]
    frames = 1 + (tracks.num_frames - 1) // 4 * 4
    masks = kinematic_robot_masks(
        batched[0][:, :frames], batched[1], batched[2], cameras[:, :frames], tracks.image_size, GRID, neighbour_frames=0
    )[0].bool()
    height, width = tracks.image_size
    for row, v in enumerate(views):
        exact = recordings[0].robot_masks(position, tracks.views[v])
        cells = torch.from_numpy(np.asarray(exact[:frames:4])).reshape(
            -1, GRID[0], height // GRID[0], GRID[1], width // GRID[1]
        )
        robot = cells.any(dim=4).any(dim=2)
        covered = masks[row]
        assert (covered & robot).sum() / robot.sum() > 0.75
        assert (covered & robot).sum() / (covered | robot).sum() > (0.5 if tracks.views[v] == "head" else 0.25)
