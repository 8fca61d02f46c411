"""Assemble episodes into a LeRobotDataset v3.0 (LeRobot 0.6 opens it with its own class)."""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from worldline_core.data.episodes.episode import Episode
from worldline_core.data.lerobot.dataset import DATA_PATH, IMAGE_PREFIX, VERSION, VIDEO_PATH, numeric_column
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
    """

    path: Path
    size: tuple[int, int]
    codec: str
    pixel_format: str
    copied: bool
    histogram: np.ndarray

    @property
    def thumbnails(self) -> Path:
        """File of the thumbnails of a copied video, until the set is assembled."""
        return self.path.with_suffix(".npz")


def write_dataset(root: Path, episodes: Sequence[Episode], videos: Sequence[Mapping[str, EpisodeVideo]]) -> None:
    """Write the dataset of episodes that have the same features and rate, and images in each frame.

    A rerun over a half-written folder overwrites each file with the same bytes.

    Args:
        videos: of each episode by view, in the order of the dataset's features.
    """
    lengths = [episode.num_frames for episode in episodes]
    starts = np.concatenate([[0], np.cumsum(lengths)]).astype(int).tolist()
    instructions = list(dict.fromkeys(episode.instruction for episode in episodes))
    table = _data_table(episodes, starts, {text: index for index, text in enumerate(instructions)})
    by_view = {view: [own[view] for own in videos] for view in videos[0]}
    places = [_write_videos(root, view, found, lengths, episodes[0].fps) for view, found in by_view.items()]
    histograms = {view: [video.histogram for video in found] for view, found in by_view.items()}
    sizes = [24 * length * max(table.num_columns, 1) for length in lengths]
    rows: list[dict[str, Any]] = []
    for file, members in enumerate(_files_by_size(sizes, _DATA_MEGABYTES)):
        begin, end = starts[members[0]], starts[members[-1] + 1]
        place = _place(file)
        groups = [lengths[index] for index in members]
        write_table_atomic(root / DATA_PATH.format(**place), table.slice(begin, end - begin), rows_per_group=groups)
        for index in members:
            row: dict[str, Any] = {
                "episode_index": index,
                "tasks": [episodes[index].instruction],
                "length": lengths[index],
                **{f"data/{name}": number for name, number in place.items()},
                "dataset_from_index": starts[index],
                "dataset_to_index": starts[index + 1],
            }
            for columns in places:
                row |= columns[index]
            own = {view: counts[index : index + 1] for view, counts in histograms.items()}
            statistics = _statistics(table.slice(starts[index], lengths[index]), own)
            for key, feature in statistics.items():
                row |= {f"stats/{key}/{name}": value.tolist() for name, value in feature.items()}
            rows.append(row | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})
    write_table_atomic(root / _EPISODES_PATH, pa.Table.from_pylist(rows))
    write_table_atomic(root / "meta" / "tasks.parquet", _tasks_table(instructions))
    statistics = _statistics(table, histograms)
    as_lists = {key: {name: v.tolist() for name, v in feature.items()} for key, feature in statistics.items()}
    write_json_atomic(root / "meta" / "stats.json", as_lists)
    write_json_atomic(root / "meta" / "info.json", _info(episodes, videos[0], len(instructions)))


def _place(file: int) -> dict[str, int]:
    return {"chunk_index": file // _CHUNK_SIZE, "file_index": file % _CHUNK_SIZE}


def _files_by_size(sizes: Sequence[int], megabytes: int, alone: Collection[int] = ()) -> list[list[int]]:
    """Indices of the items of each file: a file is closed before it would exceed `megabytes`; some items have one alone."""
    files: list[list[int]] = []
    filled = 0
    for index, size in enumerate(sizes):
        apart = index in alone or index - 1 in alone
        if not files or apart or filled + size > megabytes * 2**20:
            files.append([])
            filled = 0
        files[-1].append(index)
        filled += size
    return files


def _data_table(episodes: Sequence[Episode], starts: Sequence[int], task_of: dict[str, int]) -> pa.Table:
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
            "index": frame_index + starts[index],
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


def _write_videos(
    root: Path, view: str, videos: Sequence[EpisodeVideo], lengths: Sequence[int], fps: float
) -> list[dict[str, Any]]:
    """Join the clips of one view; returns the videos/<key>/* columns of each episode.

    A video that was copied as it was recorded has a file of its own: copied videos may differ in parameter sets, and have
    frames stored out of order, so that joined they could not be found again exactly.
    """
    key = IMAGE_PREFIX + view
    rows: list[dict[str, Any]] = []
    copied = {index for index, video in enumerate(videos) if video.copied}
    sizes = [video.path.stat().st_size for video in videos]
    for file, members in enumerate(_files_by_size(sizes, _VIDEO_MEGABYTES, alone=copied)):
        place = _place(file)
        target = root / VIDEO_PATH.format(video_key=key, **place)
        first = videos[members[0]]
        with atomic_path(target) as temporary:
            if first.copied:
                _link(first.path, temporary)
            else:
                concatenate_videos(temporary, [(videos[i].path, lengths[i]) for i in members], fps)
        if first.copied:
            thumbnails = cache_path(root.parents[1], target)
            thumbnails.parent.mkdir(parents=True, exist_ok=True)
            _link(first.thumbnails, thumbnails)
        frame = 0
        for index in members:
            stop = frame + lengths[index]
            rows.append(
                {
                    **{f"videos/{key}/{name}": number for name, number in place.items()},
                    f"videos/{key}/from_timestamp": frame / fps,
                    f"videos/{key}/to_timestamp": stop / fps,
                }
            )
            frame = stop
    return rows


def _link(existing: Path, name: Path) -> None:
    """A second name of a file that is never changed, or a copy where the file system has no links."""
    name.unlink(missing_ok=True)
    try:
        name.hardlink_to(existing)
    except OSError:
        shutil.copyfile(existing, name)


def _statistics(table: pa.Table, histograms: Mapping[str, Sequence[np.ndarray]]) -> dict[str, dict[str, np.ndarray]]:
    """Feature -> statistics over the episodes that have these rows, and by view these counts of pixels."""
    columns = {name: numeric_column(table[name], len(table), name) for name in table.column_names}
    statistics = {name: vector_statistics(values) for name, values in columns.items()}
    for view, counts in histograms.items():
        statistics[IMAGE_PREFIX + view] = image_statistics(counts, len(table))
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


def _info(episodes: Sequence[Episode], videos: Mapping[str, EpisodeVideo], total_tasks: int) -> dict[str, Any]:
    first = episodes[0]
    fps = int(first.fps) if first.fps == int(first.fps) else first.fps
    width = first.state.shape[1]
    names = list(first.state_names or ()) or [f"state_{index}" for index in range(width)]
    features: dict[str, Any] = {
        key: {"dtype": "float32", "shape": [width], "names": names} for key in ("observation.state", "action") if width
    }
    for view, video in videos.items():
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
                "video.fps": fps,
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
        "video_files_size_in_mb": _VIDEO_MEGABYTES,
        "fps": fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH,
        "features": features,
    }


QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_MAX_IMAGES = 32
_LARGE_SIDE = 300
_SAMPLED_SIDE = 150


def vector_statistics(values: np.ndarray) -> dict[str, np.ndarray]:
    """Statistics over axis 0 of (N, D) values; exact, in float64.

    Rows with a value that is not finite are left out (a broken recording can still be stored, and is recognised later).
    """
    data = values.astype(np.float64)
    data = data[:, None] if data.ndim == 1 else data
    count = len(data)
    data = data[np.isfinite(data).all(axis=1)]
    data = data if len(data) else np.zeros((1, values.reshape(count, -1).shape[1]))
    result = {
        "min": data.min(axis=0),
        "max": data.max(axis=0),
        "mean": data.mean(axis=0),
        "std": data.std(axis=0),
        "count": np.array([count], dtype=np.int64),
    }
    levels = np.quantile(data, list(QUANTILES.values()), axis=0)
    return result | dict(zip(QUANTILES, levels, strict=True))


class ImageSampler:
    """Counts the values of some pixels of some pictures, as LeRobot does (datasets/compute_stats.py): at most 32 pictures
    evenly spread, and of images above 300 pixels every k-th pixel of both sides, k such that about 150 remain.

    Args:
        num_frames: of the video.
    """

    def __init__(self, num_frames: int) -> None:
        spread = np.linspace(0, num_frames - 1, min(num_frames, _MAX_IMAGES))
        self._chosen = frozenset(np.unique(spread.round().astype(int)).tolist())
        self.histogram = np.zeros((3, 256), dtype=np.int64)
        """Counts (3, 256) of the 8-bit values of each channel."""

    def wants(self, number: int) -> bool:
        """True if a picture is one of those to be added."""
        return number in self._chosen

    def add(self, image: np.ndarray) -> None:
        """One of the wanted pictures, uint8 (H, W, 3)."""
        longest = max(image.shape[:2])
        every = longest // _SAMPLED_SIDE if longest >= _LARGE_SIDE else 1
        for channel in range(3):
            self.histogram[channel] += np.bincount(image[::every, ::every, channel].reshape(-1), minlength=256)


def image_statistics(histograms: Sequence[np.ndarray], num_frames: int) -> dict[str, np.ndarray]:
    """Per-channel statistics in 0..1, each of shape (3, 1, 1), exact for the sampled pixels."""
    counts = np.sum(np.stack(histograms), axis=0).astype(np.float64)
    levels = np.arange(256) / 255.0
    total = counts.sum(axis=1)
    mean = counts @ levels / total
    spread = np.maximum(counts @ levels**2 / total - mean**2, 0.0)
    cumulative = np.cumsum(counts, axis=1) / total[:, None]
    channels: dict[str, np.ndarray] = {
        "min": np.array([levels[np.flatnonzero(row)[0]] for row in counts]),
        "max": np.array([levels[np.flatnonzero(row)[-1]] for row in counts]),
        "mean": mean,
        "std": np.sqrt(spread),
    }
    for name, level in QUANTILES.items():
        channels[name] = np.array([levels[np.searchsorted(row, level)] for row in cumulative])
    shaped: dict[str, np.ndarray] = {name: value[:, None, None] for name, value in channels.items()}
    return shaped | {"count": np.array([num_frames], dtype=np.int64)}
