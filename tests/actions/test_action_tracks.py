"""Tracks: projection, masking and its counts, where camera poses come from, clips."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.episode_tracks import collate_tracks
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.errors import CalibrationError, DataError


def test_tracks_equal_a_plain_transcription(kinematics, episode):
    tracks, counts = compute_tracks(episode, kinematics)
    tools = kinematics.tool_poses(episode.action.astype(np.float64)).numpy()
    wrists = kinematics.wrist_camera_poses(episode.action.astype(np.float64))
    assert tracks.views == VIEWS
    assert tracks.camera_motion == ("static", "kinematics", "kinematics")
    checked = 0
    for n in range(tracks.num_frames):
        for v, view in enumerate(VIEWS):
            camera = episode.cameras["head"].T_base_camera[0] if view == "head" else wrists[view][n].numpy()
            for a in range(2):
                T = np.linalg.inv(camera) @ tools[n, a]
                pixel = episode.cameras[view].K @ (T[:3, 3] / T[2, 3])
                inside = T[2, 3] > 0.01 and -0.5 <= pixel[0] < 95.5 and -0.5 <= pixel[1] < 63.5
                assert bool(tracks.valid[n, v, a]) == inside
                if inside:
                    np.testing.assert_allclose(tracks.uv[n, v, a], pixel[:2], atol=1e-4)
                    np.testing.assert_allclose(tracks.depth[n, v, a], T[2, 3], atol=1e-6)
                    np.testing.assert_allclose(tracks.rot6d[n, v, a], T[:3, :2].T.reshape(-1), atol=1e-6)
                    checked += 1
    assert checked > 20
    assert counts["samples"] == tracks.num_frames * 6
    assert (
        sum(counts[c] for c in ("valid", "behind_camera", "outside_image", "invalid_calibration")) == counts["samples"]
    )
    assert (
        counts["gripper_clipped"] == int(((episode.action[:, [3, 7]] > 1) | (episode.action[:, [3, 7]] < 0)).sum()) > 0
    )


def test_future_observations_do_not_matter(kinematics, episode):
    """Whatever is measured or seen after the first frame, the tracks of given commands stay the same."""
    rng = np.random.default_rng(0)
    state = episode.state.copy()
    state[1:] += rng.normal(0, 0.3, state[1:].shape).astype(np.float32)
    cameras = dict(episode.cameras)
    for view in ("left_wrist", "right_wrist"):
        poses = cameras[view].T_base_camera.copy()
        poses[1:, :3, 3] += 0.2
        cameras[view] = replace(cameras[view], T_base_camera=poses)
    head = np.repeat(cameras["head"].T_base_camera, len(state), axis=0)
    head[1:, :3, 3] += 0.1
    cameras["head"] = replace(cameras["head"], T_base_camera=head)
    first, _ = compute_tracks(episode, kinematics)
    second, _ = compute_tracks(replace(episode, state=state, cameras=cameras), kinematics)
    for name in ("uv", "depth", "rot6d", "gripper", "valid", "T_base_camera", "capsules"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_state_or_action_may_be_projected(kinematics, episode):
    by_action, _ = compute_tracks(episode, kinematics, controls="action")
    by_state, _ = compute_tracks(episode, kinematics, controls="state")
    assert (by_action.controls, by_state.controls) == ("action", "state")
    expected = kinematics.tool_poses(episode.state.astype(np.float64)).float().numpy()
    np.testing.assert_allclose(by_state.T_base_tool, expected, atol=1e-6)
    assert np.abs(by_state.T_base_tool - by_action.T_base_tool).max() > 1e-4


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


def test_own_gripper_stands_still_in_its_wrist_camera(kinematics, episode):
    tracks, _ = compute_tracks(episode, kinematics)
    left = VIEWS.index("left_wrist")
    assert np.ptp(tracks.uv[:, left, 0], axis=0).max() < 1e-3


def test_clips_outside_of_the_episode_or_of_another_length_are_refused(kinematics, episode):
    tracks, _ = compute_tracks(episode, kinematics)
    with pytest.raises(DataError, match=r"Frames outside of the action tracks[\s\S]*0\.\.8"):
        tracks.clip([0, 9])
    with pytest.raises(DataError, match="do not fit together"):
        collate_tracks([tracks, tracks.clip([0, 1])])


def test_what_cannot_be_projected_is_refused(kinematics, episode):
    with pytest.raises(CalibrationError, match="no calibrated camera"):
        compute_tracks(replace(episode, cameras={}), kinematics)
    with pytest.raises(DataError, match="Joints without kinematics"):
        compute_tracks(episode, None)
    action = episode.action.copy()
    action[3, 1] = np.nan
    with pytest.raises(DataError, match=r"not finite[\s\S]*frame 3, left/lift"):
        compute_tracks(replace(episode, action=action), kinematics)
