"""Tracks: projection, masking and its counts, sources of camera poses, clips; and what holds for any robot and camera."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given as drawn
from hypothesis import settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from worldline_core.actions.action_maps import render_action_maps
from worldline_core.actions.action_tracks import (
    CAUSES,
    FRAMES_AT_ONCE,
    compute_tracks,
    count_samples,
    project_tools,
)
from worldline_core.actions.episode_tracks import SAMPLES, TrackBatch, collate_tracks
from worldline_core.errors import CalibrationError, DataError
from worldline_core.geometry.cameras import MIN_DEPTH_M


def test_future_observations_do_not_matter(kinematics, episode):
    """Whatever is measured or seen after the first frame, the tracks of given commands stay the same."""
    state, cameras = episode.state.copy(), dict(episode.cameras)
    state[1:] += np.random.default_rng(0).normal(0, 0.3, state[1:].shape).astype(np.float32)
    for view, camera in cameras.items():
        poses = np.broadcast_to(camera.T_base_camera, (len(state), 4, 4)).copy()
        poses[1:, :3, 3] += 0.2
        cameras[view] = replace(camera, T_base_camera=poses)
    first, _ = compute_tracks(episode, kinematics)
    second, _ = compute_tracks(replace(episode, state=state, cameras=cameras), kinematics)
    for name in ("uv", "depth", "rot6d", "gripper", "valid", "T_base_camera", "capsules"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_without_a_mount_extrinsics_are_recorded_or_solved_once(kinematics, episode):
    poses = kinematics.tool_poses(episode.state.astype(np.float64)).numpy()
    recorded = replace(episode, T_base_ee=poses, gripper=np.ones((len(poses), 2)))
    tracks, _ = compute_tracks(recorded, None, controls="state")
    assert tracks.controls == "ee_pose"
    assert tracks.camera_motion == ("static", "recorded", "recorded")
    np.testing.assert_allclose(tracks.T_base_camera[:, 1], episode.cameras["left_wrist"].T_base_camera, atol=1e-6)
    solved, _ = compute_tracks(recorded, None, controls="state", without_mount="first_frame_mount")
    assert solved.camera_motion == ("static", "first_frame_mount", "first_frame_mount")
    # The cameras are rigidly mounted, so the mount of the first frame explains all frames.
    np.testing.assert_allclose(solved.T_base_camera, tracks.T_base_camera, atol=1e-6)


def test_missing_view_is_never_valid_and_is_not_counted(kinematics, episode):
    cameras = {view: camera for view, camera in episode.cameras.items() if view != "left_wrist"}
    tracks, counts = compute_tracks(replace(episode, cameras=cameras), kinematics)
    assert tracks.camera_motion[1] == "absent"
    assert not tracks.valid[:, 1].any()
    assert counts["samples"] == tracks.num_frames * 4
    assert counts["invalid_calibration"] == 0


def test_what_cannot_be_projected_is_refused(kinematics, episode):
    tracks, _ = compute_tracks(episode, kinematics)
    with pytest.raises(DataError, match=r"Frames outside[\s\S]*0\.\.8"):
        tracks.clip([0, 9])
    with pytest.raises(DataError, match="do not fit together"):
        collate_tracks([tracks, tracks.clip([0, 1])])
    with pytest.raises(CalibrationError, match="no calibrated camera"):
        compute_tracks(replace(episode, cameras={}), kinematics)
    with pytest.raises(DataError, match="Joints without kinematics"):
        compute_tracks(episode, None)
    action = episode.action.copy()
    action[3, 1] = np.nan
    with pytest.raises(DataError, match=r"not finite[\s\S]*frame 3, left/lift"):
        compute_tracks(replace(episode, action=action), kinematics)


NUMBERS = SAMPLES[:4]
# Powers of two, so that pixels of the border are exact: u = 64 x / z + 47.5, v = 64 y / z + 31.5.
K = torch.tensor([[64.0, 0, 47.5], [0, 64.0, 31.5], [0, 0, 1.0]], dtype=torch.float64)
EYE = torch.eye(4, dtype=torch.float64)
SIZE = (64, 96)
VALID, BEHIND, OUTSIDE, INVALID = range(4)


def see(point, *, gripper=0.5, intrinsics=K, camera=EYE):
    tool = EYE.clone()
    tool[:3, 3] = torch.tensor(point, dtype=torch.float64)
    opening = torch.tensor([[gripper]], dtype=torch.float64)
    return project_tools(tool[None, None], opening, intrinsics[None], camera[None, None], SIZE)


def batch_of(seen):
    return TrackBatch(*(getattr(seen, name)[None] for name in SAMPLES))


def rendered(seen, size=SIZE):
    return render_action_maps(batch_of(seen), size, (6, 8), 40.0, dtype=torch.float64)[0]


def broken(matrix, *entries):
    copy = matrix.clone()
    for row, column, value in entries:
        copy[row, column] = value
    return copy


INVALID_VALUES = {
    "intrinsics of zeros": {"intrinsics": K * 0},
    "no focal length": {"intrinsics": broken(K, (0, 0, 0.0))},
    "negative focal length": {"intrinsics": broken(K, (1, 1, -64.0))},
    "NaN in the intrinsics": {"intrinsics": broken(K, (0, 2, math.nan))},
    "last row": {"intrinsics": broken(K, (2, 2, 2.0))},
    "transposed": {"intrinsics": K.mT},
    "camera of zeros": {"camera": EYE * 0},
    "scaled camera": {"camera": broken(EYE, (0, 0, 1.1))},
    "mirrored camera": {"camera": broken(EYE, (2, 2, -1.0))},
    "sheared camera": {"camera": broken(EYE, (0, 1, 0.1))},
    "NaN in the camera": {"camera": broken(EYE, (1, 3, math.nan))},
    "translation in the last row": {"camera": broken(EYE, (3, 2, 1.0))},
    **{f"opening {value}": {"gripper": value} for value in (math.nan, math.inf, -math.inf)},
}
POINTS = {
    "in view": ((0.0, 0.0, 1.0), VALID),
    "behind": ((0.0, 0.0, -1.0), BEHIND),
    "depth 0": ((0.0, 0.0, 0.0), BEHIND),
    "on the camera plane, off the axis": ((0.3, 0.1, 0.0), BEHIND),
    "depth minus 0": ((0.0, 0.0, -0.0), BEHIND),
    "exactly at the least depth": ((0.0, 0.0, MIN_DEPTH_M), BEHIND),
    "just beyond the least depth": ((0.0, 0.0, math.nextafter(MIN_DEPTH_M, 1)), VALID),
    "u = -0.5": ((-0.75, 0.0, 1.0), VALID),
    "u just below -0.5": ((math.nextafter(-0.75, -1), 0.0, 1.0), OUTSIDE),
    "u = W - 0.5": ((0.75, 0.0, 1.0), OUTSIDE),
    "u just below W - 0.5": ((0.75 - 1e-12, 0.0, 1.0), VALID),
    "v = -0.5": ((0.0, -0.5, 1.0), VALID),
    "v just below -0.5": ((0.0, math.nextafter(-0.5, -1), 1.0), OUTSIDE),
    "v = H - 0.5": ((0.0, 0.5, 1.0), OUTSIDE),
    "v just below H - 0.5": ((0.0, 0.5 - 1e-12, 1.0), VALID),
    "behind before outside": ((9.0, 9.0, -1.0), BEHIND),
    "NaN pose": ((math.nan, 0.0, 1.0), INVALID),
    "NaN depth": ((0.0, 0.0, math.nan), INVALID),
    "infinite pose": ((math.inf, 0.0, 1.0), INVALID),
}
CASES = {name: (point, cause, {}) for name, (point, cause) in POINTS.items()}
CASES |= {name: ((0.0, 0.0, 1.0), INVALID, given) for name, given in INVALID_VALUES.items()}


@pytest.mark.parametrize(("point", "cause", "given"), CASES.values(), ids=CASES)
def test_cause_of_a_masked_sample(point, cause, given):
    seen = see(point, **given)
    assert CAUSES[int(seen.cause)] == CAUSES[cause]
    assert bool(seen.valid) == (cause == VALID)
    for values in (getattr(seen, name) for name in NUMBERS):
        assert given.keys() & {"intrinsics", "camera"} or torch.isfinite(values).all()
    assert bool((rendered(seen) == 0).all()) == (cause != VALID)


def test_one_bad_frame_of_a_moving_camera_masks_that_frame_of_its_view():
    cameras = EYE.expand(4, 2, 4, 4).clone()
    cameras[2, 1, 0, 0] = math.nan
    tool = broken(EYE, (2, 3, 1.0)).expand(4, 1, 4, 4)
    seen = project_tools(tool, torch.full((4, 1), 0.5), torch.stack([K, K]), cameras, SIZE)
    assert (seen.cause == VALID).flatten(1).tolist() == [[True, n != 2] for n in range(4)]
    assert (rendered(seen)[1, :, 2] == 0).all()
    counts = count_samples(seen.cause, torch.full((4, 1), 1.5), 3)
    assert counts == dict.fromkeys(CAUSES, 0) | {
        "episodes": 1, "samples": 8, "valid": 7, "invalid_calibration": 1, "outside_joint_limits": 3, "gripper_clipped": 4,
    }  # fmt: skip


def test_gradient_of_a_masked_sample_is_finite():
    tools = EYE.expand(1, 4, 4, 4).clone()
    tools[0, :, 2, 3] = torch.tensor([1.0, 0.0, -1.0, math.nan], dtype=torch.float64)
    tools.requires_grad_()
    opening = torch.tensor([[0.5, 0.5, math.nan, 0.5]], dtype=torch.float64, requires_grad=True)
    # The camera and its matrix serve every tool: an unknown one must not spoil their gradients either.
    intrinsics, camera = K[None].clone().requires_grad_(), EYE[None, None].clone().requires_grad_()
    seen = project_tools(tools, opening, intrinsics, camera, SIZE)
    rendered(seen).sum().backward()
    for given in (tools, opening, intrinsics, camera):
        assert given.grad is not None
        assert torch.isfinite(given.grad).all()
    assert (tools.grad[0, 1:] == 0).all()
    assert (tools.grad[0, 0] != 0).any()


def test_episodes_with_one_arm_and_with_two_share_a_batch(kinematics, episode):
    tracks, _ = compute_tracks(episode, kinematics)
    single = replace(tracks, arms=("right",), **{name: getattr(tracks, name)[:, :, 1:] for name in SAMPLES})
    maps = render_action_maps(collate_tracks([tracks, single]), SIZE, (8, 12), 36.0)
    alone = render_action_maps(collate_tracks([single]), SIZE, (8, 12), 36.0)
    torch.testing.assert_close(maps[1], alone[0], atol=1e-7, rtol=0)
    assert (maps[0] - maps[1]).abs().max() > 0.5


@pytest.mark.parametrize(
    ("pose", "gripper", "fault"),
    [
        ((5, 1, 0, 0, math.nan), 1.0, r"not finite, or not rigid[\s\S]*frame 5, arm 1"),
        ((5, 1, 0, 3, math.inf), 1.0, r"not finite, or not rigid[\s\S]*frame 5, arm 1"),
        ((0, 0, 0, 0, 1000.0), 1.0, r"not rigid[\s\S]*frame 0, arm 0"),
        (None, math.nan, r"finite gripper opening[\s\S]*frame 3, arm 0"),
        (None, None, r"gripper opening[\s\S]*\(9, 2\)"),
    ],
)
def test_recorded_poses_that_are_no_poses_are_refused(kinematics, episode, pose, gripper, fault):
    poses = kinematics.tool_poses(episode.state.astype(np.float64)).numpy().copy()
    opening = np.ones((len(poses), 2))
    if pose is not None:
        poses[pose[:4]] = pose[4]
    elif gripper is not None:
        opening[3, 0] = gripper
    recorded = replace(episode, T_base_ee=poses, gripper=opening if gripper is not None else opening[:, :1])
    with pytest.raises(DataError, match=fault):
        compute_tracks(recorded, None, controls="state")


SEEDS = st.integers(0, 2**32 - 1)
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


@any_scene
@drawn(SEEDS)
def test_moving_base_camera_and_tool_together_changes_nothing(seed):
    (tools, opening, K, cameras), size = random_scene(seed)
    move = torch.from_numpy(poses(np.random.default_rng(seed + 1), spread=2.0))
    before = project_tools(tools, opening, K, cameras, size)
    after = project_tools(move @ tools, opening, K, move @ cameras, size)
    assert before.valid.any()
    assert torch.equal(before.cause, after.cause)
    for moved, still in ((getattr(seen, name)[before.valid] for seen in (after, before)) for name in NUMBERS):
        torch.testing.assert_close(moved, still, atol=1e-9, rtol=0)
    torch.testing.assert_close(rendered(after, size), rendered(before, size), atol=1e-10, rtol=0)


@any_scene
@drawn(SEEDS, st.sampled_from([2.0, 0.5, 3.0]), st.sampled_from([2.0, 0.25, 1.0]))
def test_tracks_of_a_resized_image_give_the_same_map(seed, scale_rows, scale_columns):
    (tools, opening, K, cameras), size = random_scene(seed)
    size = (size[0] // 4 * 4, size[1] // 4 * 4)
    other = (int(size[0] * scale_rows), int(size[1] * scale_columns))
    resize = torch.diag(torch.tensor([scale_columns, scale_rows, 1.0], dtype=torch.float64))
    resize[0, 2], resize[1, 2] = (scale_columns - 1) / 2, (scale_rows - 1) / 2
    before = project_tools(tools, opening, K, cameras, size)
    after = project_tools(tools, opening, resize @ K, cameras, other)
    assert torch.equal(before.valid, after.valid)
    torch.testing.assert_close(rendered(after, other), rendered(before, size), atol=1e-11, rtol=0)


@any_scene
@drawn(SEEDS)
def test_a_masked_sample_leaves_nothing_whatever_it_holds(seed):
    scene, size = random_scene(seed)
    batch = batch_of(project_tools(*scene, size))
    rng = np.random.default_rng(seed)
    keep = batch.valid & torch.from_numpy(rng.random(batch.valid.shape) < 0.5)
    junk = {name: getattr(batch, name).clone() for name in NUMBERS}
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
        for name in (*SAMPLES, "cause"):
            torch.testing.assert_close(getattr(whole, name)[n], getattr(one, name), atol=1e-12, rtol=1e-12)


@pytest.mark.parametrize("device", DEVICES)
def test_projection_and_maps_run_where_their_inputs_are(device):
    scene, size = random_scene(3)
    here = project_tools(*scene, size)
    there = project_tools(*(x.to(device) for x in scene), size)
    assert there.uv.device.type == device
    for name in (*SAMPLES, "cause"):
        torch.testing.assert_close(getattr(there, name).cpu(), getattr(here, name), atol=1e-9, rtol=0)
    maps = render_action_maps(batch_of(here).to(device), size, (6, 8), 40.0)[0]
    assert maps.device.type == device
    torch.testing.assert_close(maps.cpu().double(), rendered(here, size), atol=1e-6, rtol=0)
