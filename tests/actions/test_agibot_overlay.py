"""The end-effectors of the AgiBot samples land where hand-computed numbers, and their overlays, put them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.data.episodes.conventions import along_tool_z
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.sources.agibot import AgibotGesimSource, AgibotGesimSourceConfig
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import pose_from_euler_fixed_xyz

# Tool centres at frame 0, read off overlay_sample_0.png, overlay_sample_1.png and overlay_demo_000.png (circles; in
# pixels of the recorded frames, sheet scale undone): view, arm, (u, v). To within the reading of a drawn circle.
READ_OFF = {
    "sample_0": [
        ("head", 0, 167, 264),
        ("head", 1, 434, 139),
        ("left_wrist", 0, 333, 190),
        ("right_wrist", 1, 340, 196),
    ],
    "sample_1": [
        ("head", 0, 118, 180),
        ("head", 1, 295, 135),
        ("left_wrist", 1, 288, 137),
        ("right_wrist", 1, 324, 178),
    ],
    "demo_000": [
        ("head", 0, 95, 262),
        ("head", 1, 392, 245),
        ("left_wrist", 0, 268, 253),
        ("right_wrist", 1, 264, 208),
    ],
}


def folder_of(shared_data: Path, name: str) -> Path:
    return shared_data / ("agibot_gesim" if name.startswith("sample") else "agibot_gesim_v2")


def load(shared_data: Path, name: str):
    folder = folder_of(shared_data, name)
    source = AgibotGesimSource(AgibotGesimSourceConfig(path=str(folder), fps=30.0), folder)
    return source.load(next(i for i in source.episode_ids() if i.endswith(name)))


def independent_pixel(folder: Path, name: str, view: str, arm: int) -> np.ndarray:
    """Straight from the arrays by quaternion or Euler algebra: shares no code with the project."""
    v = VIEWS.index(view)
    if name.startswith("sample"):
        row = np.load(folder / name / "actions.npy")[0].astype(np.float64)[8 * arm : 8 * arm + 8]
        x, y, z, w = row[3:7]
        z_axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        point = row[:3] + 0.23 * z_axis
        file = ("head", "hand_left", "hand_right")[v]
        K, T = np.load(folder / name / f"intrinsic_{file}.npy"), np.load(folder / name / f"extrinsic_{file}.npy")[0]
    else:
        assets = folder / "assets" / name
        row = np.load(assets / "state_eef_poses_0.npy")[0].astype(np.float64)[7 * arm : 7 * arm + 6]
        (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in row[3:6])
        point = row[:3] + 0.15 * np.array([cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr])
        K, T = np.load(assets / "intrinsic.npy")[v], np.load(assets / "extrinsic_alignstate_0.npy")[v, 0]
    in_camera = T[:3, :3].T.astype(np.float64) @ (point - T[:3, 3])
    return (K.astype(np.float64) @ (in_camera / in_camera[2]))[:2]


@pytest.mark.parametrize("name", sorted(READ_OFF))
def test_tool_centres_land_where_the_reference_puts_them(shared_data, name):
    tracks, _ = compute_tracks(load(shared_data, name).episode, None, controls="state")
    assert tracks.camera_motion == ("static", "recorded", "recorded")
    folder = folder_of(shared_data, name)
    for view, arm, u, v in READ_OFF[name]:
        seen = tracks.uv[0, VIEWS.index(view), arm]
        assert tracks.valid[0, VIEWS.index(view), arm]
        np.testing.assert_allclose(seen, independent_pixel(folder, name, view, arm), atol=0.02)
        np.testing.assert_allclose(seen, (u, v), atol=4.0)


def test_commands_land_where_their_published_poses_put_them(shared_data):
    """GE-Sim publishes the poses of the commands too; they are not read, and the project comes to them by kinematics."""
    description = shared_data / "agibot_g1_urdf" / "G1_omnipicker_calibrated.urdf"
    kinematics = ArmKinematics(load_embodiment("agibot_g1", description))
    for name in ("demo_000", "demo_001"):
        episode = load(shared_data, name).episode
        by_action, by_state = (compute_tracks(episode, kinematics, controls=c)[0] for c in ("action", "state"))
        published = np.load(shared_data / "agibot_gesim_v2" / "assets" / name / "eef_poses_0.npy").reshape(-1, 2, 7)
        ends = pose_from_euler_fixed_xyz(published[..., :3], published[..., 3:6])
        np.testing.assert_allclose(by_action.T_base_tool, along_tool_z(ends, 0.15), atol=5e-5)
        # The right arm trails its commands: the measured tool is elsewhere in its own wrist view.
        seen = by_action.valid[:, 2, 1] & by_state.valid[:, 2, 1]
        assert np.linalg.norm(by_action.uv - by_state.uv, axis=-1)[seen, 2, 1].max() > 20
        assert np.abs(by_action.gripper - by_state.gripper).max() > 0.15
