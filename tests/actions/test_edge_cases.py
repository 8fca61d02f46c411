"""Every edge case that docs/action_maps.md names: what is masked, why, and what is left of it in a map."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from worldline_core.actions.action_maps import render_action_maps
from worldline_core.actions.action_tracks import CAUSES, compute_tracks, project_tools
from worldline_core.actions.episode_tracks import TrackBatch, collate_tracks
from worldline_core.errors import DataError
from worldline_core.geometry.cameras import MIN_DEPTH_M

# Powers of two, so that pixels of the border are exact: u = 64 x / z + 47.5, v = 64 y / z + 31.5.
K = torch.tensor([[64.0, 0, 47.5], [0, 64.0, 31.5], [0, 0, 1.0]], dtype=torch.float64)
EYE = torch.eye(4, dtype=torch.float64)
SIZE = (64, 96)
VALID, BEHIND, OUTSIDE, INVALID = range(4)
COUNTED = ("valid", "behind_camera", "outside_image", "invalid_calibration")


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
        assert given.keys() == {"intrinsics"} or torch.isfinite(values).all()
    assert bool((rendered(seen) == 0).all()) == (cause != VALID)


@pytest.mark.parametrize(
    "camera",
    [
        pytest.param(EYE * 0, id="zeros"),
        pytest.param(broken(EYE, (0, 0, 1.1)), id="scaled"),
        pytest.param(broken(EYE, (2, 2, -1.0)), id="mirrored"),
        pytest.param(broken(EYE, (0, 1, 0.1)), id="sheared"),
        pytest.param(broken(EYE, (1, 3, math.nan)), id="NaN"),
        pytest.param(broken(EYE, (3, 2, 1.0)), id="translation in the last row"),
    ],
)
def test_extrinsics_that_are_not_rigid_mask_their_view_alone(camera):
    tool = EYE.clone()
    tool[2, 3] = 1.0
    seen = project_tools(
        tool.expand(2, 1, 4, 4), torch.full((2, 1), 0.5), torch.stack([K, K]), torch.stack([EYE, camera]), SIZE
    )
    assert seen.cause[..., 0].tolist() == [[VALID, INVALID]] * 2
    maps = rendered(seen)
    assert (maps[1] == 0).all()
    assert float(maps[0, 0].max()) > 0.5


def test_one_bad_frame_of_a_moving_camera_masks_that_frame():
    cameras = EYE.expand(4, 1, 4, 4).clone()
    cameras[2, 0, 0, 0] = math.nan
    tool = EYE.clone()
    tool[2, 3] = 1.0
    seen = project_tools(tool.expand(4, 1, 4, 4), torch.full((4, 1), 0.5), K[None], cameras, SIZE)
    assert seen.cause.flatten().tolist() == [VALID, VALID, INVALID, VALID]


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


def test_gripper_overshoot_is_clipped_and_counted(kinematics, episode):
    action = episode.action.copy()
    action[:, 3], action[:, 7] = 0.5, 1.0
    action[1, 3], action[4, 3], action[6, 7] = 1.25, -0.5, 1.0625
    tracks, counts = compute_tracks(replace(episode, action=action), kinematics)
    assert tracks.gripper[[1, 4], 0, 0].tolist() == [1.0, 0.0]
    assert tracks.gripper[6, 0, 1] == 1.0
    assert tracks.gripper[0, 0].tolist() == [0.5, 1.0]
    assert counts["gripper_clipped"] == 3


def test_masked_samples_of_an_episode_are_counted_by_cause(kinematics, episode):
    """A head camera that looks away, and a wrist camera whose matrix is singular."""
    cameras = dict(episode.cameras)
    away = cameras["head"].T_base_camera.copy()
    away[:, :3, 2] *= -1
    away[:, :3, 0] *= -1
    cameras["head"] = replace(cameras["head"], T_base_camera=away)
    cameras["left_wrist"] = replace(cameras["left_wrist"], K=np.zeros((3, 3)))
    tracks, counts = compute_tracks(replace(episode, cameras=cameras), kinematics)
    frames = tracks.num_frames
    assert counts["behind_camera"] >= 2 * frames
    assert counts["invalid_calibration"] == 2 * frames
    assert not tracks.valid[:, :2].any()
    assert tracks.valid[:, 2].any()
    assert sum(counts[cause] for cause in COUNTED) == counts["samples"] == 6 * frames


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
