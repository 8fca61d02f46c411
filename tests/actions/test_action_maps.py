"""Nine-channel maps: the frames that they are of, and, from joint angles on, their equation.

The equation is written out in plain float64 loops that share no code with the core. They measure distances on the
384 x 512 reference canvas, in its pixels, where sigma is what the paper says; the renderer works in cells of the grid.
That both agree is the meaning of "sigma scales with the target grid".
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from worldline_core.actions.action_maps import (
    ControlDrawing,
    control_frames,
    grid_sigma,
    latent_frame_indices,
    render_action_maps,
    stack_controls,
)
from worldline_core.actions.action_tracks import CAUSES, compute_tracks, project_tools
from worldline_core.actions.episode_tracks import SAMPLES, TrackBatch, collate_tracks
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.errors import ConfigError


def batch(b=2, t=3, v=3, a=2, size=(480, 640)) -> TrackBatch:
    random = partial(torch.rand, generator=torch.Generator().manual_seed(0))
    shape = b, t, v, a
    uv = random(*shape, 2) * torch.tensor([size[1], size[0]]).float() - 0.5
    depth, rot6d, gripper = random(shape) + 0.2, random(*shape, 6) * 2 - 1, random(shape)
    return TrackBatch(uv=uv, depth=depth, rot6d=rot6d, gripper=gripper, valid=random(shape) > 0.3)


def test_sigma_of_the_paper_on_its_grid_and_on_each_axis_by_itself():
    assert grid_sigma((30, 40)) == pytest.approx((0.78125, 0.78125))
    assert grid_sigma((384, 256)) == pytest.approx((10.0, 5.0))


def test_controls_of_a_whole_interval_begin_with_those_of_the_latent_frame_itself():
    assert control_frames(9) == latent_frame_indices(9) == [0, 4, 8]
    assert control_frames(9, 4) == [0, 0, 0, 0, 4, 3, 2, 1, 8, 7, 6, 5]


def test_a_gripper_that_closes_and_opens_between_latent_frames_is_seen_in_the_whole_interval_alone():
    still, moved = batch(b=1, t=9, v=2, a=1), batch(b=1, t=9, v=2, a=1)
    for tracks in (still, moved):
        tracks.valid[:] = True
        tracks.uv[:] = torch.tensor([300.0, 200.0])
        tracks.gripper[:] = 1.0
    moved.gripper[:, 6] = 0.0

    def maps(tracks: TrackBatch, per_latent_frame: int) -> torch.Tensor:
        frames = control_frames(9, per_latent_frame)
        cut = TrackBatch(*(getattr(tracks, name)[:, frames] for name in SAMPLES))
        return stack_controls(render_action_maps(cut, (480, 640), (30, 40)), per_latent_frame)

    assert torch.equal(maps(still, 1), maps(moved, 1))
    between = maps(still, 4) - maps(moved, 4)
    changed = between.abs().amax(dim=(0, 1, 4, 5)) > 0.5
    # Frame 6 is the third of latent frame 2's: 8, 7, 6, 5; the gripper is the ninth channel.
    assert changed.nonzero().tolist() == [[2 * 9 + 8, 2]]
    assert torch.equal(maps(still, 4)[:, :, :9], maps(still, 1))


@pytest.mark.parametrize("per_latent_frame", [1, 4])
def test_every_view_takes_its_map_or_the_vector(per_latent_frame):
    """Maps alone are the rendered ones bit by bit; the vector is in every cell, with 1 behind it, and zeros are no controls."""
    tracks, size, grid = batch(t=3 * per_latent_frame), (480, 640), (30, 40)
    maps, everywhere = stack_controls(render_action_maps(tracks, size, grid), per_latent_frame), torch.ones(2, 3) > 0
    assert torch.equal(ControlDrawing(grid, 10.0, frames=per_latent_frame).draw(tracks, size, everywhere), maps)
    native = torch.randn(2, 3 * per_latent_frame, 5, generator=torch.Generator().manual_seed(1))
    camera = torch.tensor([[True, False, True], [True, True, True]])[:, None].expand(2, 3 * per_latent_frame, 3)
    given = replace(tracks, native=native, camera=camera)
    by_vector = torch.tensor([[False, False, True], [False, False, False]])
    drawing, plain = (ControlDrawing(grid, sigma, 5, per_latent_frame) for sigma in (10.0, None))
    both = drawing.draw(given, size, by_vector).unflatten(2, (per_latent_frame, 15))
    vectors = plain.draw(given, size).unflatten(2, (per_latent_frame, 6))
    assert vectors.shape[-2:] == (1, 1)
    assert torch.equal(vectors[:, 0, 0, :5, 0, 0, 0], native[:, 0])
    for clip in range(2):
        for view in range(3):
            vector = clip == 0 and view > 0
            drawn = torch.zeros_like(both[clip, view, :, :9]) if vector else maps.unflatten(2, (-1, 9))[clip, view]
            assert torch.equal(both[clip, view, :, :9], drawn)
            assert torch.equal(both[clip, view, :, 9:], vectors[clip, view].expand(-1, -1, -1, *grid) * vector)


def test_clips_and_sizes_that_do_not_fit_are_refused():
    for num_frames in (0, 16, 34):
        with pytest.raises(ConfigError, match="tokenizer"):
            latent_frame_indices(num_frames)
    with pytest.raises(ConfigError, match="Cannot render"):
        render_action_maps(batch(), (480, 640), (0, 40))


NEAREST_M = 0.01
LARGE = (480, 640)


def reference_sample(T_base_tool, opening, K, T_base_camera, image_size):
    """(u, v, nine values) of a tool in a view, or None where the sample is masked."""
    T = np.linalg.inv(np.array(T_base_camera, dtype=np.float64)) @ np.array(T_base_tool, dtype=np.float64)
    x, y, z = (float(T[i, 3]) for i in range(3))
    if z <= NEAREST_M:
        return None
    u = (float(K[0][0]) * x + float(K[0][1]) * y) / z + float(K[0][2])
    v = float(K[1][1]) * y / z + float(K[1][2])
    if not (-0.5 <= u < image_size[1] - 0.5 and -0.5 <= v < image_size[0] - 0.5):
        return None
    rotation = [float(T[row, column]) for column in (0, 1) for row in (0, 1, 2)]
    return u, v, [1.0, z, *rotation, min(max(float(opening), 0.0), 1.0)]


def reference_map(samples, image_size, grid, sigma, canvas=(384, 512)):
    """(9, rows, columns) float64: the sum over the arms of value times Gaussian, cell by cell."""
    out = np.zeros((9, *grid))
    for u, v, values in filter(None, samples):
        for row in range(grid[0]):
            for column in range(grid[1]):
                across = ((column + 0.5) / grid[1] - (u + 0.5) / image_size[1]) * canvas[1]
                down = ((row + 0.5) / grid[0] - (v + 0.5) / image_size[0]) * canvas[0]
                h = math.exp(-(across**2 + down**2) / (2.0 * sigma**2))
                for channel in range(9):
                    out[channel, row, column] += values[channel] * h
    return out


def reference_maps(tools, openings, K, cameras, image_size, grid, sigma):
    """(views, 9, frames, rows, columns); tools (n, a, 4, 4), openings (n, a), K (v, 3, 3), cameras (n, v, 4, 4)."""
    out = np.zeros((len(K), 9, len(tools), *grid))
    visible = 0
    for n in range(len(tools)):
        for v in range(len(K)):
            arms = zip(tools[n], openings[n], strict=True)
            samples = [reference_sample(*arm, K[v], cameras[n][v], image_size) for arm in arms]
            visible += sum(sample is not None for sample in samples)
            out[v, :, n] = reference_map(samples, image_size, grid, sigma)
    return out, visible


@pytest.fixture
def scene(kinematics, episode):
    """The small robot in frames of 480 x 640, and its poses, openings and cameras in float64."""
    cameras = {view: camera.resized(LARGE[1], LARGE[0]) for view, camera in episode.cameras.items()}
    large = replace(episode, cameras=cameras)
    action = episode.action.astype(np.float64)
    wrists = kinematics.wrist_camera_poses(action)
    head = np.repeat(cameras["head"].T_base_camera[:1], len(action), axis=0)
    poses = np.stack([head, *(wrists[view].numpy() for view in VIEWS[1:])], axis=1)
    K = np.stack([cameras[view].K for view in VIEWS])
    return large, kinematics.tool_poses(action).numpy(), kinematics.gripper(action).numpy(), K, poses


@pytest.mark.parametrize(("grid", "sigma"), [((8, 12), 36.0), ((15, 20), 5.0), ((7, 3), 80.0)])
def test_maps_of_an_episode_equal_the_equation_to_1e_6(kinematics, scene, grid, sigma):
    episode, tools, openings, K, poses = scene
    frames = [0, 4, 8]
    tracks, _ = compute_tracks(episode, kinematics)
    maps = render_action_maps(collate_tracks([tracks.clip(frames)]), LARGE, grid, sigma)[0]
    expected, visible = reference_maps(tools[frames], openings[frames], K, poses[frames], LARGE, grid, sigma)
    assert visible >= 8
    assert maps.dtype == torch.float32
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(maps.numpy(), expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("arms", [1, 2])
@pytest.mark.parametrize("views", [1, 3])
def test_what_is_left_is_float32_rounding(scene, arms, views):
    """In float64 the same code agrees with the equation to 1e-12: float32 output is rounded, not approximated."""
    _, tools, openings, K, poses = scene
    tools, openings, K, poses = tools[:, :arms], openings[:, :arms], K[:views], poses[:, :views]
    seen = project_tools(*(torch.from_numpy(x) for x in (tools, openings, K, poses)), LARGE)
    batch = TrackBatch(*(x[None] for x in (seen.uv, seen.depth, seen.rot6d, seen.gripper, seen.valid)))
    expected, visible = reference_maps(tools, openings, K, poses, LARGE, (30, 40), 10.0)
    assert visible == int(seen.valid.sum()) > 5
    exact = render_action_maps(batch, LARGE, (30, 40), dtype=torch.float64)[0]
    np.testing.assert_allclose(exact.numpy(), expected, atol=1e-12, rtol=0)
    rounded = render_action_maps(batch, LARGE, (30, 40))[0]
    np.testing.assert_allclose(rounded.numpy(), expected, atol=5e-7, rtol=0)


def test_stored_pixels_are_float64(kinematics, scene):
    """Pixels rounded to float32 would alone move the map of a 640 wide frame by more than 1e-6."""
    episode, tools, openings, K, poses = scene
    tracks, counts = compute_tracks(episode, kinematics)
    assert tracks.views == VIEWS
    assert tracks.camera_motion == ("static", "kinematics", "kinematics")
    clipped = (episode.action[:, [3, 7]] > 1) | (episode.action[:, [3, 7]] < 0)
    assert counts["gripper_clipped"] == clipped.sum() > 0
    assert counts["samples"] == sum(counts[cause] for cause in CAUSES) == tracks.valid.size
    assert counts["valid"] == tracks.valid.sum()
    for n, v, a in np.argwhere(tracks.valid):
        u, w, values = reference_sample(tools[n, a], openings[n, a], K[v], poses[n, v], LARGE)
        np.testing.assert_allclose(tracks.uv[n, v, a], (u, w), atol=1e-9, rtol=0)
        np.testing.assert_allclose(tracks.depth[n, v, a], values[1], atol=1e-7, rtol=0)
        np.testing.assert_allclose(tracks.rot6d[n, v, a], values[2:8], atol=1e-7, rtol=0)
        np.testing.assert_allclose(tracks.gripper[n, v, a], values[8], atol=1e-7, rtol=0)


def test_gradcheck_from_joint_angles_to_the_map(kinematics, episode):
    """Through forward kinematics (tools and wrist cameras), projection and rendering, by finite differences."""
    K = torch.from_numpy(np.stack([episode.cameras[view].K for view in VIEWS]))
    head = torch.from_numpy(episode.cameras["head"].T_base_camera)
    state = torch.from_numpy(episode.action[[5]].astype(np.float64))
    state[:, [3, 7]] = torch.tensor([0.3, 0.8], dtype=torch.float64)

    weights = torch.rand(4, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def render(joints):
        links = kinematics.link_poses(joints)
        wrists = kinematics.wrist_cameras_of(links)
        cameras = torch.stack([head.expand(len(joints), 4, 4), *(wrists[view] for view in VIEWS[1:])], dim=1)
        seen = project_tools(kinematics.tools_of(links), kinematics.gripper(joints), K, cameras, (64, 96))
        assert int(seen.valid.sum()) >= 3
        batch = TrackBatch(*(x[None] for x in (seen.uv, seen.depth, seen.rot6d, seen.gripper, seen.valid)))
        maps = render_action_maps(batch, (64, 96), (4, 6), 60.0, dtype=torch.float64)
        # One random weighing of the cells for each view and channel: fewer backward passes, no path left out.
        return (maps * weights).sum((-1, -2))

    assert torch.autograd.gradcheck(render, (state.requires_grad_(),))
