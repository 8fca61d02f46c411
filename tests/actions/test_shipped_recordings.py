"""On the recordings that the repository carries: kinematics, calibration and masks agree with what was rendered."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from einops import reduce

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
    """The shipped episodes, and the number of a sound one of each robot."""
    root = project_root / "artifacts" / "shipped" / "recordings"
    episodes, defects = EpisodeSet.open(root), json.loads((root / "injected_defects.json").read_text())
    rows = enumerate(episodes.rows)
    return episodes, {row.embodiment: i for i, row in reversed(list(rows)) if row.episode_id not in defects}


@pytest.mark.parametrize("embodiment", EMBODIMENTS)
def test_kinematics_give_the_recorded_wrist_cameras_and_masks_that_cover_the_robot(recordings, embodiment):
    position = recordings[1][embodiment]
    episode = recordings[0].episode(position)
    kinematics = ArmKinematics(load_embodiment(embodiment))
    found = kinematics.wrist_camera_poses(episode.state.astype(np.float64))
    assert set(found) == set(episode.cameras) - {"head"}
    for view, poses in found.items():
        np.testing.assert_allclose(poses.numpy(), episode.cameras[view].T_base_camera, atol=1e-5)
    tracks, _ = compute_tracks(episode, kinematics)
    views = [v for v, view in enumerate(tracks.views) if view in episode.cameras]
    frames = 1 + (tracks.num_frames - 1) // 4 * 4
    given = (tracks.capsules[:frames], tracks.capsule_radii, tracks.K[views], tracks.T_base_camera[:frames, views])
    batched = (torch.from_numpy(x)[None] for x in given)
    masks = kinematic_robot_masks(*batched, tracks.image_size, GRID, neighbour_frames=0)[0].bool()
    for covered, view in zip(masks, (tracks.views[v] for v in views), strict=True):
        exact = torch.from_numpy(np.asarray(recordings[0].robot_masks(position, view)[:frames:4]))
        robot = reduce(exact, "t (h p) (w q) -> t h w", "max", h=GRID[0], w=GRID[1])
        assert (covered & robot).sum() / robot.sum() > 0.75
        assert (covered & robot).sum() / (covered | robot).sum() > (0.5 if view == "head" else 0.25)
