"""Galaxea's, RoboCOIN's and DROID's LeRobot datasets as they are published, written with pyarrow and PyAV alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.data import curating

FRAMES, HEIGHT, WIDTH = 12, 72, 128


def picture(seed: int, frame: int) -> np.ndarray:
    """(H, W, 3) with a block whose place tells the frame and whose colour tells the seed."""
    image = np.full((HEIGHT, WIDTH, 3), (40 + 30 * (seed % 8), 90, 60), np.uint8)
    image[20:52, 8 * frame : 8 * frame + 16] = (230, 200 - 20 * (seed % 8), 30)
    return image


def write_video(path: Path, seeds: list[int], fps: int) -> None:
    """Episodes of FRAMES frames, one after the other."""
    frames = np.stack([picture(seed, frame) for seed in seeds for frame in range(FRAMES)])
    curating.write_video(path, frames, rate=fps, options={"crf": "12", "g": "4"})


def vector(width: int, names: Any = None, dtype: str = "float64") -> dict[str, Any]:
    return {"dtype": dtype, "shape": [width], "names": names}


def video_feature() -> dict[str, Any]:
    return {"dtype": "video", "shape": [HEIGHT, WIDTH, 3], "names": ["height", "width", "channels"]}


def write_v21(
    root: Path, features: dict[str, Any], episodes: list[dict[str, np.ndarray]], tasks: list[str], fps: int, robot: str
) -> None:
    keys = [key for key, feature in features.items() if feature["dtype"] == "video"]
    info = {
        "codebase_version": "v2.1", "robot_type": robot, "total_episodes": len(episodes), "fps": fps, "chunks_size": 1000,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
        "features": features,
    }  # fmt: skip
    (root / "meta").mkdir(parents=True)
    (root / "meta/info.json").write_text(json.dumps(info))
    rows = [{"episode_index": i, "tasks": tasks[:1], "length": FRAMES} for i in range(len(episodes))]
    (root / "meta/episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (root / "meta/tasks.jsonl").write_text(
        "".join(json.dumps({"task_index": i, "task": task}, ensure_ascii=False) + "\n" for i, task in enumerate(tasks))
    )
    for index, columns in enumerate(episodes):
        table = {
            "task_index": [0] * FRAMES, **{name: values.tolist() for name, values in columns.items()},
            "timestamp": np.arange(FRAMES) / fps, "frame_index": np.arange(FRAMES), "episode_index": [index] * FRAMES,
        }  # fmt: skip
        path = root / f"data/chunk-000/episode_{index:06d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(table), path)
        for n, key in enumerate(keys):
            write_video(root / f"videos/chunk-000/{key}/episode_{index:06d}.mp4", [index + n], fps)


def wave(width: int, seed: int = 0) -> np.ndarray:
    return 0.4 * np.sin(0.3 * np.arange(FRAMES)[:, None] + np.arange(width)[None] + seed)


GALAXEA_IMAGES = ("head_rgb", "head_right_rgb", "left_wrist_rgb", "right_wrist_rgb")


def write_galaxea(root: Path) -> dict[str, np.ndarray]:
    """One task's dataset of Galaxea's Open-World Dataset (R1 Lite, 15 fps); returns the columns of its episode."""
    columns: dict[str, np.ndarray] = {}
    features: dict[str, Any] = {f"observation.images.{name}": video_feature() for name in GALAXEA_IMAGES}
    for number, arm in enumerate(("left", "right")):
        columns[f"observation.state.{arm}_arm"] = wave(6, number)
        columns[f"observation.state.{arm}_arm.velocities"] = wave(6, 7)
        columns[f"action.{arm}_arm"] = wave(6, number) + 0.02
        columns[f"observation.state.{arm}_gripper"] = np.linspace(100, -3, FRAMES)[:, None]
        columns[f"action.{arm}_gripper"] = np.linspace(90, 10, FRAMES)[:, None]
    columns["observation.state.torso"] = wave(4)
    columns["observation.state.chassis.imu"] = wave(10)
    for name, values in columns.items():
        features[name] = vector(values.shape[1], [f"/hdas/{name}.position[{i}]" for i in range(values.shape[1])])
    indices = {
        "task_index": [1] * 5 + [2] * (FRAMES - 5),
        "coarse_task_index": [0] * FRAMES,
        "quality_index": [3] * FRAMES,
    }
    episode = columns | {name: np.array(values) for name, values in indices.items()}
    features |= {name: vector(1, dtype="int64") for name in indices}
    tasks = ["擦镜子@Clean the mirror", "拿起抹布@Pick up the cloth", "擦@Wipe", "qualified"]
    write_v21(root, features, [episode], tasks, fps=15, robot="r1lite")
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
    features: dict[str, Any] = {
        f"observation.images.{name}": video_feature()
        for name in ("cam_high_rgb", "cam_left_wrist_rgb", "cam_right_wrist_rgb")
    }
    features |= {key: vector(26, ROBOCOIN_NAMES, "float32") for key in ("observation.state", "action")}
    states = [wave(26, number) for number in range(episodes)]
    for state in states:
        state[:, [6, 19]] = np.linspace(0, 1, FRAMES)[:, None]
    rows = [
        {"observation.state": s.astype(np.float32), "action": (s + 0.01 * (np.arange(26) % 13 != 6)).astype(np.float32)}
        for s in states
    ]
    write_v21(root, features, rows, ["Move the bread."], fps=30, robot="agilex_cobot_magic")
    return states[0]


DROID_VIDEOS = ("wrist_left", "exterior_1_left", "exterior_2_left")


def write_droid(root: Path) -> dict[str, np.ndarray]:
    """Two episodes of DROID's LeRobot port (v3.0, 15 fps, robot "Franka"), joined in one file of each kind."""
    joints = {"axes": [*(f"joint_{i}" for i in range(7)), "gripper"]}
    pose = {"axes": ["x", "y", "z", "roll", "pitch", "yaw"]}
    features: dict[str, Any] = {f"observation.images.{name}": video_feature() for name in DROID_VIDEOS}
    features |= {key: vector(8, joints, "float32") for key in ("observation.state", "action")}
    features |= {f"camera_extrinsics.{name}": vector(6, pose, "float32") for name in DROID_VIDEOS}
    features |= {"is_episode_successful": vector(1, dtype="bool"), "task_index": vector(1, dtype="int64")}
    count = 2 * FRAMES
    state = np.concatenate([wave(8, 0), wave(8, 1)])
    state[:, 7] = np.tile(np.linspace(0, 1, FRAMES), 2)
    first = np.array([0.3, -0.4, 0.5, -1.9, 0.1, -0.8])
    extrinsics = {
        "wrist_left": np.tile([0.1, 0.0, 0.6, 3.0, 0.0, 0.2], (count, 1)),
        "exterior_1_left": np.tile(first, (count, 1)),
        # The second camera of the second episode was never calibrated: the port writes zeros.
        "exterior_2_left": np.concatenate([np.tile(first + 0.1, (FRAMES, 1)), np.zeros((FRAMES, 6))]),
    }
    index = np.arange(count)
    columns = {
        "observation.state": state.astype(np.float32).tolist(),
        "action": (state + 0.01 * (np.arange(8) < 7)).astype(np.float32).tolist(),
        **{f"camera_extrinsics.{name}": v.astype(np.float32).tolist() for name, v in extrinsics.items()},
        "is_episode_successful": [True] * FRAMES + [False] * FRAMES,
        "timestamp": ((index % FRAMES) / 15).astype(np.float32),
        "frame_index": index % FRAMES,
        "episode_index": index // FRAMES,
        "index": index,
        "task_index": index // FRAMES,
    }
    for folder in ("data/chunk-000", "meta/episodes/chunk-000"):
        (root / folder).mkdir(parents=True)
    pq.write_table(pa.table(columns), root / "data/chunk-000/file-000.parquet")
    rows: list[dict[str, Any]] = []
    for episode in range(2):
        first, last = episode * FRAMES, (episode + 1) * FRAMES
        row = {"episode_index": episode, "tasks": [f"task {episode}"], "length": FRAMES, "data/chunk_index": 0}
        row |= {"data/file_index": 0, "dataset_from_index": first, "dataset_to_index": last}
        for name in DROID_VIDEOS:
            key = f"videos/observation.images.{name}"
            row |= {f"{key}/chunk_index": 0, f"{key}/file_index": 0}
            row |= {f"{key}/from_timestamp": first / 15, f"{key}/to_timestamp": last / 15}
        rows.append(row)
    pq.write_table(pa.Table.from_pylist(rows), root / "meta/episodes/chunk-000/file-000.parquet")
    tasks = pa.table({"task_index": [0, 1], "task": ["Put the pen in the cup.", "Close the drawer."]})
    pq.write_table(tasks, root / "meta/tasks.parquet")
    info = {
        "codebase_version": "v3.0", "robot_type": "Franka", "fps": 15, "features": features,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    }  # fmt: skip
    (root / "meta/info.json").write_text(json.dumps(info))
    for number, name in enumerate(DROID_VIDEOS):
        write_video(root / f"videos/observation.images.{name}/chunk-000/file-000.mp4", [number, number + 1], 15)
    return {"state": state, **extrinsics}
