"""LeRobotDataset v2.1 with defects: one Parquet and one mp4 a view for each episode."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tools.corrupted.content import FPS, NUM_FRAMES, PAIR_NAMES, pair_motion, pictures
from tools.corrupted.defects import FileDefect, Kind, Layout, Source, truncate
from worldline_core.data.video.encoder import encode_video

EMBODIMENT = "ur5e_pair"
_JOINTS = 6
_GRIPPERS = np.arange(len(PAIR_NAMES)) % (_JOINTS + 1) == _JOINTS
_VIEWS = {"observation.images.top": "head", "observation.images.wrist": "right_wrist"}


def _on_column(change: Callable[[np.ndarray], Any], column: str = "observation.state") -> FileDefect:
    def spoil(path: Path, random: np.random.Generator) -> None:
        table = pq.read_table(path)
        changed = list(change(np.array(table[column].to_pylist(), dtype=np.float32)))
        place, kind = table.column_names.index(column), table.schema.field(column).type
        pq.write_table(table.set_column(place, column, pa.array(changed, kind)), path)

    return spoil


def _uneven(values: np.ndarray) -> list[np.ndarray]:
    """The number of values is still right."""
    return [*values[:3], values[3, :-2], np.append(values[4], [0, 0]).astype(np.float32), *values[5:]]


def _without_actions(path: Path, random: np.random.Generator) -> None:
    pq.write_table(pq.read_table(path).drop_columns(["action"]), path)


def _linked_out(path: Path, random: np.random.Generator) -> None:
    path.unlink()
    path.symlink_to(Path(__file__).resolve())


def _too_long(path: Path, random: np.random.Generator) -> None:
    encode_video(path, pictures(random, NUM_FRAMES + 3), FPS, preset="ultrafast")


def _frozen(frames: np.ndarray) -> np.ndarray:
    return np.repeat(frames[:1], len(frames), axis=0)


def _noise(frames: np.ndarray) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, frames.shape, np.uint8)


def _driving(frames: np.ndarray) -> np.ndarray:
    return np.stack([np.roll(frame, (n, 2 * n), axis=(0, 1)) for n, frame in enumerate(frames)])


def _filtered(name: str, *reasons: str, **settings: Any) -> Kind:
    return Kind(name, reasons, settings=settings, stage="filter")


KINDS = (
    Kind("video_truncated", ("truncated_video",), truncate, "top"),
    Kind("video_missing", ("missing_file",), lambda path, _: path.unlink(), "wrist"),
    Kind("video_pipe", ("special_file", "missing_file"), lambda path, _: (path.unlink(), os.mkfifo(path)), "top"),
    Kind("video_linked_out", ("path_traversal",), _linked_out, "wrist"),
    Kind("video_too_long", ("length_mismatch",), _too_long, "top"),
    Kind("table_truncated", ("unreadable",), truncate),
    Kind("column_missing", ("missing_column",), _without_actions),
    Kind("rows_uneven", ("length_mismatch",), _on_column(_uneven)),
    Kind("state_not_finite", ("nan_state",), _on_column(lambda values: np.where(values == values[3], np.nan, values))),
    Kind(
        "joints_in_degrees", ("joint_out_of_range",), _on_column(lambda values: values * np.where(_GRIPPERS, 1, 57.3))
    ),
    Kind("gripper_raw", ("invalid_gripper",), _on_column(lambda values: values * np.where(_GRIPPERS, 255, 1))),
    Kind("clock_jumps", ("wrong_fps",), _on_column(lambda times: times + 0.9 * (times > 1), "timestamp")),
    Kind("duplicate", ("duplicate", "near_duplicate"), settings={"like": 0}),
    _filtered("too_short", "too_short", num_frames=4),
    _filtered("camera_frozen", "corrupted", "frozen", change=_frozen),
    _filtered("camera_black", "corrupted", "too_dark", change=np.zeros_like),
    _filtered("camera_noise", "corrupted", "noise", change=_noise),
    _filtered("base_drives", "base_motion", change=_driving),
    _filtered("still", "static", still=True),
)


def _add(
    root: Path,
    number: int,
    random: np.random.Generator,
    num_frames: int = NUM_FRAMES,
    change: Callable[[np.ndarray], np.ndarray] | None = None,
    *,
    still: bool = False,
) -> tuple[str, dict[str, Path]]:
    """One episode; `change` spoils the pictures of the head camera; of a still one nothing moves."""
    state = pair_motion(random, num_frames)
    if still:
        state = np.repeat(state[:1], num_frames, axis=0)
    index = np.arange(num_frames)
    table = pa.table(
        {
            "observation.state": pa.array(state.tolist(), pa.list_(pa.float32())),
            "action": pa.array((state + np.float32(0.002)).tolist(), pa.list_(pa.float32())),
            "timestamp": pa.array((index / FPS).astype(np.float32)),
            "frame_index": pa.array(index),
            "episode_index": pa.array(np.full(num_frames, number)),
            "index": pa.array(index),
            "task_index": pa.array(np.zeros(num_frames, dtype=np.int64)),
        }
    )
    files = {"table": root / f"data/chunk-000/episode_{number:06d}.parquet"}
    files |= {key.split(".")[-1]: root / f"videos/chunk-000/{key}/episode_{number:06d}.mp4" for key in _VIEWS}
    for name, path in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        if name == "table":
            pq.write_table(table, path)
            continue
        frames = pictures(random, num_frames)
        if change is not None and name == "top":
            frames = change(frames)
        encode_video(path, _frozen(frames) if still else frames, FPS, preset="ultrafast")
    return f"{root.name}-{number:06d}", files


def _finish(root: Path, lengths: list[int]) -> Source:
    image = {"dtype": "video", "shape": [72, 96, 3], "names": ["height", "width", "channels"]}
    vector = {"dtype": "float32", "shape": [len(PAIR_NAMES)], "names": PAIR_NAMES}
    info = {
        "codebase_version": "v2.1",
        "robot_type": EMBODIMENT,
        "total_episodes": len(lengths),
        "total_frames": sum(lengths),
        "fps": FPS,
        "chunks_size": 100_000,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
        "features": {"observation.state": vector, "action": vector, **dict.fromkeys(_VIEWS, image)},
    }
    meta = root / "meta"
    meta.mkdir(parents=True, exist_ok=True)
    (meta / "info.json").write_text(json.dumps(info))
    rows = [{"episode_index": n, "tasks": ["lift the block"], "length": length} for n, length in enumerate(lengths)]
    (meta / "episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (meta / "tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": "lift the block"}) + "\n")
    source = {"kind": "lerobot_v21", "views": _VIEWS, "split": "train"}
    return source | {"embodiment": EMBODIMENT, "angle_unit": "rad"}


write = Layout("lerobot_v21", _add, _finish, KINDS).write
