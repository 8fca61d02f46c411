"""LeRobotDataset v2.1 with defects: one Parquet and one mp4 a view for each episode."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tools.corrupted import defects
from tools.corrupted.content import FPS, NUM_FRAMES, gripper_motion, joint_motion, pictures
from tools.corrupted.defects import SECOND, Kind, Label, Stage
from worldline_core.data.video.encoder import encode_video

EMBODIMENT = "ur5e_pair"
_JOINTS = 6
_NAMES = [f"{arm}/{name}" for arm in ("left", "right") for name in (*(f"joint_{j}" for j in range(6)), "gripper")]
_VIEWS = {"observation.images.top": "head", "observation.images.wrist": "right_wrist"}
_BASES = 4
_TASK = "lift the block"
PictureDefect = Callable[[np.ndarray, np.random.Generator], np.ndarray]


@dataclass(frozen=True)
class _Episode:
    """Files of one episode, and its rows in the lists."""

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


def _on_video(defect: defects.FileDefect) -> Callable[[_Episode, np.random.Generator], None]:
    return lambda episode, random: defect(episode.video(random), random)


def _on_table(defect: defects.FileDefect) -> Callable[[_Episode, np.random.Generator], None]:
    return lambda episode, random: defect(episode.table, random)


def _on_state(
    change: Callable[[np.ndarray, np.random.Generator], np.ndarray], column: str = "observation.state"
) -> Callable[[_Episode, np.random.Generator], None]:
    def spoil(episode: _Episode, random: np.random.Generator) -> None:
        table = pq.read_table(episode.table)
        values = np.array(table[column].to_pylist(), dtype=np.float32)
        changed = change(values, random)
        kind = pa.array(changed.tolist()) if changed.ndim > 1 else pa.array(changed)
        table = table.set_column(table.column_names.index(column), column, kind)
        pq.write_table(table, episode.table)

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


def _without_column(episode: _Episode, random: np.random.Generator) -> None:
    name = str(random.choice(["observation.state", "action", "timestamp", "task_index"]))
    pq.write_table(pq.read_table(episode.table).drop_columns([name]), episode.table)


def _uneven_rows(episode: _Episode, random: np.random.Generator) -> None:
    table = pq.read_table(episode.table)
    rows = table["observation.state"].to_pylist()
    rows[3], rows[4] = rows[3][:-2], [*rows[4], 0.0, 0.0]  # the number of values is still right
    table = table.set_column(
        table.column_names.index("observation.state"), "observation.state", pa.array(rows, pa.list_(pa.float32()))
    )
    pq.write_table(table, episode.table)


def _video_of_other_length(episode: _Episode, random: np.random.Generator) -> None:
    frames = pictures(random, NUM_FRAMES + int(random.integers(1, 8)))
    encode_video(episode.video(random), frames, FPS, preset="ultrafast")


KINDS = (
    Kind("video_truncated", _on_video(defects.truncate), ("truncated_video",)),
    Kind("video_missing", _on_video(defects.missing), ("missing_file",)),
    Kind("video_pipe", _on_video(defects.pipe), ("special_file", "missing_file")),
    Kind("video_linked_out", _on_video(defects.link_out), ("path_traversal",)),
    Kind("video_claims_frames", _on_video(defects.claim_frames), ("too_large", "truncated_video", "out_of_memory")),
    Kind("video_too_long", _video_of_other_length, ("length_mismatch",)),
    Kind("table_truncated", _on_table(defects.truncate), ("unreadable",)),
    Kind("table_missing", _on_table(defects.missing), ("missing_file",)),
    Kind("column_missing", _without_column, ("missing_column",)),
    Kind("rows_uneven", _uneven_rows, ("length_mismatch",)),
    Kind("state_not_finite", _on_state(_not_finite), ("nan_state",)),
    Kind("joints_in_degrees", _on_state(_degrees), ("joint_out_of_range",)),
    Kind("gripper_raw", _on_state(_raw_gripper), ("invalid_gripper",)),
    Kind("clock_jumps", _on_state(_lost_frames, "timestamp"), ("wrong_fps",)),
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


@dataclass
class _Dataset:
    """Episodes so far: their truth, and their rows in the list."""

    root: Path
    labels: list[Label] = field(default_factory=list)
    rows: list[dict[str, Any]] = field(default_factory=list)
    count: int = 0

    def add(
        self, kind: str, stage: Stage = "curate", reasons: tuple[str, ...] = (), num_frames: int = NUM_FRAMES
    ) -> _Episode:
        episode = _Episode(self.root, self.count)
        self.rows.append({"episode_index": self.count, "tasks": [_TASK], "length": num_frames})
        self.labels.append(Label(f"{self.root.name}-{self.count:06d}", "lerobot_v21", kind, stage, reasons))
        self.count += 1
        return episode

    def list_again(self) -> None:
        """The last episode a second time; its second id names its source, whose number is not known yet."""
        last = self.labels[-1]
        self.labels.append(replace(last, episode_id=f"{last.episode_id}{SECOND}"))
        self.rows.append(self.rows[-1])


def write(root: Path, healthy: int, each: int, random: np.random.Generator) -> tuple[list[Label], dict[str, Any]]:
    """One dataset: labels, and the `curate.sources[]` entry that reads it."""
    dataset = _Dataset(root)
    for _ in range(healthy):
        _write_episode(dataset.add("clean", "kept"), random, NUM_FRAMES)
    bases = [_Episode(root.parent / f"{root.name}_bases", number) for number in range(_BASES)]
    for base in bases:
        _write_episode(base, random, NUM_FRAMES)
    for kind in KINDS:
        for number in range(each):
            episode = dataset.add(kind.name, kind.stage, kind.reasons)
            _copy(bases[number % _BASES], episode)
            kind.spoil(episode, random)
    for number in range(each):
        _write_episode(dataset.add("too_short", "filter", ("too_short",), num_frames=4), random, 4)
        if number < healthy:
            _copy(_Episode(root, number), dataset.add("duplicate", "curate", ("duplicate", "near_duplicate")))
        if number % 2:
            _copy(bases[number % _BASES], dataset.add("listed_twice", "curate", ("duplicate_id",)))
            dataset.list_again()
        sound = dataset.add("video_claims_pixels", "kept")  # the stream itself says how large its pictures are
        _write_episode(sound, random, NUM_FRAMES)
        defects.claim_pixels(sound.video(random), random)
        for name, change, reasons in _PICTURES:
            _write_episode(dataset.add(name, "filter", reasons), random, NUM_FRAMES, change)
        _write_episode(dataset.add("still", "filter", ("static",)), random, NUM_FRAMES, _frozen, still=True)
    shutil.rmtree(bases[0].root)
    _write_meta(root, dataset.rows)
    source = {
        "kind": "lerobot_v21",
        "path": str(root),
        "name": root.name,
        "embodiment": EMBODIMENT,
        "angle_unit": "rad",
        "views": _VIEWS,
        "split": "train",
    }
    return dataset.labels, source


def _write_episode(
    episode: _Episode,
    random: np.random.Generator,
    num_frames: int,
    change: PictureDefect | None = None,
    *,
    still: bool = False,
) -> None:
    """Files of one episode; `change` spoils the pictures of the head camera."""
    arms = [
        np.concatenate([joint_motion(random, _JOINTS, num_frames), gripper_motion(random, num_frames)[:, None]], axis=1)
        for _ in range(2)
    ]
    state = np.concatenate(arms, axis=1).astype(np.float32)
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


def _copy(base: _Episode, episode: _Episode) -> None:
    for source, target in zip((base.table, *base.videos), (episode.table, *episode.videos), strict=True):
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)
    table = pq.read_table(episode.table)
    numbers = pa.array(np.full(len(table), episode.index))
    place = table.schema.get_field_index("episode_index")
    pq.write_table(table.set_column(place, "episode_index", numbers), episode.table)


def _write_meta(root: Path, listed: list[dict[str, Any]]) -> None:
    image = {"dtype": "video", "shape": [72, 96, 3], "names": ["height", "width", "channels"]}
    vector = {"dtype": "float32", "shape": [len(_NAMES)], "names": _NAMES}
    info = {
        "codebase_version": "v2.1",
        "robot_type": EMBODIMENT,
        "total_episodes": len(listed),
        "total_frames": sum(row["length"] for row in listed),
        "fps": FPS,
        "chunks_size": 100_000,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
        "features": {"observation.state": vector, "action": vector, **dict.fromkeys(_VIEWS, image)},
    }
    meta = root / "meta"
    meta.mkdir(parents=True, exist_ok=True)
    (meta / "info.json").write_text(json.dumps(info))
    (meta / "episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in listed))
    (meta / "tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": _TASK}) + "\n")
