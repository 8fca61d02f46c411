"""LeRobotDataset v2.1 with defects: one Parquet and one mp4 a view for each episode."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tools.corrupted import defects
from tools.corrupted.content import FPS, NUM_FRAMES, PAIR_NAMES, pair_motion, pictures
from tools.corrupted.defects import Kind, Label, Stage
from worldline_core.data.video.encoder import encode_video

EMBODIMENT = "ur5e_pair"
_JOINTS = 6
_VIEWS = {"observation.images.top": "head", "observation.images.wrist": "right_wrist"}
_TASK = "lift the block"
PictureDefect = Callable[[np.ndarray, np.random.Generator], np.ndarray]


@dataclass(frozen=True)
class _Episode:
    """Files of one episode."""

    root: Path
    index: int

    @property
    def table(self) -> Path:
        return self.root / f"data/chunk-000/episode_{self.index:06d}.parquet"

    @property
    def videos(self) -> list[Path]:
        return [self.root / f"videos/chunk-000/{key}/episode_{self.index:06d}.mp4" for key in _VIEWS]

    def video(self, random: np.random.Generator) -> Path:
        return self.videos[int(random.integers(len(_VIEWS)))]


EpisodeDefect = Callable[[_Episode, np.random.Generator], None]


def _on_video(defect: defects.FileDefect) -> EpisodeDefect:
    return lambda episode, random: defect(episode.video(random), random)


def _on_table(defect: defects.FileDefect) -> EpisodeDefect:
    return lambda episode, random: defect(episode.table, random)


def _on_column(
    change: Callable[[np.ndarray, np.random.Generator], Any], column: str = "observation.state"
) -> EpisodeDefect:
    def spoil(episode: _Episode, random: np.random.Generator) -> None:
        table = pq.read_table(episode.table)
        changed = list(change(np.array(table[column].to_pylist(), dtype=np.float32), random))
        place, kind = table.column_names.index(column), table.schema.field(column).type
        pq.write_table(table.set_column(place, column, pa.array(changed, kind)), episode.table)

    return spoil


def _not_finite(values: np.ndarray, random: np.random.Generator) -> np.ndarray:
    row, column = int(random.integers(len(values))), int(random.integers(_JOINTS))
    values[row, column] = random.choice([np.nan, np.inf, -np.inf])
    return values


def _degrees(values: np.ndarray, random: np.random.Generator) -> np.ndarray:
    joints = [*range(_JOINTS), *range(_JOINTS + 1, 2 * _JOINTS + 1)]
    values[:, joints] = np.rad2deg(values[:, joints]) + 15  # so that a still joint is seen as well
    return values


def _raw_gripper(values: np.ndarray, random: np.random.Generator) -> np.ndarray:
    values[:, _JOINTS] = 255 * values[:, _JOINTS]
    return values


def _lost_frames(values: np.ndarray, random: np.random.Generator) -> np.ndarray:
    values[int(random.integers(4, len(values) - 4)) :] += np.float32(0.9)
    return values


def _uneven(values: np.ndarray, random: np.random.Generator) -> list[np.ndarray]:
    """The number of values is still right."""
    return [*values[:3], values[3, :-2], np.append(values[4], [0, 0]).astype(np.float32), *values[5:]]


def _without_column(episode: _Episode, random: np.random.Generator) -> None:
    name = str(random.choice(["observation.state", "action", "timestamp", "task_index"]))
    pq.write_table(pq.read_table(episode.table).drop_columns([name]), episode.table)


def _video_of_other_length(episode: _Episode, random: np.random.Generator) -> None:
    frames = pictures(random, NUM_FRAMES + int(random.integers(1, 8)))
    encode_video(episode.video(random), frames, FPS, preset="ultrafast")


KINDS = (
    Kind("video_truncated", _on_video(defects.truncate), ("truncated_video",)),
    Kind("video_missing", _on_video(defects.missing), ("missing_file",)),
    Kind("video_pipe", _on_video(defects.pipe), ("special_file", "missing_file")),
    Kind("video_linked_out", _on_video(defects.link_out), ("path_traversal",)),
    Kind("video_too_long", _video_of_other_length, ("length_mismatch",)),
    Kind("table_truncated", _on_table(defects.truncate), ("unreadable",)),
    Kind("table_missing", _on_table(defects.missing), ("missing_file",)),
    Kind("column_missing", _without_column, ("missing_column",)),
    Kind("rows_uneven", _on_column(_uneven), ("length_mismatch",)),
    Kind("state_not_finite", _on_column(_not_finite), ("nan_state",)),
    Kind("joints_in_degrees", _on_column(_degrees), ("joint_out_of_range",)),
    Kind("gripper_raw", _on_column(_raw_gripper), ("invalid_gripper",)),
    Kind("clock_jumps", _on_column(_lost_frames, "timestamp"), ("wrong_fps",)),
)


def _frozen(frames: np.ndarray, random: np.random.Generator) -> np.ndarray:
    return np.repeat(frames[:1], len(frames), axis=0)


def _black(frames: np.ndarray, random: np.random.Generator) -> np.ndarray:
    frames[int(random.integers(0, 6)) :] = random.integers(0, 6)
    return frames


def _noise(frames: np.ndarray, random: np.random.Generator) -> np.ndarray:
    start = int(random.integers(0, 6))
    frames[start:] = random.integers(0, 256, frames[start:].shape, dtype=np.uint8)
    return frames


def _driving(frames: np.ndarray, random: np.random.Generator) -> np.ndarray:
    step = int(random.choice([-2, 2]))
    return np.stack([np.roll(frame, (n, step * n), axis=(0, 1)) for n, frame in enumerate(frames)])


_PICTURES: tuple[tuple[str, PictureDefect, tuple[str, ...]], ...] = (
    ("camera_frozen", _frozen, ("corrupted", "frozen")),
    ("camera_black", _black, ("corrupted", "too_dark")),
    ("camera_noise", _noise, ("corrupted", "noise")),
    ("base_drives", _driving, ("base_motion",)),
)


def write(root: Path, healthy: int, each: int, random: np.random.Generator) -> tuple[list[Label], dict[str, Any]]:
    """One dataset: labels, and the `curate.sources[]` entry that reads it."""
    labels: list[Label] = []
    seeds: list[int] = []
    lengths: list[int] = []

    def add(
        kind: str = "clean",
        stage: Stage = "kept",
        reasons: tuple[str, ...] = (),
        *,
        seed: int | None = None,
        num_frames: int = NUM_FRAMES,
        change: PictureDefect | None = None,
        still: bool = False,
    ) -> _Episode:
        """The next episode; equal seeds make equal ones."""
        episode = _Episode(root, len(labels))
        labels.append(Label(f"{root.name}-{episode.index:06d}", "lerobot_v21", kind, stage, reasons))
        seeds.append(int(random.integers(2**32)) if seed is None else seed)
        lengths.append(num_frames)
        _write_episode(episode, np.random.default_rng(seeds[-1]), num_frames, change, still=still)
        return episode

    for _ in range(healthy):
        add()
    for number in range(each):
        for kind in KINDS:
            kind.spoil(add(kind.name, "curate", kind.reasons), random)
        add("too_short", "filter", ("too_short",), num_frames=4)
        if number < healthy:
            add("duplicate", "curate", ("duplicate", "near_duplicate"), seed=seeds[number])
        for name, change, reasons in _PICTURES:
            add(name, "filter", reasons, change=change)
        add("still", "filter", ("static",), change=_frozen, still=True)
    _write_meta(root, lengths)
    source = {"kind": "lerobot_v21", "path": str(root), "name": root.name, "views": _VIEWS, "split": "train"}
    return labels, source | {"embodiment": EMBODIMENT, "angle_unit": "rad"}


def _write_episode(
    episode: _Episode, random: np.random.Generator, num_frames: int, change: PictureDefect | None, *, still: bool
) -> None:
    """Files of one episode; `change` spoils the pictures of the head camera, of a still one those of both."""
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
            "episode_index": pa.array(np.full(num_frames, episode.index)),
            "index": pa.array(index),
            "task_index": pa.array(np.zeros(num_frames, dtype=np.int64)),
        }
    )
    episode.table.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, episode.table)
    for number, path in enumerate(episode.videos):
        path.parent.mkdir(parents=True, exist_ok=True)
        frames = pictures(random, num_frames)
        if change is not None and (number == 0 or still):
            frames = change(frames, random)
        encode_video(path, frames, FPS, preset="ultrafast")


def _write_meta(root: Path, lengths: list[int]) -> None:
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
    rows = [{"episode_index": n, "tasks": [_TASK], "length": length} for n, length in enumerate(lengths)]
    (meta / "episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (meta / "tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": _TASK}) + "\n")
