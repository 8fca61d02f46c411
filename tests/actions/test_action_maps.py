"""Nine-channel maps: places, gradients and the frames that they are of; test_equation.py compares them with the equation."""

from __future__ import annotations

from dataclasses import replace

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
from worldline_core.actions.episode_tracks import SAMPLES, TrackBatch
from worldline_core.errors import ConfigError


def batch(seed=0, b=2, t=3, v=3, a=2, size=(480, 640)) -> TrackBatch:
    g = torch.Generator().manual_seed(seed)
    uv = torch.rand(b, t, v, a, 2, generator=g) * torch.tensor([size[1], size[0]]).float() - 0.5
    return TrackBatch(
        uv=uv,
        depth=torch.rand(b, t, v, a, generator=g) + 0.2,
        rot6d=torch.rand(b, t, v, a, 6, generator=g) * 2 - 1,
        gripper=torch.rand(b, t, v, a, generator=g),
        valid=torch.rand(b, t, v, a, generator=g) > 0.3,
    )


def test_sigma_of_the_paper_on_its_grid_and_on_each_axis_by_itself():
    assert grid_sigma((30, 40)) == pytest.approx((0.78125, 0.78125))
    assert grid_sigma((384, 256)) == pytest.approx((10.0, 5.0))


@pytest.mark.parametrize("mask", [(True, False), (True, True)])
def test_gradcheck(mask):
    """In uv, depth, Rot6D and opening; the gradient of a masked sample is zero."""
    tracks = batch(b=1, t=1, v=2, size=(64, 96))
    valid = torch.tensor(mask).expand(1, 1, 2, 2)
    inputs = [x.double().requires_grad_() for x in (tracks.uv, tracks.depth, tracks.rot6d, tracks.gripper)]

    def render(uv, depth, rot6d, gripper):
        return render_action_maps(
            TrackBatch(uv, depth, rot6d, gripper, valid), (64, 96), (3, 4), 80.0, dtype=torch.float64
        )

    assert torch.autograd.gradcheck(render, inputs)


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
    both = (
        ControlDrawing(grid, 10.0, 5, per_latent_frame)
        .draw(given, size, by_vector)
        .unflatten(2, (per_latent_frame, 15))
    )
    vectors = ControlDrawing(grid, None, 5, per_latent_frame).draw(given, size).unflatten(2, (per_latent_frame, 6))
    assert vectors.shape[-2:] == (1, 1)
    assert torch.equal(vectors[:, 0, 0, :5, 0, 0, 0], native[:, 0])
    for clip in range(2):
        for view in range(3):
            vector = clip == 0 and view > 0
            drawn = torch.zeros_like(both[clip, view, :, :9]) if vector else maps.unflatten(2, (-1, 9))[clip, view]
            assert torch.equal(both[clip, view, :, :9], drawn)
            assert torch.equal(both[clip, view, :, 9:], vectors[clip, view].expand(-1, -1, -1, *grid) * vector)


@pytest.mark.parametrize("num_frames", [0, 16, 34])
def test_clip_that_does_not_fit_is_refused(num_frames):
    with pytest.raises(ConfigError, match="does not fit the tokenizer"):
        latent_frame_indices(num_frames)


def test_nonsense_sizes_are_refused():
    with pytest.raises(ConfigError, match="Cannot render action maps"):
        render_action_maps(batch(), (480, 640), (0, 40))
