"""Kinematic robot masks: capsules against a ray-traced reference, windows, dilation, and the robots of the shipped recordings."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from einops import reduce

from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.robot_masks import (
    TOUCH_MARGIN_CELLS,
    kinematic_robot_masks,
    project_capsules,
    robot_capsules,
    tool_capsules,
)
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics

K = torch.tensor([[90.0, 0, 47.5], [0, 90.0, 31.5], [0, 0, 1.0]], dtype=torch.float64)
EYE = torch.eye(4, dtype=torch.float64)
SIZE = (64, 96)


def draw(start, end, radius, intrinsics=K, grid=SIZE):
    capsule = torch.tensor([start, end], dtype=torch.float64)[None, None, None]
    radii = torch.tensor([[radius]], dtype=torch.float64)
    return project_capsules(capsule, radii, intrinsics[None, None], EYE[None, None, None], SIZE, grid)[0, 0, 0].numpy()


def traced(start, end, radius, intrinsics=K):
    """Pixels whose ray passes the segment nearer than the radius: by minimising over points of the segment."""
    start, end = np.array(start), np.array(end)
    v, u = np.mgrid[0 : SIZE[0], 0 : SIZE[1]]
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(intrinsics.numpy()).T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    best = np.full(SIZE, np.inf)
    for s in np.linspace(0, 1, 201):
        point = start + s * (end - start)
        along = np.clip(rays @ point, 0, None)
        best = np.minimum(best, np.linalg.norm(point - along[..., None] * rays, axis=-1))
    return best <= radius


@pytest.mark.parametrize(
    ("start", "end", "radius"),
    [
        ((-0.2, -0.1, 1.0), (0.3, 0.15, 1.0), 0.06),
        ((-0.2, -0.1, 0.6), (0.3, 0.15, 1.6), 0.06),
        ((0.1, 0.05, 0.9), (0.1, 0.05, 0.9), 0.1),
    ],
)
def test_capsule_equals_the_ray_traced_one(start, end, radius):
    drawn, expected = draw(start, end, radius), traced(start, end, radius)
    assert expected.sum() > 100
    overlap = (drawn & expected).sum() / (drawn | expected).sum()
    assert overlap > 0.93


def test_pixels_that_are_not_square_stretch_the_disc():
    drawn = draw((0, 0, 1.0), (0, 0, 1.0), 0.2, K * torch.tensor([[60 / 90, 1, 1], [1, 1, 1], [1, 1, 1]]))
    assert (drawn.any(1).sum(), drawn.any(0).sum()) == (36, 24)


def test_what_is_behind_the_camera_or_without_radius_is_cut_away():
    assert draw((0, 0, -1.0), (0, 0.0, -0.5), 0.1).sum() == 0
    assert draw((0, 0, 1.0), (0, 0, 1.0), 0.0).sum() == 0
    half = draw((0.2, 0.3, -1.0), (0.1, 0.1, 1.0), 0.05)
    assert 0 < half.sum() < half.size


def test_capsules_follow_the_links(kinematics):
    state = np.random.default_rng(0).uniform(-0.5, 0.5, (3, 8))
    poses = kinematics.link_poses(state)
    capsules, radii = robot_capsules(kinematics, poses)
    # An arm: hand-upper, upper-base, hand-tool, hand-finger, finger-fingertip.
    assert capsules.shape == (3, 10, 2, 3)
    assert radii.tolist() == pytest.approx([0.05, 0.05, 0.04, 0.04, 0.04] * 2)
    torch.testing.assert_close(capsules[:, 0, 0], poses["left/upper"][:, :3, 3])
    torch.testing.assert_close(capsules[:, 0, 1], poses["left/hand"][:, :3, 3])
    torch.testing.assert_close(capsules[:, 7, 1], kinematics.tool_poses(state)[:, 1, :3, 3])
    torch.testing.assert_close(capsules[:, 8, 1], poses["right/finger"][:, :3, 3])
    # The finger is 8 cm, the tool 10 cm along the hand's z.
    fingertip = poses["right/finger"] @ torch.tensor([0, 0, 0.02, 1.0]).double()
    torch.testing.assert_close(capsules[:, 9, 1], fingertip[:, :3])


def test_tool_capsule_reaches_back_along_z():
    capsules, radii = tool_capsules(EYE.expand(2, 1, 4, 4))
    assert capsules[0, 0].tolist() == [[0, 0, pytest.approx(-0.15)], [0, 0, 0]]
    assert radii.tolist() == [0.05]


def moving_ball(num_frames=9):
    """A small ball that crosses the picture from left to right, one clip and view."""
    x = torch.linspace(-0.45, 0.45, num_frames, dtype=torch.float64)
    points = torch.stack([x, torch.full_like(x, 0.02), torch.ones_like(x)], dim=-1)
    capsules = points[None, :, None, None].expand(1, num_frames, 1, 2, 3)
    cameras = EYE.expand(1, num_frames, 1, 4, 4)
    return capsules, torch.full((1, 1), 0.03, dtype=torch.float64), K[None, None], cameras


def test_latent_masks_cover_their_frames_and_neighbours_and_are_dilated():
    arguments = (*moving_ball(), SIZE, (8, 12))
    tight = kinematic_robot_masks(*arguments, neighbour_frames=0, dilation=0)
    assert tight.shape == (1, 1, 3, 8, 12)
    assert set(tight.unique().tolist()) == {0.0, 1.0}
    frames = project_capsules(*arguments[:4], SIZE, (64, 96))[0, 0]
    touched = frames.reshape(9, 8, 8, 12, 8).any(dim=4).any(dim=2)
    expected = project_capsules(*arguments, margin_cells=TOUCH_MARGIN_CELLS)[0, 0]
    # The margin stands for testing every pixel of a cell: only a few barely touched corners may differ.
    assert (touched & ~expected).sum() <= 0.15 * touched.sum()
    assert (expected & ~touched).sum() <= 0.15 * touched.sum()
    for t, window in enumerate(([0], [1, 2, 3, 4], [5, 6, 7, 8])):
        assert (tight[0, 0, t].bool() == expected[window].any(dim=0)).all()
    wide = kinematic_robot_masks(*arguments, neighbour_frames=2, dilation=0)[0, 0].bool()
    assert (wide[0] == expected[:3].any(dim=0)).all()
    assert (wide[1] == expected[:7].any(dim=0)).all()
    dilated = kinematic_robot_masks(*arguments, neighbour_frames=0, dilation=1)[0, 0, 1].bool()
    for y, x in torch.nonzero(tight[0, 0, 1]).tolist():
        assert dilated[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2].all()
    assert dilated.sum() > tight[0, 0, 1].sum()
    with pytest.raises(ConfigError, match="tokenizer"):
        kinematic_robot_masks(*moving_ball(8), SIZE, (8, 12))


GRID = (8, 12)


@pytest.fixture(scope="module")
def recordings(project_root):
    """The shipped episodes, and the number of a sound one of each robot."""
    root = project_root / "artifacts" / "shipped" / "recordings"
    episodes, defects = EpisodeSet.open(root), json.loads((root / "injected_defects.json").read_text())
    rows = enumerate(episodes.rows)
    return episodes, {row.embodiment: i for i, row in reversed(list(rows)) if row.episode_id not in defects}


@pytest.mark.parametrize("embodiment", ["panda_ivory", "ur5e_slate", "viperx_pearl", "xarm7_single"])
def test_kinematics_give_the_recorded_wrist_cameras_and_masks_that_cover_the_robot(recordings, embodiment):
    """One body of each model; that descriptions fit every body: test_tasks of the recorder."""
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
