"""LeRobot datasets on disk, read without trusting what their metadata say.

v3.0 (LeRobot 0.6): meta/info.json, meta/stats.json, meta/tasks.parquet, meta/episodes/chunk-*/file-*.parquet,
data/chunk-*/file-*.parquet (one row group per episode), videos/<key>/chunk-*/file-*.mp4 (episodes joined; each
episode's place is given by from_timestamp and to_timestamp in the episodes table).
v2.1: meta/info.json, meta/tasks.jsonl, meta/episodes.jsonl, and per episode one Parquet file and one mp4 per view.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.json
from pydantic import BaseModel, ConfigDict, Field

from worldline_core.data.guards.plain_files import column_names, read_json, read_json_lines, read_table, validated
from worldline_core.data.guards.rejection import RejectedInputError, check_length, unreadable
from worldline_core.data.guards.source_paths import AnyPath, fill_template, find_files, inside, regular_file
from worldline_core.data.video.clip import VideoClip, decode_frames, video_size
from worldline_core.errors import DataError

VERSION = "v3.0"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
IMAGE_PREFIX = "observation.images."


class DatasetInfo(BaseModel):
    """`meta/info.json`: the keys that are read here; there may be others."""

    model_config = ConfigDict(frozen=True, strict=True)

    codebase_version: str
    fps: float = Field(gt=0, le=10_000)
    features: dict[str, dict[str, Any]]
    data_path: str | None = None
    video_path: str | None = None
    chunks_size: int = Field(default=1000, ge=1)
    robot_type: Any = None
    repo_id: Any = None


def read_info(root: AnyPath, version: str, keys: Sequence[str] = ()) -> DatasetInfo:
    """What `info.json` says, of the wanted version and with these keys.

    Raises: DataError when it is unreadable, of another version, lacks a key, or holds something senseless.
    """
    where = f"{root}, meta/info.json"
    info = validated(DatasetInfo, read_json(root / "meta" / "info.json"), where, "meta/info.json")
    if info.codebase_version != version:
        raise DataError("Dataset has another version", where=str(root), expected=version, got=info.codebase_version)
    missing = sorted(set(keys) - info.model_fields_set)
    if missing:
        raise DataError("meta/info.json lacks a key", where=where, expected=", ".join(missing))
    return info


INDEX = "episode_index"
MAX_INDEX = 10**12
_BLOCK_BYTES = 16 << 20


class EpisodeTable:
    """Rows by `episode_index`, made into a dict when asked for.

    Args:
        table: with a column `episode_index`; order and gaps do not matter.
        where: named in messages.

    Raises: DataError when `episode_index` is not a column of whole numbers.
    """

    def __init__(self, table: pa.Table, where: object) -> None:
        self._where = str(where)
        column = table[INDEX] if INDEX in table.column_names else None
        numbers = np.zeros(0)
        if column is not None and pa.types.is_integer(column.type) and not column.null_count:
            numbers = column.to_numpy()
        if column is None or len(numbers) != len(column) or ((numbers < 0) | (numbers > MAX_INDEX)).any():
            raise DataError(
                "Episode list numbers no episodes",
                where=self._where,
                expected=f"{INDEX}: a whole number 0..{MAX_INDEX} in each row",
                got=", ".join(table.column_names) if column is None else column.type,
            )
        order = np.argsort(numbers, kind="stable")
        self.indices: np.ndarray = numbers[order].astype(np.int64)
        in_order = bool((order[1:] > order[:-1]).all())
        # One chunk per column: looking up a row among a hundred chunks takes a millisecond.
        self._table = (table if in_order else table.take(pa.array(order))).combine_chunks()

    def row(self, episode_index: int) -> dict[str, Any]:
        """One episode's row.

        Raises: DataError when it is not listed; RejectedInputError (duplicate_id) when it is listed twice, since then
            neither row can be trusted.
        """
        first, last = (int(np.searchsorted(self.indices, episode_index, side)) for side in ("left", "right"))
        if first == last:
            raise DataError("No such episode", where=self._where, got=episode_index)
        if last - first > 1:
            raise RejectedInputError(
                "duplicate_id", "Episode is listed more than once", where=self._where, got=f"{INDEX} {episode_index}"
            )
        return self._table.slice(first, 1).to_pylist()[0]


def whole_number(row: dict[str, Any], key: str, where: object) -> int:
    """A count or a position out of a row of metadata.

    Raises: RejectedInputError: missing_column, or unreadable for what is no whole number from 0 on.
    """
    value = row.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= MAX_INDEX:
        raise RejectedInputError(
            "unreadable" if key in row else "missing_column",
            "Episode list holds no usable number",
            where=f"{where}, {key}",
            expected="a whole number from 0 on",
            got=repr(value),
        )
    return value


class LeRobotDataset(ABC):
    """Read access to one dataset folder.

    Attributes:
        info: content of `info.json`, checked by `read_info`.

    Raises: DataError on opening when the folder is not a LeRobotDataset of this version.
    """

    version: str
    needed_keys: tuple[str, ...] = ()

    def __init__(self, root: AnyPath) -> None:
        self.root = root
        self.info = read_info(root, self.version, self.needed_keys)
        self.fps = self.info.fps
        self.features = self.info.features

    @property
    def video_keys(self) -> list[str]:
        return [key for key, feature in self.features.items() if feature.get("dtype") == "video"]

    @cached_property
    @abstractmethod
    def episodes(self) -> EpisodeTable:
        """The list of episodes, without statistics."""

    @cached_property
    @abstractmethod
    def tasks(self) -> dict[int, str]:
        """Instruction by task_index."""

    @abstractmethod
    def column(self, episode_index: int, name: str) -> np.ndarray:
        """One data column of an episode: (N,) or (N, D).

        Raises: DataError when the file or column is missing, or another length than listed.
        """

    @abstractmethod
    def clip(self, episode_index: int, key: str) -> VideoClip:
        """One episode's video as it is encoded.

        Raises: DataError when the metadata lack the key.
        """

    def row(self, episode_index: int) -> dict[str, Any]:
        """Metadata row of one episode.

        Raises: DataError when the episode is not listed, or listed twice.
        """
        return self.episodes.row(episode_index)

    def video_size(self, episode_index: int, key: str) -> tuple[int, int, float]:
        """(height, width, frames per second) that the container states."""
        return video_size(self.clip(episode_index, key).path)

    def _number(self, row: dict[str, Any], key: str) -> int:
        return whole_number(row, key, f"{self.root}, episode {row[INDEX]}")

    def _path(self, template: str, **values: int | str) -> AnyPath:
        return inside(self.root, fill_template(template, **values))


class LeRobotV3Dataset(LeRobotDataset):
    """LeRobotDataset v3.0."""

    version = VERSION

    def __init__(self, root: AnyPath) -> None:
        super().__init__(root)
        self._data: dict[AnyPath, pa.Table] = {}

    @cached_property
    def episodes(self) -> EpisodeTable:
        folder = self.root / "meta" / "episodes"
        files = find_files(folder, "*/*.parquet")
        if not files:
            raise DataError("Dataset lists no episodes", where=str(folder), expected="chunk-*/file-*.parquet")
        wanted = [[name for name in column_names(file) if not name.startswith("stats/")] for file in files]
        tables = [read_table(file, names) for file, names in zip(files, wanted, strict=True)]
        try:
            return EpisodeTable(pa.concat_tables(tables, promote_options="default"), folder)
        except pa.ArrowException as error:
            raise DataError("Files of the episode list differ", where=str(folder), got=str(error)) from error

    @cached_property
    def tasks(self) -> dict[int, str]:
        path = self.root / "meta" / "tasks.parquet"
        label = "task" if "task" in column_names(path) else "__index_level_0__"
        table = read_table(path, ["task_index", label])
        try:
            texts = [str(text) for text in table[label].to_pylist()]
        except UnicodeDecodeError as error:  # Parquet declares UTF-8 and checks nothing
            raise DataError("Task list holds text that is no UTF-8", where=str(path), got=str(error)) from error
        return dict(zip(table["task_index"].to_pylist(), texts, strict=True))

    def column(self, episode_index: int, name: str) -> np.ndarray:
        row = self.row(episode_index)
        path = self._path(
            self.info.data_path or DATA_PATH,
            chunk_index=self._number(row, "data/chunk_index"),
            file_index=self._number(row, "data/file_index"),
        )
        if path not in self._data:
            self._data = {path: read_table(path)}  # one file at a time: episodes are read in the order of files
        table = self._data[path]
        for needed in (name, "index"):
            if needed not in table.column_names:
                raise RejectedInputError("missing_column", "Data file lacks a column", where=path, expected=needed)
        begin = self._number(row, "dataset_from_index")
        length = self._number(row, "dataset_to_index") - begin
        first = table["index"][0].as_py() if len(table) else begin
        offset = begin - int(first) if isinstance(first, int) else -1
        rows = table[name].slice(offset, length) if offset >= 0 and length >= 0 else table[name].slice(0, 0)
        return _numeric_column(rows, length, f"{path}, episode {episode_index}, column {name}")

    def clip(self, episode_index: int, key: str) -> VideoClip:
        row = self.row(episode_index)
        chunk, file, start = (f"videos/{key}/{name}" for name in ("chunk_index", "file_index", "from_timestamp"))
        if any(row.get(name) is None for name in (chunk, file, start)):
            raise RejectedInputError("missing_view", "Episode has no such video", where=self.root, expected=key)
        path = self._path(
            self.info.video_path or VIDEO_PATH,
            video_key=key,
            chunk_index=self._number(row, chunk),
            file_index=self._number(row, file),
        )
        from_time = row[start]
        if not isinstance(from_time, int | float) or not 0 <= from_time < math.inf:
            where = f"{self.root}, episode {episode_index}, {start}"
            raise RejectedInputError("unreadable", "Video has no usable start time", where=where, got=repr(from_time))
        return VideoClip(path, self._number(row, "length"), self.fps, from_time=float(from_time))

    def frames(self, episode_index: int, key: str, indices: Sequence[int]) -> np.ndarray:
        """uint8 (len, H, W, 3) frames of one episode.

        Raises: DataError when the video is missing, truncated or too short.
        """
        return decode_frames(self.clip(episode_index, key), indices)


class _Task(BaseModel):
    task_index: int
    task: Any


class LeRobotV21Dataset(LeRobotDataset):
    """LeRobotDataset v2.1."""

    version = "v2.1"
    needed_keys = ("data_path", "video_path", "chunks_size")

    @cached_property
    def episodes(self) -> EpisodeTable:
        path = self.root / "meta" / "episodes.jsonl"
        schema = pa.schema([(INDEX, pa.int64()), ("length", pa.int64())])
        with unreadable("File is not JSON lines", path, (pa.ArrowException, OSError, ValueError)):
            table = pyarrow.json.read_json(
                regular_file(path, "Episode list"),
                read_options=pyarrow.json.ReadOptions(use_threads=False, block_size=_BLOCK_BYTES),
                parse_options=pyarrow.json.ParseOptions(explicit_schema=schema, unexpected_field_behavior="ignore"),
            )
        return EpisodeTable(table, path)

    @cached_property
    def tasks(self) -> dict[int, str]:
        path = self.root / "meta" / "tasks.jsonl"
        tasks: dict[int, str] = {}
        for row in read_json_lines(path):
            task = validated(_Task, row, path, "Row of the task list")
            tasks[task.task_index] = str(task.task)
        return tasks

    def _episode_path(self, template: str | None, episode_index: int, **values: str) -> AnyPath:
        chunk = episode_index // self.info.chunks_size
        return self._path(template or "", episode_chunk=chunk, episode_index=episode_index, **values)

    def column(self, episode_index: int, name: str) -> np.ndarray:
        path = self._episode_path(self.info.data_path, episode_index)
        return _numeric_column(
            read_table(path, [name])[name], self._number(self.row(episode_index), "length"), f"{path}, column {name}"
        )

    def clip(self, episode_index: int, key: str) -> VideoClip:
        path = self._episode_path(self.info.video_path, episode_index, video_key=key)
        return VideoClip.whole_file(path, self._number(self.row(episode_index), "length"), self.fps)


def _numeric_column(column: pa.ChunkedArray, length: int, where: str) -> np.ndarray:
    """(N,) or, for lists of equal length, (N, D).

    Raises: RejectedInputError (length_mismatch, nan_state, unreadable) for another number of rows than listed, empty rows,
        rows of different length, or values that are no numbers.
    """
    check_length("Data file", where, states=length, unit="rows", found=len(column))
    values = column.combine_chunks()
    if isinstance(values, pa.ChunkedArray):
        values = pa.concat_arrays(values.chunks)
    nested = (pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list)
    if not any(is_kind(values.type) for is_kind in nested):
        return _numeric(values, where)
    if values.null_count:
        raise RejectedInputError("nan_state", "Data column holds empty rows", where=where, got=values.null_count)
    widths = pc.min_max(pc.list_value_length(values)).as_py()  # pyright: ignore[reportAttributeAccessIssue]
    if len(values) == 0 or widths["min"] != widths["max"]:
        raise RejectedInputError("length_mismatch", "Rows of a data column differ in length", where=where, got=widths)
    return _numeric(values.flatten(), where).reshape(len(values), -1)


def _numeric(values: pa.Array, where: str) -> np.ndarray:
    if not any(is_kind(values.type) for is_kind in (pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean)):
        raise RejectedInputError("unreadable", "Data column is not numeric", where=where, got=values.type)
    return values.to_numpy(zero_copy_only=False)
