"""Galaxea's, RoboCOIN's and DROID's LeRobot datasets as they are published, written with pyarrow and PyAV alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.discovery.recorded_sets import write_lerobot

FRAMES, HEIGHT, WIDTH = 12, 72, 128


def picture(seed: int, frame: int) -> np.ndarray:
    """(H, W, 3) with a block whose place tells the frame and whose colour tells the seed."""
    image = np.full((HEIGHT, WIDTH, 3), (40 + 30 * (seed % 8), 90, 60), np.uint8)
    image[20:52, 8 * frame : 8 * frame + 16] = (230, 200 - 20 * (seed % 8), 30)
    return image


def videos(cameras: tuple[str, ...], episodes: int) -> dict[str, list[np.ndarray]]:
    """Frames of each episode by camera; the seed of a video is the sum of both numbers."""
    return {
        f"observation.images.{name}": [
            np.stack([picture(number + episode, frame) for frame in range(FRAMES)]) for episode in range(episodes)
        ]
        for number, name in enumerate(cameras)
    }


def wave(width: int, seed: int = 0) -> np.ndarray:
    return 0.4 * np.sin(0.3 * np.arange(FRAMES)[:, None] + np.arange(width)[None] + seed)


def write_galaxea(root: Path) -> dict[str, np.ndarray]:
    """One task's dataset of Galaxea's Open-World Dataset (R1 Lite, 15 fps); returns the columns of its episode."""
    columns: dict[str, np.ndarray] = {}
    for number, arm in enumerate(("left", "right")):
        columns[f"observation.state.{arm}_arm"] = wave(6, number)
        columns[f"observation.state.{arm}_arm.velocities"] = wave(6, 7)
        columns[f"action.{arm}_arm"] = wave(6, number) + 0.02
        columns[f"observation.state.{arm}_gripper"] = np.linspace(100, -3, FRAMES)[:, None]
        columns[f"action.{arm}_gripper"] = np.linspace(90, 10, FRAMES)[:, None]
    columns["observation.state.torso"] = wave(4)
    columns["observation.state.chassis.imu"] = wave(10)
    vectors = {name: ([f"/hdas/{name}.position[{i}]" for i in range(v.shape[1])], [v]) for name, v in columns.items()}
    indices = {
        "task_index": [1] * 5 + [2] * (FRAMES - 5),
        "coarse_task_index": [0] * FRAMES,
        "quality_index": [3] * FRAMES,
    }
    vectors |= {name: (None, [np.array(values)]) for name, values in indices.items()}  # type: ignore[dict-item]
    tasks = ["擦镜子@Clean the mirror", "拿起抹布@Pick up the cloth", "擦@Wipe", "qualified"]
    cameras = videos(("head_rgb", "head_right_rgb", "left_wrist_rgb", "right_wrist_rgb"), 1)
    write_lerobot(root, vectors, cameras, version="v2.1", fps=15, robot="r1lite", tasks=tasks, floats="float64")
    return columns


ROBOCOIN_NAMES = [
    name
    for arm in ("left", "right")
    for name in (
        *(f"{arm}_arm_joint_{i}_rad" for i in range(1, 7)),
        f"{arm}_gripper_open_scale",
        *(f"{arm}_eef_pos_{axis}_m" for axis in "xyz"),
        *(f"{arm}_eef_rot_euler_{axis}_rad" for axis in "xyz"),
    )
]


def write_robocoin(root: Path, episodes: int = 1) -> np.ndarray:
    """One task's dataset of RoboCOIN (AgileX Cobot Magic, 30 fps); returns the state of its first episode."""
    states = [wave(26, number) for number in range(episodes)]
    for state in states:
        state[:, [6, 19]] = np.linspace(0, 1, FRAMES)[:, None]
    actions = [state + 0.01 * (np.arange(26) % 13 != 6) for state in states]
    vectors = {"observation.state": (ROBOCOIN_NAMES, states), "action": (ROBOCOIN_NAMES, actions)}
    cameras = videos(("cam_high_rgb", "cam_left_wrist_rgb", "cam_right_wrist_rgb"), episodes)
    write_lerobot(root, vectors, cameras, version="v2.1", fps=30, robot="agilex_cobot_magic", tasks=["Move the bread."])
    return states[0]


def write_droid(root: Path) -> dict[str, np.ndarray]:
    """Two episodes of DROID's LeRobot port (v3.0, 15 fps, robot "Franka"), joined in one file of each kind."""
    joints = {"axes": [*(f"joint_{i}" for i in range(7)), "gripper"]}
    pose = {"axes": ["x", "y", "z", "roll", "pitch", "yaw"]}
    states = [wave(8, 0), wave(8, 1)]
    for state in states:
        state[:, 7] = np.linspace(0, 1, FRAMES)
    first = np.array([0.3, -0.4, 0.5, -1.9, 0.1, -0.8])
    extrinsics = {
        "wrist_left": np.tile([0.1, 0.0, 0.6, 3.0, 0.0, 0.2], (2, FRAMES, 1)),
        "exterior_1_left": np.tile(first, (2, FRAMES, 1)),
        # The second camera of the second episode was never calibrated: the port writes zeros.
        "exterior_2_left": np.stack([np.tile(first + 0.1, (FRAMES, 1)), np.zeros((FRAMES, 6))]),
    }
    vectors = {
        "observation.state": (joints, states),
        "action": (joints, [state + 0.01 * (np.arange(8) < 7) for state in states]),
        **{f"camera_extrinsics.{name}": (pose, list(poses)) for name, poses in extrinsics.items()},
        "is_episode_successful": (None, [np.full(FRAMES, True), np.full(FRAMES, False)]),
        "task_index": (None, [np.zeros(FRAMES, int), np.ones(FRAMES, int)]),
    }
    tasks = ["Put the pen in the cup.", "Close the drawer."]
    write_lerobot(root, vectors, videos(tuple(extrinsics), 2), fps=15, robot="Franka", tasks=tasks)  # type: ignore[arg-type]
    return {"state": np.concatenate(states), **{name: poses.reshape(-1, 6) for name, poses in extrinsics.items()}}
