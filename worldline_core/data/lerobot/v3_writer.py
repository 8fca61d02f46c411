"""Assemble episodes into a LeRobotDataset v3.0 (LeRobot 0.6 opens it with its own class)."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from worldline_core.data.lerobot.dataset import DATA_PATH, IMAGE_PREFIX, VERSION, VIDEO_PATH
from worldline_core.data.lerobot.statistics import as_json, image_statistics, vector_statistics
from worldline_core.data.video.encoder import concatenate_videos
from worldline_core.data.video.thumbnails import cache_path
from worldline_core.store.atomic import atomic_path, write_json_atomic, write_table_atomic

_CHUNK_SIZE = 1000
_EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
_DATA_MEGABYTES = 100
_VIDEO_MEGABYTES = 200


@dataclass(frozen=True)
class EpisodeVideo:
    """The finished video of one view.

    Attributes:
        size: (height, width).
        codec, pixel_format: as FFmpeg names them.
        copied: whether it holds the packets of the recording, and so shares no file with other episodes.
        histogram: (3, 256) counts of sampled pixels, from `ImageSampler`.
        thumbnails: file of the thumbnails of a copied video.
    """

    path: Path
    size: tuple[int, int]
    codec: str
    pixel_format: str
    copied: bool
    histogram: np.ndarray
    thumbnails: Path


@dataclass(frozen=True)
class DatasetEpisode:
    """One episode of a dataset.

    Attributes:
        num_frames: of state, action and every video.
        state, action: (num_frames, J) float32; J may be 0.
        videos: by view, in the order of the dataset's features.
    """

    instruction: str
    embodiment: str
    fps: float
    num_frames: int
    state: np.ndarray
    action: np.ndarray
    state_names: list[str] | None
    videos: Mapping[str, EpisodeVideo]


def write_dataset(root: Path, episodes: Sequence[DatasetEpisode], *, video_megabytes: int = _VIDEO_MEGABYTES) -> None:
    """Write the dataset of episodes that have the same features and rate.

    A rerun over a half-written folder overwrites each file with the same bytes.
    """
    first = episodes[0]
    fps = first.fps
    lengths = [episode.num_frames for episode in episodes]
    starts = np.concatenate([[0], np.cumsum(lengths)]).astype(int)
    instructions = list(dict.fromkeys(episode.instruction for episode in episodes))
    task_of = {text: index for index, text in enumerate(instructions)}

    table = _data_table(episodes, starts, task_of)
    data_files = _files_by_size([24 * length * max(table.num_columns, 1) for length in lengths], _DATA_MEGABYTES)
    places = {view: _write_videos(root, view, episodes, video_megabytes) for view in first.videos}
    rows = []
    for file in sorted(set(data_files)):
        members = [index for index, other in enumerate(data_files) if other == file]
        begin, end = int(starts[members[0]]), int(starts[members[-1] + 1])
        path = root / DATA_PATH.format(chunk_index=file // _CHUNK_SIZE, file_index=file % _CHUNK_SIZE)
        write_table_atomic(path, table.slice(begin, end - begin), rows_per_group=[lengths[index] for index in members])
    for index, episode in enumerate(episodes):
        statistics = _statistics([episode], table.slice(int(starts[index]), lengths[index]))
        row: dict[str, Any] = {
            "episode_index": index,
            "tasks": [episode.instruction],
            "length": lengths[index],
            "data/chunk_index": data_files[index] // _CHUNK_SIZE,
            "data/file_index": data_files[index] % _CHUNK_SIZE,
            "dataset_from_index": int(starts[index]),
            "dataset_to_index": int(starts[index + 1]),
        }
        for view in first.videos:
            row |= places[view][index]
        for key, feature in statistics.items():
            row |= {f"stats/{key}/{name}": value.tolist() for name, value in feature.items()}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        rows.append(row)
    write_table_atomic(root / _EPISODES_PATH, pa.Table.from_pylist(rows))
    write_table_atomic(root / "meta" / "tasks.parquet", _tasks_table(instructions))
    write_json_atomic(root / "meta" / "stats.json", as_json(_statistics(episodes, table)))
    write_json_atomic(root / "meta" / "info.json", _info(episodes, len(instructions), video_megabytes, fps))


def _files_by_size(sizes: Sequence[float], megabytes: int) -> list[int]:
    """File number of each item when a file is closed before it would exceed `megabytes`."""
    files, current, filled = [], 0, 0.0
    for size in sizes:
        if filled and filled + size > megabytes * 2**20:
            current, filled = current + 1, 0.0
        files.append(current)
        filled += size
    return files


def _data_table(episodes: Sequence[DatasetEpisode], starts: np.ndarray, task_of: dict[str, int]) -> pa.Table:
    columns: dict[str, list[np.ndarray]] = {}
    for index, episode in enumerate(episodes):
        length, fps = episode.num_frames, episode.fps
        frame_index = np.arange(length, dtype=np.int64)
        values = {
            "observation.state": episode.state,
            "action": episode.action,
            "timestamp": (frame_index / fps).astype(np.float32),
            "frame_index": frame_index,
            "episode_index": np.full(length, index, dtype=np.int64),
            "index": frame_index + int(starts[index]),
            "task_index": np.full(length, task_of[episode.instruction], dtype=np.int64),
        }
        for name, value in values.items():
            if value.size:  # an episode without states has no such columns: LeRobot knows no empty feature
                columns.setdefault(name, []).append(value)
    arrays: dict[str, pa.Array] = {}
    for name, chunks in columns.items():
        joined = np.concatenate(chunks)
        flat = pa.array(joined.reshape(-1))
        arrays[name] = flat if joined.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, joined.shape[1])
    return pa.table(arrays)


def _video_files(episodes: Sequence[DatasetEpisode], view: str, megabytes: int) -> list[list[DatasetEpisode]]:
    """Which episodes share a file: those encoded here up to a size; a video that was copied as it was recorded has its own.

    Copied videos may differ in parameter sets, and have frames stored out of order: joined they could not be found again
    exactly.
    """
    files: list[list[DatasetEpisode]] = []
    filled, open_to_more = 0, False
    for episode in episodes:
        size = episode.videos[view].path.stat().st_size
        joins = open_to_more and not episode.videos[view].copied and filled + size <= megabytes * 2**20
        if joins:
            files[-1].append(episode)
        else:
            files.append([episode])
        filled = filled + size if joins else size
        open_to_more = not episode.videos[view].copied
    return files


def _write_videos(root: Path, view: str, episodes: Sequence[DatasetEpisode], megabytes: int) -> list[dict[str, Any]]:
    """Join the clips of one view; returns the videos/<key>/* columns of each episode."""
    key = IMAGE_PREFIX + view
    rows: list[dict[str, Any]] = []
    for file, members in enumerate(_video_files(episodes, view, megabytes)):
        chunk_index, file_index = file // _CHUNK_SIZE, file % _CHUNK_SIZE
        target = root / VIDEO_PATH.format(video_key=key, chunk_index=chunk_index, file_index=file_index)
        with atomic_path(target) as temporary:
            if members[0].videos[view].copied:
                _link(members[0].videos[view].path, temporary)
            else:
                concatenate_videos(
                    temporary, [(episode.videos[view].path, episode.num_frames) for episode in members], members[0].fps
                )
        if members[0].videos[view].copied:
            thumbnails = cache_path(root.parents[1], target)
            thumbnails.parent.mkdir(parents=True, exist_ok=True)
            _link(members[0].videos[view].thumbnails, thumbnails)
        frame = 0
        for episode in members:
            rows.append(
                {
                    f"videos/{key}/chunk_index": chunk_index,
                    f"videos/{key}/file_index": file_index,
                    f"videos/{key}/from_timestamp": frame / episode.fps,
                    f"videos/{key}/to_timestamp": (frame + episode.num_frames) / episode.fps,
                }
            )
            frame += episode.num_frames
    return rows


def _link(existing: Path, name: Path) -> None:
    """A second name of a file that is never changed, or a copy where the file system has no links."""
    name.unlink(missing_ok=True)
    try:
        name.hardlink_to(existing)
    except OSError:
        shutil.copyfile(existing, name)


def _column(table: pa.Table, name: str) -> np.ndarray:
    values = table[name].combine_chunks()
    if pa.types.is_fixed_size_list(values.type):
        return values.flatten().to_numpy().reshape(len(values), -1)
    return values.to_numpy(zero_copy_only=False)


def _statistics(episodes: Sequence[DatasetEpisode], table: pa.Table) -> dict[str, dict[str, np.ndarray]]:
    """Feature -> statistics over these episodes, whose rows are the table's."""
    statistics = {name: vector_statistics(_column(table, name)) for name in table.column_names}
    num_frames = sum(episode.num_frames for episode in episodes)
    for view in episodes[0].videos:
        histograms = [episode.videos[view].histogram for episode in episodes]
        statistics[IMAGE_PREFIX + view] = image_statistics(histograms, num_frames)
    return statistics


def _tasks_table(instructions: Sequence[str]) -> pa.Table:
    """LeRobot reads this file with pandas and expects the task text as the index."""
    table = pa.table({"task_index": pa.array(range(len(instructions)), pa.int64()), "task": pa.array(instructions)})
    described = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_kind, "metadata": None}
        for name, kind, numpy_kind in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    metadata = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": described,
        "pandas_version": "2.0.0",
    }
    return table.replace_schema_metadata({"pandas": json.dumps(metadata)})


def _info(episodes: Sequence[DatasetEpisode], total_tasks: int, video_megabytes: int, fps: float) -> dict[str, Any]:
    first = episodes[0]
    width = first.state.shape[1]
    names = first.state_names or [f"state_{index}" for index in range(width)]
    features: dict[str, Any] = {
        key: {"dtype": "float32", "shape": [width], "names": names} for key in ("observation.state", "action") if width
    }
    for view, video in first.videos.items():
        image_height, image_width = video.size
        features[IMAGE_PREFIX + view] = {
            "dtype": "video",
            "shape": [image_height, image_width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": image_height,
                "video.width": image_width,
                "video.codec": video.codec,
                "video.pix_fmt": video.pixel_format,
                "video.fps": int(fps) if fps == int(fps) else fps,
                "video.channels": 3,
                "has_audio": False,
                "is_depth_map": False,
            },
        }
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    for name in ("frame_index", "episode_index", "index", "task_index"):
        features[name] = {"dtype": "int64", "shape": [1], "names": None}
    return {
        "codebase_version": VERSION,
        "robot_type": first.embodiment,
        "total_episodes": len(episodes),
        "total_frames": sum(episode.num_frames for episode in episodes),
        "total_tasks": total_tasks,
        "chunks_size": _CHUNK_SIZE,
        "data_files_size_in_mb": _DATA_MEGABYTES,
        "video_files_size_in_mb": video_megabytes,
        "fps": int(fps) if fps == int(fps) else fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH,
        "features": features,
    }
