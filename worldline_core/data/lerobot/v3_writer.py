"""Assemble waiting episodes into a LeRobotDataset v3.0 (LeRobot 0.6 opens it with its own class)."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from worldline_core.data.episodes.episode_parts import Part
from worldline_core.data.episodes.view_recording import as_json, image_statistics, vector_statistics
from worldline_core.data.lerobot.v3 import (
    DATA_PATH,
    EPISODES_PATH,
    IMAGE_PREFIX,
    VERSION,
    VIDEO_PATH,
    write_table,
)
from worldline_core.data.video.encoder import concatenate_videos
from worldline_core.data.video.thumbnails import cache_path
from worldline_core.store.atomic import atomic_path, write_json_atomic

_CHUNK_SIZE = 1000
_DATA_MEGABYTES = 100
_VIDEO_MEGABYTES = 200


def write_dataset(root: Path, parts: Sequence[Part], *, video_megabytes: int = _VIDEO_MEGABYTES) -> None:
    """Write the dataset of parts with equal signatures; episode i is parts[i].

    A rerun over a half-written folder overwrites each file with the same bytes.
    """
    first = parts[0]
    fps = first["fps"]
    lengths = [part["video_frames"] for part in parts]
    starts = np.concatenate([[0], np.cumsum(lengths)]).astype(int)
    instructions = list(dict.fromkeys(part["instruction"] for part in parts))
    task_of = {text: index for index, text in enumerate(instructions)}

    table = _data_table(parts, starts, task_of)
    data_files = _files_by_size([24 * length * max(table.num_columns, 1) for length in lengths], _DATA_MEGABYTES)
    places = {view: _write_videos(root, view, parts, video_megabytes) for view in first.views}
    episodes = []
    for file in sorted(set(data_files)):
        members = [index for index, other in enumerate(data_files) if other == file]
        begin, end = int(starts[members[0]]), int(starts[members[-1] + 1])
        path = root / DATA_PATH.format(chunk_index=file // _CHUNK_SIZE, file_index=file % _CHUNK_SIZE)
        write_table(path, table.slice(begin, end - begin), rows_per_group=[lengths[index] for index in members])
    for index, part in enumerate(parts):
        statistics = _episode_statistics(part, table.slice(int(starts[index]), lengths[index]))
        row: dict[str, Any] = {
            "episode_index": index,
            "tasks": [part["instruction"]],
            "length": lengths[index],
            "data/chunk_index": data_files[index] // _CHUNK_SIZE,
            "data/file_index": data_files[index] % _CHUNK_SIZE,
            "dataset_from_index": int(starts[index]),
            "dataset_to_index": int(starts[index + 1]),
        }
        for view in first.views:
            row |= places[view][index]
        for key, feature in statistics.items():
            row |= {f"stats/{key}/{name}": value.tolist() for name, value in feature.items()}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        episodes.append(row)
    write_table(root / EPISODES_PATH.format(chunk_index=0, file_index=0), pa.Table.from_pylist(episodes))
    write_table(root / "meta" / "tasks.parquet", _tasks_table(instructions))
    write_json_atomic(root / "meta" / "stats.json", as_json(_dataset_statistics(parts, table)))
    write_json_atomic(root / "meta" / "info.json", _info(parts, len(instructions), video_megabytes, fps))


def _files_by_size(sizes: Sequence[float], megabytes: int) -> list[int]:
    """File number of each item when a file is closed before it would exceed `megabytes`."""
    files, current, filled = [], 0, 0.0
    for size in sizes:
        if filled and filled + size > megabytes * 2**20:
            current, filled = current + 1, 0.0
        files.append(current)
        filled += size
    return files


def _data_table(parts: Sequence[Part], starts: np.ndarray, task_of: dict[str, int]) -> pa.Table:
    columns: dict[str, list[np.ndarray]] = {}
    for index, part in enumerate(parts):
        length, fps = part["video_frames"], part["fps"]
        frame_index = np.arange(length, dtype=np.int64)
        values = {
            "observation.state": part.arrays["state"][:length],
            "action": part.arrays["action"][:length],
            "timestamp": (frame_index / fps).astype(np.float32),
            "frame_index": frame_index,
            "episode_index": np.full(length, index, dtype=np.int64),
            "index": frame_index + int(starts[index]),
            "task_index": np.full(length, task_of[part["instruction"]], dtype=np.int64),
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


def _video_files(parts: Sequence[Part], view: str, megabytes: int) -> list[list[Part]]:
    """Which episodes share a file: those encoded here up to a size, none where the video was copied as it was recorded.

    Copied videos may differ in parameter sets, and have frames stored out of order: joined they could not be found again
    exactly.
    """
    files: list[list[Part]] = []
    filled, open_to_more = 0, False
    for part in parts:
        size = part.video(view).stat().st_size
        joins = open_to_more and not part.copied(view) and filled + size <= megabytes * 2**20
        if joins:
            files[-1].append(part)
        else:
            files.append([part])
        filled = filled + size if joins else size
        open_to_more = not part.copied(view)
    return files


def _write_videos(root: Path, view: str, parts: Sequence[Part], megabytes: int) -> list[dict[str, Any]]:
    """Join the clips of one view; returns the videos/<key>/* columns of each episode."""
    key = IMAGE_PREFIX + view
    rows: list[dict[str, Any]] = []
    for file, members in enumerate(_video_files(parts, view, megabytes)):
        chunk_index, file_index = file // _CHUNK_SIZE, file % _CHUNK_SIZE
        target = root / VIDEO_PATH.format(video_key=key, chunk_index=chunk_index, file_index=file_index)
        with atomic_path(target) as temporary:
            if members[0].copied(view):
                _link(members[0].video(view), temporary)
            else:
                concatenate_videos(
                    temporary, [(part.video(view), part["video_frames"]) for part in members], members[0]["fps"]
                )
        if members[0].copied(view):
            thumbnails = cache_path(root.parents[1], target)
            thumbnails.parent.mkdir(parents=True, exist_ok=True)
            _link(members[0].thumbnails(view), thumbnails)
        frame = 0
        for part in members:
            rows.append(
                {
                    f"videos/{key}/chunk_index": chunk_index,
                    f"videos/{key}/file_index": file_index,
                    f"videos/{key}/from_timestamp": frame / part["fps"],
                    f"videos/{key}/to_timestamp": (frame + part["video_frames"]) / part["fps"],
                }
            )
            frame += part["video_frames"]
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


def _episode_statistics(part: Part, table: pa.Table) -> dict[str, dict[str, np.ndarray]]:
    statistics = {name: vector_statistics(_column(table, name)) for name in table.column_names}
    for view in part.views:
        statistics[IMAGE_PREFIX + view] = image_statistics([part.arrays[f"histogram.{view}"]], part["video_frames"])
    return statistics


def _dataset_statistics(parts: Sequence[Part], table: pa.Table) -> dict[str, dict[str, np.ndarray]]:
    statistics = {name: vector_statistics(_column(table, name)) for name in table.column_names}
    for view in parts[0].views:
        histograms = [part.arrays[f"histogram.{view}"] for part in parts]
        statistics[IMAGE_PREFIX + view] = image_statistics(histograms, sum(part["video_frames"] for part in parts))
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


def _info(parts: Sequence[Part], total_tasks: int, video_megabytes: int, fps: float) -> dict[str, Any]:
    first = parts[0]
    width = first.arrays["state"].shape[1]
    names = first["state_names"] or [f"state_{index}" for index in range(width)]
    features: dict[str, Any] = {
        key: {"dtype": "float32", "shape": [width], "names": names} for key in ("observation.state", "action") if width
    }
    for view, (image_height, image_width) in first.image_sizes.items():
        features[IMAGE_PREFIX + view] = {
            "dtype": "video",
            "shape": [image_height, image_width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": image_height,
                "video.width": image_width,
                "video.codec": first["videos"][view]["codec"],
                "video.pix_fmt": first["videos"][view]["pixel_format"],
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
        "robot_type": first["embodiment"],
        "total_episodes": len(parts),
        "total_frames": sum(part["video_frames"] for part in parts),
        "total_tasks": total_tasks,
        "chunks_size": _CHUNK_SIZE,
        "data_files_size_in_mb": _DATA_MEGABYTES,
        "video_files_size_in_mb": video_megabytes,
        "fps": int(fps) if fps == int(fps) else fps,
        "splits": {"train": f"0:{len(parts)}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH,
        "features": features,
    }
