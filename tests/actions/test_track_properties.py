"""What must hold for any robot, camera and grid: invariances of tracks and maps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from worldline_core.actions.action_maps import render_action_maps
from worldline_core.actions.action_tracks import FRAMES_AT_ONCE, project_tools
from worldline_core.actions.episode_tracks import TrackBatch

SEEDS = st.integers(0, 2**32 - 1)
VALUES = ("uv", "depth", "rot6d", "gripper")
any_scene = settings(max_examples=24, deadline=None, derandomize=True)
DEVICES = [
    "cpu",
    pytest.param(
        "cuda",
        marks=[pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device is here")],
    ),
]


def poses(rng, *shape, spread=1.0):
    T = np.zeros((*shape, 4, 4))
    turns = Rotation.from_quat(rng.normal(size=(math.prod(shape), 4)), scalar_first=True).as_matrix()
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = turns.reshape(*shape, 3, 3), rng.normal(0, spread, (*shape, 3)), 1.0
    return T


def random_scene(seed, frames=3, views=3, arms=2):
    """Tools around cameras that look about: roughly a quarter of the samples is in view, a half behind."""
    rng = np.random.default_rng(seed)
    size = (int(rng.integers(32, 481)), int(rng.integers(32, 641)))
    K = np.zeros((views, 3, 3))
    K[:, 0, 0], K[:, 1, 1] = rng.uniform(0.4, 1.2, views) * size[1], rng.uniform(0.4, 1.2, views) * size[0]
    K[:, 0, 2], K[:, 1, 2], K[:, 2, 2] = size[1] / 2 - 0.5, size[0] / 2 - 0.5, 1.0
    cameras, tools = poses(rng, frames, views), poses(rng, frames, arms, spread=0.4)
    # The first arm stands in front of the first camera, so that every scene has something to see.
    ahead = np.concatenate([rng.uniform(-0.1, 0.1, (frames, 2)), rng.uniform(0.3, 1.0, (frames, 1))], -1)
    tools[:, 0, :3, 3] = np.einsum("nij,nj->ni", cameras[:, 0, :3, :3], ahead) + cameras[:, 0, :3, 3]
    opening = rng.uniform(-0.2, 1.2, (frames, arms))
    return tuple(torch.from_numpy(x) for x in (tools, opening, K, cameras)), size


def batch_of(seen):
    return TrackBatch(*(getattr(seen, name)[None] for name in (*VALUES, "valid")))


def render(seen, size, grid=(6, 8), sigma=40.0):
    return render_action_maps(batch_of(seen), size, grid, sigma, dtype=torch.float64)[0]


@any_scene
@given(SEEDS)
def test_moving_base_camera_and_tool_together_changes_nothing(seed):
    (tools, opening, K, cameras), size = random_scene(seed)
    move = torch.from_numpy(poses(np.random.default_rng(seed + 1), spread=2.0))
    before = project_tools(tools, opening, K, cameras, size)
    after = project_tools(move @ tools, opening, K, move @ cameras, size)
    assert before.valid.any()
    assert torch.equal(before.cause, after.cause)
    for moved, still in ((getattr(seen, name)[before.valid] for seen in (after, before)) for name in VALUES):
        torch.testing.assert_close(moved, still, atol=1e-9, rtol=0)
    torch.testing.assert_close(render(after, size), render(before, size), atol=1e-10, rtol=0)


@any_scene
@given(SEEDS, st.sampled_from([2.0, 0.5, 3.0]), st.sampled_from([2.0, 0.25, 1.0]))
def test_tracks_of_a_resized_image_give_the_same_map(seed, scale_rows, scale_columns):
    (tools, opening, K, cameras), size = random_scene(seed)
    size = (size[0] // 4 * 4, size[1] // 4 * 4)
    other = (int(size[0] * scale_rows), int(size[1] * scale_columns))
    resize = torch.diag(torch.tensor([scale_columns, scale_rows, 1.0], dtype=torch.float64))
    resize[0, 2], resize[1, 2] = (scale_columns - 1) / 2, (scale_rows - 1) / 2
    before = project_tools(tools, opening, K, cameras, size)
    after = project_tools(tools, opening, resize @ K, cameras, other)
    assert torch.equal(before.valid, after.valid)
    torch.testing.assert_close(render(after, other), render(before, size), atol=1e-11, rtol=0)


@any_scene
@given(SEEDS)
def test_a_masked_sample_leaves_nothing_whatever_it_holds(seed):
    scene, size = random_scene(seed)
    batch = batch_of(project_tools(*scene, size))
    rng = np.random.default_rng(seed)
    keep = batch.valid & torch.from_numpy(rng.random(batch.valid.shape) < 0.5)
    junk = {name: getattr(batch, name).clone() for name in VALUES}
    for values in junk.values():
        values[~keep] = float(rng.choice([math.nan, math.inf, 1e300, 7.0]))
    maps = render_action_maps(replace(batch, valid=keep), size, (6, 8), 40.0)
    assert torch.equal(render_action_maps(TrackBatch(**junk, valid=keep), size, (6, 8), 40.0), maps)
    empty = ~keep.any(-1)  # b t v
    assert (maps.permute(0, 3, 1, 2, 4, 5)[empty] == 0).all()
    assert (maps[:, :, 0].amax((-1, -2)).permute(0, 2, 1)[~empty] > 0).all()


@pytest.mark.parametrize("moving", ["neither", "cameras and intrinsics"])
def test_a_long_recording_equals_its_frames(moving):
    """Long ones are projected in pieces, which must not show."""
    frames = 2 * FRAMES_AT_ONCE + 7
    (tools, opening, K, cameras), size = random_scene(5, frames=frames)
    cameras = cameras[:1] if moving == "neither" else cameras
    K = K.expand(frames, 3, 3, 3) if moving == "cameras and intrinsics" else K
    whole = project_tools(tools, opening, K, cameras, size)
    assert whole.uv.shape == (frames, 3, 2, 2)
    assert 0.01 < whole.valid.double().mean() < 0.99
    nested = project_tools(tools[None, :3], opening[None, :3], K[:3], cameras[None, :3], size)
    torch.testing.assert_close((nested.uv[0], nested.cause[0]), (whole.uv[:3], whole.cause[:3]), atol=1e-12, rtol=1e-12)
    for n in (0, FRAMES_AT_ONCE - 1, FRAMES_AT_ONCE, 2 * FRAMES_AT_ONCE, frames - 1):
        camera = cameras[0] if len(cameras) == 1 else cameras[n]
        one = project_tools(tools[n], opening[n], K[n] if K.ndim == 4 else K, camera, size)
        for name in (*VALUES, "valid", "cause"):
            torch.testing.assert_close(getattr(whole, name)[n], getattr(one, name), atol=1e-12, rtol=1e-12)


@pytest.mark.parametrize("device", DEVICES)
def test_projection_and_maps_run_where_their_inputs_are(device):
    scene, size = random_scene(3)
    here = project_tools(*scene, size)
    there = project_tools(*(x.to(device) for x in scene), size)
    assert there.uv.device.type == device
    for name in (*VALUES, "valid", "cause"):
        torch.testing.assert_close(getattr(there, name).cpu(), getattr(here, name), atol=1e-9, rtol=0)
    maps = render_action_maps(batch_of(here).to(device), size, (6, 8), 40.0)[0]
    assert maps.device.type == device
    torch.testing.assert_close(maps.cpu().double(), render(here, size), atol=1e-6, rtol=0)
