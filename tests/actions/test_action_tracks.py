"""Tracks: projection, masking and its counts, where camera poses come from, clips."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from worldline_core.actions.action_maps import render_action_maps
from worldline_core.actions.action_tracks import CAUSES, compute_tracks, count_samples, project_tools
from worldline_core.actions.episode_tracks import TrackBatch, collate_tracks
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


def rendered(seen, grid=(8, 12), sigma=36.0):
    batch = TrackBatch(*(x[None] for x in (seen.uv, seen.depth, seen.rot6d, seen.gripper, seen.valid)))
    return render_action_maps(batch, SIZE, grid, sigma)[0]


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
    for values in (seen.uv, seen.depth, seen.rot6d, seen.gripper):
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
    names = ("uv", "depth", "rot6d", "gripper", "valid")
    single = replace(tracks, arms=("right",), **{name: getattr(tracks, name)[:, :, 1:] for name in names})
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
