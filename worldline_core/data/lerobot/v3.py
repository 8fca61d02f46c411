"""LeRobotDataset v3.0 on disk: a reader, and a writer whose bytes depend on the input alone.

Layout (LeRobot 0.6): meta/info.json, meta/stats.json, meta/tasks.parquet, meta/episodes/chunk-*/file-*.parquet,
data/chunk-*/file-*.parquet (one row group an episode), videos/<key>/chunk-*/file-*.mp4 (episodes joined; each
episode's place is given by from_timestamp and to_timestamp in the episodes table).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from worldline_core.data.guards.plain_files import read_table
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import fill_template, find_files, inside, note_file
from worldline_core.data.lerobot.metadata import DescribedDataset, EpisodeTable, read_info, whole_number
from worldline_core.data.video.clip import VideoClip
from worldline_core.data.video.decode import decode_segment, video_size
from worldline_core.errors import DataError
from worldline_core.store.atomic import atomic_path

VERSION = "v3.0"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
BOOKKEEPING = ("timestamp", "frame_index", "episode_index", "index", "task_index")
IMAGE_PREFIX = "observation.images."


@dataclass(frozen=True)
class VideoPlace:
    """Where one episode's frames lie: a file and the time [s] of its first frame."""

    path: Path
    from_time: float


class LeRobotV3Dataset(DescribedDataset):
    """Read access to one dataset folder.

    Raises: DataError on opening when the folder is not a LeRobotDataset v3.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.info = read_info(root, VERSION)
        self._data: dict[Path, pa.Table] = {}

    @cached_property
    def episodes(self) -> EpisodeTable:
        """The rows of meta/episodes without the statistics."""
        folder = self.root / "meta" / "episodes"
        files = find_files(folder, "*/*.parquet")
        if not files:
            raise DataError("Dataset lists no episodes", where=str(folder), expected="chunk-*/file-*.parquet")
        return EpisodeTable.from_parquet(files, folder)

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
        try:
            texts = [str(text) for text in whole[label].to_pylist()]
        except UnicodeDecodeError as error:  # Parquet declares UTF-8 and checks nothing
            raise DataError(
                "meta/tasks.parquet holds text that is no UTF-8", where=str(self.root), got=str(error)
            ) from error
        return dict(zip(table["task_index"].to_pylist(), texts, strict=True))

    def row(self, episode_index: int) -> dict[str, Any]:
        """Metadata row of one episode.

        Raises: DataError when the episode is not listed.
        """
        return self.episodes.row(episode_index)

    def column(self, episode_index: int, name: str) -> np.ndarray:
        """One data column of an episode: (N,) or (N, D).

        Raises: DataError when the column or some rows are missing.
        """
        row, where = self.row(episode_index), f"{self.root}, episode {episode_index}"
        relative = fill_template(
            str(self.info.get("data_path", DATA_PATH)),
            chunk_index=whole_number(row, "data/chunk_index", where),
            file_index=whole_number(row, "data/file_index", where),
        )
        path = inside(self.root, relative)
        if path not in self._data:
            self._data = {path: read_table(path)}  # one file at a time: episodes are read in the order of files
        note_file(path)
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
        begin = whole_number(row, "dataset_from_index", where)
        length = whole_number(row, "dataset_to_index", where) - begin
        first = table["index"][0].as_py() if len(table) else begin
        offset = begin - int(first) if isinstance(first, int) else -1
        inside_file = offset >= 0 and length >= 0
        values = table[name].slice(offset, length).combine_chunks() if inside_file else table[name].slice(0, 0)
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
        where = f"{self.root}, episode {episode_index}"
        chunk, file = (whole_number(row, name, where) for name in names[:2])
        start = row[names[2]]
        if not isinstance(start, int | float) or not 0 <= start < math.inf:
            raise RejectedInputError(
                "unreadable",
                "Video has no usable place",
                where=f"{where}, {names[2]}",
                expected="seconds",
                got=repr(start),
            )
        template = str(self.info.get("video_path", VIDEO_PATH))
        path = inside(self.root, fill_template(template, video_key=key, chunk_index=chunk, file_index=file))
        return VideoPlace(path, float(start))

    def clip(self, episode_index: int, key: str) -> VideoClip:
        """One episode's video as it is encoded, inside of a file that holds several."""
        place = self.video(episode_index, key)
        return VideoClip(place.path, int(self.row(episode_index)["length"]), self.fps, from_time=place.from_time)

    def video_rate(self, episode_index: int, key: str) -> float:
        """Frames per second that the container states."""
        return video_size(self.video(episode_index, key).path)[2]

    def image_size(self, episode_index: int, key: str) -> tuple[int, int]:
        """(height, width) that the container states."""
        return video_size(self.video(episode_index, key).path)[:2]

    def frames(self, episode_index: int, key: str, indices: Sequence[int] | None = None) -> np.ndarray:
        """uint8 (len, H, W, 3) frames of one episode.

        Raises: DataError when the video is missing, truncated or too short.
        """
        place = self.video(episode_index, key)
        length = whole_number(self.row(episode_index), "length", f"{self.root}, episode {episode_index}")
        return decode_segment(place.path, place.from_time, length, self.fps, indices)


def column_to_numpy(values: pa.Array, where: str) -> np.ndarray:
    """(N,) or, for lists of equal length, (N, D).

    Raises: DataError for empty rows, rows of different length, or values that are no numbers.
    """
    nested = (pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list)
    if not any(is_kind(values.type) for is_kind in nested):
        return _numbers(values, where)
    if values.null_count:
        raise RejectedInputError(
            "nan_state",
            "Data column holds empty rows",
            where=where,
            expected="a value in each row",
            got=f"{values.null_count} nulls",
        )
    lengths = pc.min_max(pc.list_value_length(values)).as_py()  # pyright: ignore[reportAttributeAccessIssue]
    if len(values) == 0 or lengths["min"] != lengths["max"]:
        raise RejectedInputError(
            "length_mismatch",
            "Rows of a data column differ in length",
            where=where,
            expected="rows of one length",
            got=f"{lengths['min']} to {lengths['max']} values",
        )
    return _numbers(values.flatten(), where).reshape(len(values), -1)


def _numbers(values: pa.Array, where: str) -> np.ndarray:
    numeric = (pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean)
    if not any(is_kind(values.type) for is_kind in numeric):
        raise RejectedInputError(
            "unreadable", "Data column is not numeric", where=where, expected="numbers", got=str(values.type)
        )
    return values.to_numpy(zero_copy_only=False)


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
