"""LeRobotDataset v3.0 on disk: a reader, and a writer whose bytes depend on the input alone.

Layout (LeRobot 0.6): meta/info.json, meta/stats.json, meta/tasks.parquet, meta/episodes/chunk-*/file-*.parquet,
data/chunk-*/file-*.parquet (one row group an episode), videos/<key>/chunk-*/file-*.mp4 (episodes joined; each
episode's place is given by from_timestamp and to_timestamp in the episodes table).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from worldline_core.data.rejection import RejectedInputError
from worldline_core.data.source_paths import fill_template, inside
from worldline_core.data.video import decode_segment, video_size
from worldline_core.errors import DataError
from worldline_core.store.atomic import atomic_path

VERSION = "v3.0"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
BOOKKEEPING = ("timestamp", "frame_index", "episode_index", "index", "task_index")
IMAGE_PREFIX = "observation.images."


def read_json(path: Path) -> Any:
    """JSON of a file.

    Raises: DataError when it is missing or not JSON.
    """
    try:
        return json.loads(path.read_text())
    except FileNotFoundError as error:
        raise RejectedInputError("missing_file", "File is missing", where=str(path)) from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise RejectedInputError("unreadable", "File is not valid JSON", where=str(path), got=str(error)) from error


def read_table(path: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """A Parquet file as a table.

    Raises: DataError when it is missing, damaged, or lacks a wanted column (the message names both).
    """
    if not path.is_file():
        raise RejectedInputError("missing_file", "File is missing", where=str(path))
    try:
        file = pq.ParquetFile(path)
        names = file.schema_arrow.names
        missing = [column for column in columns or () if column not in names]
        if missing:
            raise RejectedInputError(
                "missing_column",
                "Parquet file lacks a column",
                where=str(path),
                expected=", ".join(missing),
                got="columns " + ", ".join(names),
            )
        return file.read(columns=None if columns is None else list(columns))
    except (pa.ArrowInvalid, OSError) as error:
        raise RejectedInputError(
            "unreadable", "Parquet file cannot be read", where=str(path), got=str(error)
        ) from error


@dataclass(frozen=True)
class VideoPlace:
    """Where one episode's frames lie: a file and the time [s] of its first frame."""

    path: Path
    from_time: float


