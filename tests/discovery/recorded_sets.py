"""Small LeRobot datasets of usual robots, written with pyarrow and PyAV alone, with pictures that move as their cameras do."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

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


def write_video(path: Path, frames: np.ndarray, fps: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    rate = Fraction(fps).limit_denominator(1000)
    with av.open(str(path), "w", format="mp4") as out:
        stream = out.add_stream("libx264", rate=rate, options={"crf": "18", "g": "8"})
        stream.width, stream.height, stream.pix_fmt = frames.shape[2], frames.shape[1], "yuv420p"
        for n, image in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = n, 1 / rate
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))


def write_lerobot(
    root: Path,
    vectors: Mapping[str, tuple[Any, Sequence[np.ndarray]]],
    cameras: Mapping[str, Sequence[np.ndarray]],
    *,
    version: str = "v3.0",
    fps: int = 30,
    robot: str | None = "so101_follower",
) -> Path:
    """A dataset of these vectors (feature -> names, values by episode) and cameras (key -> frames by episode)."""
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [values[0].shape[1]], "names": names}
        for name, (names, values) in vectors.items()
    }
    features |= {
        key: {"dtype": "video", "shape": [HEIGHT, WIDTH, 3], "names": ["height", "width", "channels"]}
        for key in cameras
    }
    features |= {"task_index": {"dtype": "int64", "shape": [1], "names": None}}
    lengths = [len(values) for values in next(iter(vectors.values()))[1]]
    info: dict[str, Any] = {
        "codebase_version": version,
        "robot_type": robot,
        "fps": fps,
        "features": features,
        "chunks_size": 1000,
    }
    (root / "meta").mkdir(parents=True)
    tables = []
    start = 0
    for index, length in enumerate(lengths):
        table: dict[str, Any] = {name: list(values[index].astype(np.float32)) for name, (_, values) in vectors.items()}
        table |= {
            "timestamp": (np.arange(length) / fps).astype(np.float32), "frame_index": np.arange(length),
            "episode_index": [index] * length, "index": start + np.arange(length), "task_index": [0] * length,
        }  # fmt: skip
        tables.append(pa.table(table))
        start += length
    if version == "v3.0":
        _write_v3(root, info, tables, lengths, cameras, fps)
    else:
        _write_v2(root, info, tables, lengths, cameras, fps)
    (root / "meta/info.json").write_text(json.dumps(info))
    return root


def _write_v3(
    root: Path,
    info: dict[str, Any],
    tables: list[pa.Table],
    lengths: list[int],
    cameras: Mapping[str, Sequence[np.ndarray]],
    fps: int,
) -> None:
    info |= {
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    }
    for folder in ("data/chunk-000", "meta/episodes/chunk-000"):
        (root / folder).mkdir(parents=True)
    pq.write_table(pa.concat_tables(tables), root / "data/chunk-000/file-000.parquet")
    rows = []
    start = 0
    for index, length in enumerate(lengths):
        row: dict[str, Any] = {
            "episode_index": index,
            "tasks": ["pick"],
            "length": length,
            "data/chunk_index": 0,
            "data/file_index": 0,
        }
        row |= {"dataset_from_index": start, "dataset_to_index": start + length}
        for key in cameras:
            row |= {f"videos/{key}/chunk_index": 0, f"videos/{key}/file_index": 0}
            row |= {f"videos/{key}/from_timestamp": start / fps, f"videos/{key}/to_timestamp": (start + length) / fps}
        rows.append(row)
        start += length
    pq.write_table(pa.Table.from_pylist(rows), root / "meta/episodes/chunk-000/file-000.parquet")
    pq.write_table(pa.table({"task_index": [0], "task": ["Pick the cube up."]}), root / "meta/tasks.parquet")
    for key, episodes in cameras.items():
        write_video(root / f"videos/{key}/chunk-000/file-000.mp4", np.concatenate(episodes), fps)


def _write_v2(
    root: Path,
    info: dict[str, Any],
    tables: list[pa.Table],
    lengths: list[int],
    cameras: Mapping[str, Sequence[np.ndarray]],
    fps: int,
) -> None:
    info |= {
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    }
    rows = [{"episode_index": i, "tasks": ["Pick the cube up."], "length": length} for i, length in enumerate(lengths)]
    (root / "meta/episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (root / "meta/tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": "Pick the cube up."}) + "\n")
    for index, table in enumerate(tables):
        path = root / f"data/chunk-000/episode_{index:06d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, path)
        for key, episodes in cameras.items():
            write_video(root / f"videos/chunk-000/{key}/episode_{index:06d}.mp4", episodes[index], fps)


def so101_states(episodes: int = 4, frames: int = 60, *, degrees: bool = True) -> list[np.ndarray]:
    """Joints in degrees, in whole ticks of the motors, and a gripper of 0 .. 100 that closes on something."""
    states = []
    for seed in range(episodes):
        joints = motion(5, frames, seed, size=50.0)
        state = np.concatenate(
            [np.round(joints / TICK) * TICK if degrees else joints, gripper(frames)[:, None]], axis=1
        )
        states.append(state)
    return states


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
    states = []
    for seed in range(4):
        joints, frames = motion(12, 80, seed), 80
        ends = gripper(frames, 0.05, 0.95)[:, None]
        states.append(np.concatenate([joints[:, :6], ends, joints[:, 6:], ends], axis=1))
    kinds = {
        "observation.images.cam_high": "still",
        "observation.images.cam_left_wrist": "wrist",
        "observation.images.cam_right_wrist": "wrist",
    }
    videos = {
        key: [
            pictures(state[:, 7:13] if "right" in key else state[:, :6], kind, seed)
            for seed, state in enumerate(states)
        ]
        for key, kind in kinds.items()
    }
    vectors = {
        "observation.state": ({"motors": names}, states),
        "action": ({"motors": names}, [s + 0.01 for s in states]),
    }
    return write_lerobot(root, vectors, videos, fps=50, robot="aloha", **options)
