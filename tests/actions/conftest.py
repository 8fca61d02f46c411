"""A small two-armed robot and episodes of it, for the tests of action rendering."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics

K = np.array([[90.0, 0, 47.5], [0, 90.0, 31.5], [0, 0, 1.0]])
# Looks from x = -1 along +x: camera x is -y of the base, camera y is -z.
T_BASE_HEAD = np.array([[0.0, 0, 1, -1], [-1, 0, 0, 0], [0, -1, 0, 0.4], [0, 0, 0, 1]])
# Behind and above the tool, looking along the hand's +z.
MOUNT = np.array([[1.0, 0, 0, 0], [0, 1, 0, -0.05], [0, 0, 1, -0.1], [0, 0, 0, 1]])

ARM_XML = """
<body name="{n}/base" pos="0 {y} 0.2">
  <joint name="{n}/pan" axis="0 0 1"/>
  <body name="{n}/upper" pos="0 0 0.1"><joint name="{n}/lift" axis="0 1 0"/>
    <body name="{n}/hand" pos="0.3 0 0" quat="0.7071067811865476 0 0.7071067811865476 0">
      <joint name="{n}/roll" axis="0 0 1"/>
      <body name="{n}/finger" pos="0 0.02 0.08"/>
    </body>
  </body>
</body>
"""


@pytest.fixture(scope="session")
def kinematics(tmp_path_factory) -> ArmKinematics:
    folder: Path = tmp_path_factory.mktemp("pair")
    arms = "".join(ARM_XML.format(n=name, y=y) for name, y in (("left", 0.2), ("right", -0.2)))
    (folder / "pair.xml").write_text(f"<mujoco><worldbody>{arms}</worldbody></mujoco>")
    described = [
        {
            "name": name, "joints": [f"{name}/{joint}" for joint in ("pan", "lift", "roll")],
            "limits": [[-1.0, 1.0]] * 3, "end_effector_link": f"{name}/hand",
            "T_link_tool": {"translation": [0.0, 0.0, 0.1]}, "gripper": {"closed": 0.0, "open": 1.0},
            "wrist_camera": {"link": f"{name}/hand", "T_link_camera": MOUNT.tolist()},
        }
        for name in ("left", "right")
    ]  # fmt: skip
    values = {"name": "pair", "description": {"format": "mjcf", "file": "pair.xml"}, "base_link": "world"}
    (folder / "pair.yaml").write_text(yaml.safe_dump(values | {"arms": described}))
    return ArmKinematics(load_embodiment(folder / "pair.yaml"))


@pytest.fixture
def episode(kinematics) -> Episode:
    time = np.linspace(0, 1, 9)
    action = np.stack([0.5 * time, -0.2 * time, time, time, -0.4 * time, 0.3 * time, -time, 1.3 - 1.6 * time], axis=1)
    return make_episode(kinematics, action, action - 0.01, "pair-0", K, T_BASE_HEAD)


def make_episode(
    kinematics: ArmKinematics, action, state, name: str, K: np.ndarray, T_base_head: np.ndarray
) -> Episode:
    """An episode of 64 x 96 pixels whose wrist cameras are where the state carries them."""
    cameras = {"head": CameraTrack("head", K, T_base_head[None], 96, 64)}
    for view, poses in kinematics.wrist_camera_poses(state).items():
        cameras[view] = CameraTrack(view, K, poses.numpy(), 96, 64)
    return Episode(
        episode_id=name, source="test", embodiment=kinematics.embodiment.name, scene="s", task_family="lift",
        instruction="lift", outcome="unknown", split="train", fps=8.0, state=state.astype(np.float32),
        action=action.astype(np.float32), timestamps=np.arange(len(action)) / 8.0, cameras=cameras,
    )  # fmt: skip