class LeRobotV3Dataset:
    """Read access to one dataset folder.

    Raises: DataError on opening when the folder is not a LeRobotDataset v3.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.info: dict[str, Any] = read_json(root / "meta" / "info.json")
        version = str(self.info.get("codebase_version"))
        if version != VERSION:
            raise DataError("Dataset has another version", where=str(root), expected=VERSION, got=version)
        for key in ("fps", "features"):
            if key not in self.info:
                raise DataError("meta/info.json lacks a key", where=str(root), expected=key, got=", ".join(self.info))
        self._data: dict[Path, pa.Table] = {}

    @property
    def fps(self) -> float:
        return float(self.info["fps"])

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        return self.info["features"]

    @property
    def video_keys(self) -> list[str]:
        return [key for key, feature in self.features.items() if feature.get("dtype") == "video"]

    @cached_property
    def episodes(self) -> list[dict[str, Any]]:
        """Rows of meta/episodes without the statistics, by episode_index."""
        folder = self.root / "meta" / "episodes"
        files = sorted(folder.glob("*/*.parquet"))
        if not files:
            raise DataError("Dataset lists no episodes", where=str(folder), expected="chunk-*/file-*.parquet")
        rows: list[dict[str, Any]] = []
        for file in files:
            table = read_table(file)
            wanted = [name for name in table.column_names if not name.startswith("stats/")]
            rows += table.select(wanted).to_pylist()
        return sorted(rows, key=lambda row: row["episode_index"])

    @cached_property
    def tasks(self) -> dict[int, str]:
        """Instruction by task_index."""
        table = read_table(self.root / "meta" / "tasks.parquet", ["task_index"])
        whole = read_table(self.root / "meta" / "tasks.parquet")
        label = "task" if "task" in whole.column_names else "__index_level_0__"
        if label not in whole.column_names:
            raise DataError(
                "meta/tasks.parquet lacks the task text",
                where=str(self.root),
                expected="task",
                got=", ".join(whole.column_names),
            )
        return dict(zip(table["task_index"].to_pylist(), whole[label].to_pylist(), strict=True))

    def row(self, episode_index: int) -> dict[str, Any]:
        """Metadata row of one episode.

        Raises: DataError when the episode is not listed.
        """
        if not 0 <= episode_index < len(self.episodes):
            raise DataError(
                "No such episode",
                where=str(self.root),
                expected=f"0..{len(self.episodes) - 1}",
                got=str(episode_index),
            )
        return self.episodes[episode_index]

    def column(self, episode_index: int, name: str) -> np.ndarray:
        """One data column of an episode: (N,) or (N, D).

        Raises: DataError when the column or some rows are missing.
        """
        row = self.row(episode_index)
        relative = fill_template(
            str(self.info.get("data_path", DATA_PATH)),
            chunk_index=row["data/chunk_index"],
            file_index=row["data/file_index"],
        )
        path = inside(self.root, relative)
        if path not in self._data:
            self._data[path] = read_table(path)
        table = self._data[path]
        for needed in (name, "index"):
            if needed not in table.column_names:
                raise RejectedInputError(
                    "missing_column",
                    "Data file lacks a column",
                    where=str(path),
                    expected=needed,
                    got=", ".join(table.column_names),
                )
        offset = row["dataset_from_index"] - int(table["index"][0].as_py()) if len(table) else 0
        length = row["dataset_to_index"] - row["dataset_from_index"]
        values = table[name].slice(offset, length).combine_chunks() if offset >= 0 else table[name].slice(0, 0)
        if len(values) != length:
            raise RejectedInputError(
                "length_mismatch",
                "Data file is too short",
                where=f"{path}, episode {episode_index}",
                expected=f"{length} rows",
                got=len(values),
            )
        if isinstance(values, pa.ChunkedArray):
            values = pa.concat_arrays(values.chunks)
        return column_to_numpy(values, f"{path}, column {name}, episode {episode_index}")

    def video(self, episode_index: int, key: str) -> VideoPlace:
        """Where an episode's frames of one video key lie.

        Raises: DataError when the metadata lacks the key.
        """
        row = self.row(episode_index)
        names = [f"videos/{key}/{name}" for name in ("chunk_index", "file_index", "from_timestamp")]
        if any(row.get(name) is None for name in names):
            raise RejectedInputError(
                "missing_view",
                "Episode has no such video",
                where=str(self.root),
                expected=key,
                got=", ".join(self.video_keys),
            )
        chunk, file, start = (row[name] for name in names)
        template = str(self.info.get("video_path", VIDEO_PATH))
        path = inside(self.root, fill_template(template, video_key=key, chunk_index=chunk, file_index=file))
        return VideoPlace(path, float(start))

    def video_rate(self, episode_index: int, key: str) -> float:
        """Frames per second that the container states."""
        return video_size(self.video(episode_index, key).path)[2]

    def frames(self, episode_index: int, key: str, indices: Sequence[int] | None = None) -> np.ndarray:
        """uint8 (len, H, W, 3) frames of one episode.

        Raises: DataError when the video is missing, truncated or too short.
        """
        place = self.video(episode_index, key)
        length = self.row(episode_index)["length"]
        return decode_segment(place.path, place.from_time, length, self.fps, indices)


def column_to_numpy(values: pa.Array, where: str) -> np.ndarray:
    """(N,) or, for lists of equal length, (N, D).

    Raises: DataError for empty rows or rows of different length.
    """
    if not (
        pa.types.is_list(values.type) or pa.types.is_large_list(values.type) or pa.types.is_fixed_size_list(values.type)
    ):
        return values.to_numpy(zero_copy_only=False)
    if values.null_count:
        raise RejectedInputError(
            "nan_state",
            "Data column holds empty rows",
            where=where,
            expected="a value in each row",
            got=f"{values.null_count} nulls",
        )
    flat = values.flatten().to_numpy(zero_copy_only=False)
    if len(values) == 0 or len(flat) % len(values):
        raise RejectedInputError(
            "length_mismatch",
            "Rows of a data column differ in length",
            where=where,
            got=f"{len(flat)} values in {len(values)} rows",
        )
    return flat.reshape(len(values), -1)


def write_table(path: Path, table: pa.Table, *, rows_per_group: Sequence[int] | None = None) -> None:
    """Write a Parquet file atomically; rows_per_group cuts it into row groups of these sizes."""
    with (
        atomic_path(path) as temporary,
        pq.ParquetWriter(temporary, table.schema, compression="snappy") as writer,
    ):
        start = 0
        for size in rows_per_group or [len(table)]:
            writer.write_table(table.slice(start, size), row_group_size=max(size, 1))
            start += size
