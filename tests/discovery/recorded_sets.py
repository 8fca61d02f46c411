"""Small LeRobot datasets of usual robots, written with pyarrow and PyAV alone, with pictures that move as their cameras do."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.data import curating

HEIGHT, WIDTH = 48, 64
SO_JOINTS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"]
SO_NAMES = [f"{name}.pos" for name in (*SO_JOINTS, "gripper")]
TICK = 360 / 4095
ALOHA = ["waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate"]


def motion(width: int, frames: int, seed: int = 0, *, size: float = 1.0) -> np.ndarray:
    """(frames, width): rest, motion, rest."""
    rng = np.random.default_rng(seed)
    time = np.clip(np.arange(frames) / frames * 2 - 0.5, 0, 1)[:, None]
    return size * (rng.uniform(-0.3, 0.3, width) + rng.uniform(0.3, 0.6, width) * np.sin(1.5 * np.pi * time))


def pictures(states: np.ndarray, kind: str, seed: int = 0) -> np.ndarray:
    """(N, H, W, 3): all of a wrist picture moves with the joints, of a still one a block does."""
    texture = np.random.default_rng(seed).integers(0, 255, (HEIGHT // 4, WIDTH // 4, 3)).repeat(4, 0).repeat(4, 1)
    path = states.sum(axis=1)
    shift = np.round((path - path.min()) / max(np.ptp(path), 1e-9) * 40).astype(int)
    if kind == "wrist":
        return np.stack([np.roll(texture, s, axis=1) for s in shift]).astype(np.uint8)
    frames = np.tile(texture, (len(states), 1, 1, 1)).astype(np.uint8)
    for frame, s in zip(frames, shift, strict=True):
        frame[20:32, 4 + s : 16 + s] = (250, 40, 40)
    return frames


def write_video(path: Path, frames: np.ndarray, fps: int) -> None:
    curating.write_video(path, frames, rate=fps, options={"crf": "12", "g": "4", "preset": "ultrafast"})


def write_lerobot(
    root: Path,
    vectors: Mapping[str, tuple[Any, Sequence[np.ndarray]]],
    cameras: Mapping[str, Sequence[np.ndarray]],
    *,
    version: str = "v3.0",
    fps: int = 30,
    robot: str | None = "so101_follower",
    tasks: Sequence[str] = ("Pick the cube up.",),
    floats: str = "float32",
) -> Path:
    """A dataset of these vectors (feature -> names, values by episode) and cameras (key -> frames by episode)."""
    lengths = [len(values) for values in next(iter(vectors.values()))[1]]
    starts = [sum(lengths[:index]) for index in range(len(lengths))]
    vectors = {"task_index": (None, [np.zeros(length, np.int64) for length in lengths]), **vectors}
    features: dict[str, Any] = {
        name: {"dtype": floats if v[0].dtype.kind == "f" else str(v[0].dtype), "shape": [v[0].size // len(v[0])], "names": names}
        for name, (names, v) in vectors.items()
    }  # fmt: skip
    for key, frames in cameras.items():
        features[key] = {"dtype": "video", "shape": [*frames[0].shape[1:]], "names": ["height", "width", "channels"]}
    tables = []
    for index, (start, length) in enumerate(zip(starts, lengths, strict=True)):
        values = {name: v[index] for name, (_, v) in vectors.items()}
        table = {name: list(v.astype(features[name]["dtype"])) for name, v in values.items()} | {
            "timestamp": (np.arange(length) / fps).astype(np.float32), "frame_index": np.arange(length),
            "episode_index": np.full(length, index), "index": start + np.arange(length),
        }  # fmt: skip
        tables.append(pa.table(table))
    rows = [
        {"episode_index": i, "tasks": [tasks[vectors["task_index"][1][i][0]]], "length": length}
        for i, length in enumerate(lengths)
    ]
    (root / "meta/episodes/chunk-000").mkdir(parents=True)
    (root / "data/chunk-000").mkdir(parents=True)
    listed = {"task_index": range(len(tasks)), "task": tasks}
    if version == "v3.0":
        data = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
        video = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        pq.write_table(pa.concat_tables(tables), root / "data/chunk-000/file-000.parquet")
        for row, start in zip(rows, starts, strict=True):
            end = start + row["length"]
            row |= {"data/chunk_index": 0, "data/file_index": 0, "dataset_from_index": start, "dataset_to_index": end}
            for key in (f"videos/{camera}" for camera in cameras):
                row |= {f"{key}/chunk_index": 0, f"{key}/file_index": 0}
                row |= {f"{key}/from_timestamp": start / fps, f"{key}/to_timestamp": end / fps}
        pq.write_table(pa.Table.from_pylist(rows), root / "meta/episodes/chunk-000/file-000.parquet")
        pq.write_table(pa.table({name: list(v) for name, v in listed.items()}), root / "meta/tasks.parquet")
        for key, episodes in cameras.items():
            write_video(root / f"videos/{key}/chunk-000/file-000.mp4", np.concatenate(episodes), fps)
    else:
        data = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
        video = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
        named = [dict(zip(listed, pair, strict=True)) for pair in zip(*listed.values(), strict=True)]
        for name, lines in (("episodes", rows), ("tasks", named)):
            (root / f"meta/{name}.jsonl").write_text(
                "".join(json.dumps(line, ensure_ascii=False) + "\n" for line in lines)
            )
        for index, table in enumerate(tables):
            pq.write_table(table, root / f"data/chunk-000/episode_{index:06d}.parquet")
            for key, episodes in cameras.items():
                write_video(root / f"videos/chunk-000/{key}/episode_{index:06d}.mp4", episodes[index], fps)
    (root / "meta/info.json").write_text(json.dumps({
        "codebase_version": version, "robot_type": robot, "fps": fps, "features": features, "chunks_size": 1000,
        "data_path": data, "video_path": video,
    }))  # fmt: skip
    return root


def so101_states(episodes: int = 4, frames: int = 60) -> list[np.ndarray]:
    """Joints in degrees, in whole ticks of the motors, and a gripper of 0 .. 100 that closes on something."""
    joints = (np.round(motion(5, frames, seed, size=50.0) / TICK) * TICK for seed in range(episodes))
    return [np.column_stack([each, gripper(frames)]) for each in joints]


def gripper(frames: int, low: float = 2.0, high: float = 80.0) -> np.ndarray:
    """Open, closed for the middle third, open."""
    return np.interp(np.arange(frames) / frames, [0, 0.3, 0.4, 0.65, 0.75, 1], [high, high, low, low, high, high])


def write_so101(
    root: Path, *, names: Sequence[str] = SO_NAMES, cameras: Mapping[str, str] | None = None, **options: Any
) -> Path:
    """An SO-101 as LeRobot 0.6 records it: degrees, front and wrist camera."""
    states = options.pop("states", None) or so101_states()
    actions = options.pop("actions", None) or [state + 0.5 * (np.arange(state.shape[1]) < 5) for state in states]
    kinds = cameras or {"observation.images.front": "still", "observation.images.wrist": "wrist"}
    videos = {
        key: [pictures(state[:, :5], kind, seed) for seed, state in enumerate(states)] for key, kind in kinds.items()
    }
    vectors = {"observation.state": (list(names), states), "action": (list(names), actions)}
    return write_lerobot(root, vectors, videos, **options)


def write_aloha(root: Path, **options: Any) -> Path:
    """Two ViperX of ALOHA: radians, grippers 0 .. 1, three cameras at 50 Hz."""
    names = [f"{side}_{name}" for side in ("left", "right") for name in (*ALOHA, "gripper")]
    ends = gripper(80, 0.05, 0.95)
    joints = [motion(12, 80, seed) for seed in range(4)]
    states = [np.column_stack([each[:, :6], ends, each[:, 6:], ends]) for each in joints]
    videos = {
        f"observation.images.cam_{name}": [pictures(each[:, part], kind, seed) for seed, each in enumerate(joints)]
        for name, part, kind in (
            ("high", slice(6), "still"), ("left_wrist", slice(6), "wrist"), ("right_wrist", slice(6, 12), "wrist"),
        )
    }  # fmt: skip
    vectors = {
        "observation.state": ({"motors": names}, states),
        "action": ({"motors": names}, [s + 0.01 for s in states]),
    }
    return write_lerobot(root, vectors, videos, fps=50, robot="aloha", **options)
