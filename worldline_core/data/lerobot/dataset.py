"""LeRobot datasets on disk, read without trusting what their metadata say.

v3.0 (LeRobot 0.6): meta/info.json, meta/stats.json, meta/tasks.parquet, meta/episodes/chunk-*/file-*.parquet,
data/chunk-*/file-*.parquet (one row group per episode), videos/<key>/chunk-*/file-*.mp4 (episodes joined; each
episode's place is given by from_timestamp and to_timestamp in the episodes table).
v2.1: meta/info.json, meta/tasks.jsonl, meta/episodes.jsonl, and per episode one Parquet file and one mp4 per view; v2.0
differs in its statistics alone, which are not read here.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from worldline_core.config import FrameRate
from worldline_core.data.guards.plain_files import (
    decode_image,
    image_size,
    read_json,
    read_json_lines,
    read_table,
    validated,
)
from worldline_core.data.guards.rejection import RejectedInputError, check_columns, check_length, check_rate
from worldline_core.data.guards.source_paths import (
    AnyPath,
    fill_template,
    find_files,
    inside,
    is_file,
    regular_file,
    relative_name,
)
from worldline_core.data.video.clip import VideoClip, video_size
from worldline_core.errors import DataError

VERSION = "v3.0"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
IMAGE_PREFIX = "observation.images."
_DEPTH = "is_depth_map"


def _without_fraction(value: object) -> object:
    """30 for 30.0, which pandas and JavaScript make of whole numbers; anything else as it is."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


class DatasetInfo(BaseModel):
    """`meta/info.json`: the keys that are read here; there may be others."""

    model_config = ConfigDict(frozen=True, strict=True)

    codebase_version: str
    fps: FrameRate
    features: dict[str, dict[str, Any]]
    data_path: str | None = None
    video_path: str | None = None
    chunks_size: Annotated[int, BeforeValidator(_without_fraction)] = Field(default=1000, ge=1)
    robot_type: Any = None
    repo_id: Any = None
    storage_format: Any = None


_NEXT_STEPS = {
    "v3.0": "set kind: lerobot_v3",
    "v2.1": "set kind: lerobot_v21",
    "v2.0": "set kind: lerobot_v21",
}


def read_info(root: AnyPath, versions: Sequence[str] = (), keys: Sequence[str] = ()) -> DatasetInfo:
    """Content of `info.json`, of a wanted version (any, where none is given) and with these keys.

    Raises: DataError when it is unreadable, of another version, lacks a key, or holds something senseless.
    """
    where = f"{root}, meta/info.json"
    info = validated(DatasetInfo, read_json(root / "meta" / "info.json"), where, "meta/info.json")
    if versions and info.codebase_version not in versions:
        raise DataError(
            "Dataset has another version",
            where=str(root),
            expected=" or ".join(versions),
            got=info.codebase_version,
            next_step=_NEXT_STEPS.get(
                info.codebase_version, "convert it with LeRobot's own converters to v2.1 or v3.0"
            ),
        )
    if info.storage_format not in (None, "parquet"):
        raise DataError(
            "Dataset is stored in another format",
            where=where,
            expected="storage_format: parquet",
            got=info.storage_format,
            next_step="export it as a LeRobotDataset of Parquet files with the tool that wrote it",
        )
    missing = sorted(set(keys) - info.model_fields_set)
    if missing:
        raise DataError("meta/info.json lacks a key", where=where, expected=", ".join(missing))
    return info


def check_files(root: AnyPath, cameras: Sequence[str]) -> None:
    """Raises: DataError naming all files that a dataset of version 3 needs and that are not there, those of videos too."""
    features = read_info(root, [VERSION]).features if is_file(root / "meta" / "info.json") else None
    missing = ["meta/info.json"] if features is None else []
    missing += [] if is_file(root / "meta" / "tasks.parquet") else ["meta/tasks.parquet"]
    missing += [f"{name}/*/*.parquet" for name in ("meta/episodes", "data") if not find_files(root / name, "*.parquet")]
    if missing:
        for key in cameras:
            if (features or {}).get(key, {}).get("dtype") != "image" and not find_files(root / "videos" / key, "*.mp4"):
                missing.append(f"videos/{key}/*/*.mp4")
        raise DataError(
            "Files of the dataset are missing",
            where=", ".join(f"{root}/{name}" for name in missing),
            next_step="copy or download the dataset again, as a whole",
        )


INDEX = "episode_index"
MAX_INDEX = 10**12


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
        if column is not None and (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)):
            numbers = column.to_numpy()
        whole = numbers == np.floor(numbers)  # pandas writes whole numbers as 30.0 where one of a column is missing
        if column is None or len(numbers) != len(column) or not (whole & (numbers >= 0) & (numbers <= MAX_INDEX)).all():
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

    def column(self, name: str) -> pa.ChunkedArray:
        """One column, in the order of `indices`."""
        return self._table[name]

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
    value = _without_fraction(row.get(key))
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= MAX_INDEX:
        raise RejectedInputError(
            "unreadable" if key in row else "missing_column",
            "Episode list holds no usable number",
            where=f"{where}, {key}",
            expected="a whole number from 0 on",
            got=repr(value),
        )
    return value


def is_depth(feature: Mapping[str, Any]) -> bool:
    """True if a camera's feature says that it holds depth, in any place where LeRobot's versions say it."""
    notes = (feature, feature.get("info"), feature.get("video_info"))
    said = (note.get(key) for note in notes if isinstance(note, Mapping) for key in note if str(key).endswith(_DEPTH))
    return any(said)


class LeRobotDataset(ABC):
    """Read access to one dataset folder.

    Attributes:
        info: content of `info.json`, checked by `read_info`.

    Raises: DataError on opening when the folder is not a LeRobotDataset of this version.
    """

    versions: tuple[str, ...]
    needed_keys: tuple[str, ...] = ()

    def __init__(self, root: AnyPath) -> None:
        self.root = root
        self.info = read_info(root, self.versions, self.needed_keys)
        self.fps = self.info.fps
        self.features = self.info.features

    @property
    def camera_keys(self) -> list[str]:
        """Features that are pictures, in videos or in the data files."""
        return [key for key, feature in self.features.items() if feature.get("dtype") in ("video", "image")]

    def has_video(self, key: str) -> bool:
        """False for a camera whose pictures are in the data files."""
        return self.features.get(key, {}).get("dtype") != "image"

    @cached_property
    @abstractmethod
    def episodes(self) -> EpisodeTable:
        """The list of episodes, without statistics."""

    @cached_property
    @abstractmethod
    def tasks(self) -> dict[int, str]:
        """Instruction by task_index."""

    def column(self, episode_index: int, name: str) -> np.ndarray:
        """One data column of an episode: (N,) or (N, D).

        Raises: DataError when the file or column is missing, or another length than listed.
        """
        where, values = self.values(episode_index, name)
        return numeric_column(values, len(values), where)

    @abstractmethod
    def values(self, episode_index: int, name: str) -> tuple[str, pa.ChunkedArray]:
        """One data column of an episode as it is stored, and what to call it.

        Raises: DataError as `column`.
        """

    def image(self, episode_index: int, key: str, frame: int) -> bytes:
        """One PNG or JPEG of a camera whose pictures are in the data files, as `datasets.Image` stores them.

        Raises: RejectedInputError: missing_view where the files have no such column; missing_file, unreadable.
        """
        try:
            where, column = self.values(episode_index, key)
        except RejectedInputError as error:
            if error.reason != "missing_column":
                raise
            raise RejectedInputError(
                "missing_view", "Episode has no such images", where=self.root, expected=key
            ) from error
        value = column[frame].as_py()
        content, path = (value.get("bytes"), value.get("path")) if isinstance(value, dict) else (value, None)
        if content is None and isinstance(path, str):
            return regular_file(inside(self.root, path), "Image").read_bytes()
        if not isinstance(content, bytes):
            raise RejectedInputError(
                "unreadable",
                "Frame holds no image",
                where=f"{where}, frame {frame}",
                expected="bytes of a PNG or JPEG, or the path of one",
                got=column.type,
            )
        return content

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

    def image_size(self, episode_index: int, key: str) -> tuple[int, int]:
        """(height, width) that the video, or the first image, states."""
        if self.has_video(key):
            return video_size(self.clip(episode_index, key).path)[:2]
        return image_size(self.image(episode_index, key, 0), f"{self.root}, episode {episode_index}, {key}, frame 0")

    def images(self, episode_index: int, key: str) -> Iterator[np.ndarray]:
        """uint8 (H, W, 3) RGB of each frame of a camera whose pictures are in the data files."""
        for frame in range(self._number(self.row(episode_index), "length")):
            where = f"{self.root}, episode {episode_index}, {key}, frame {frame}"
            yield decode_image(self.image(episode_index, key, frame), where)

    def _number(self, row: dict[str, Any], key: str) -> int:
        return whole_number(row, key, f"{self.root}, episode {row[INDEX]}")

    def _path(self, template: str, **values: int | str) -> AnyPath:
        return inside(self.root, fill_template(template, **values))


class LeRobotV3Dataset(LeRobotDataset):
    """LeRobotDataset v3.0."""

    versions = (VERSION,)

    def __init__(self, root: AnyPath) -> None:
        super().__init__(root)
        self._data: dict[AnyPath, tuple[pa.Table, np.ndarray]] = {}
        self._episode: tuple[int, str, pa.Table] | None = None
        self._all_windows: dict[str, list[np.ndarray]] = {}

    @cached_property
    def episodes(self) -> EpisodeTable:
        folder = self.root / "meta" / "episodes"
        files = find_files(folder, "*/*.parquet")
        if not files:
            raise DataError("Dataset lists no episodes", where=str(folder), expected="chunk-*/file-*.parquet")
        tables = [read_table(file, lambda names: [n for n in names if not n.startswith("stats/")]) for file in files]
        try:
            return EpisodeTable(pa.concat_tables(tables, promote_options="default"), folder)
        except pa.ArrowException as error:
            raise DataError("Files of the episode list differ", where=str(folder), got=str(error)) from error

    @cached_property
    def tasks(self) -> dict[int, str]:
        path = self.root / "meta" / "tasks.parquet"
        table = read_table(path, lambda names: ["task_index", "task" if "task" in names else "__index_level_0__"])
        try:
            texts = ["" if text is None else str(text) for text in table.drop_columns("task_index")[0].to_pylist()]
        except UnicodeDecodeError as error:  # Parquet declares UTF-8 and checks nothing
            raise DataError("Task list holds text that is no UTF-8", where=str(path), got=str(error)) from error
        return dict(zip(table["task_index"].to_pylist(), texts, strict=True))

    def values(self, episode_index: int, name: str) -> tuple[str, pa.ChunkedArray]:
        where, rows = self._rows(episode_index)
        if name not in rows.column_names:
            raise RejectedInputError("missing_column", "Data file lacks a column", where=where, expected=name)
        return f"{where}, column {name}", rows[name]

    def _rows(self, episode_index: int) -> tuple[str, pa.Table]:
        """An episode's rows in the order of `index`, found by `episode_index`, and what to call them.

        Raises: RejectedInputError (length_mismatch, unreadable) where they contradict the episode list.
        """
        if self._episode is not None and self._episode[0] == episode_index:
            return self._episode[1:]
        row = self.row(episode_index)
        begin, length = self._number(row, "dataset_from_index"), self._number(row, "length")
        path, places = self._places(row)
        table = self._data[path][0]
        where = f"{path}, episode {episode_index}"
        check_length("Data file", where, states=length, unit="rows", found=len(places))
        if self._number(row, "dataset_to_index") - begin != length:
            raise _contradiction(
                where, f"{length} rows from dataset_from_index to dataset_to_index", row["dataset_to_index"] - begin
            )
        order = np.argsort(table["index"].take(pa.array(places)).to_numpy(), kind="stable")
        places = places[order]
        consecutive = length > 0 and int(places[-1] - places[0]) == length - 1 and bool((np.diff(places) == 1).all())
        rows = table.slice(int(places[0]), length) if consecutive else table.take(pa.array(places))
        _check_numbering(rows, where, index=begin, frame_index=0)
        if "timestamp" in rows.column_names:  # LeRobot shows the picture at from_timestamp + timestamp
            first = float(numeric_column(rows["timestamp"], length, f"{where}, column timestamp").reshape(-1)[0])
            if abs(first) * self.fps >= 0.5:
                raise _contradiction(where, "timestamp 0 in its first row, where its video begins", f"{first:.6g} s")
        self._episode = episode_index, where, rows
        return where, rows

    def _places(self, row: dict[str, Any]) -> tuple[AnyPath, np.ndarray]:
        """The data file with an episode's rows, and where they are in it.

        As in LeRobot, which reads all files, the file that the list names need not be the one: a stale
        `data/file_index` is common after sets were joined or cut.
        """
        episode_index = row[INDEX]
        path = self._path(
            self.info.data_path or DATA_PATH,
            chunk_index=self._number(row, "data/chunk_index"),
            file_index=self._number(row, "data/file_index"),
        )
        missing: RejectedInputError | None = None
        places = np.zeros(0, np.int64)
        try:
            places = self._load(path, episode_index)
        except RejectedInputError as error:
            if error.reason != "missing_file":
                raise
            missing = error
        if len(places):
            return path, places
        if episode_index in self._file_of:
            path = self._file_of[episode_index]
            return path, self._load(path, episode_index)
        if missing is not None:
            raise missing
        return path, places

    def _load(self, path: AnyPath, episode_index: int) -> np.ndarray:
        """Places of an episode's rows in a data file, which stays in memory: episodes are read in the order of files."""
        if path not in self._data:
            table = read_table(path, lambda names: list(dict.fromkeys((INDEX, "index", *names))))
            numbers = numeric_column(table[INDEX], len(table), f"{path}, column {INDEX}")
            self._data = {path: (table, numbers)}
        return np.flatnonzero(self._data[path][1] == episode_index)

    @cached_property
    def _file_of(self) -> dict[int, AnyPath]:
        """The first data file that holds rows of an episode, of all files."""
        found: dict[int, AnyPath] = {}
        for listed in find_files(self.root / "data", "*/*.parquet"):
            path = inside(self.root, str(relative_name(listed, self.root)))
            for column in read_table(path, lambda names: [INDEX] if INDEX in names else []).columns:
                for number in pc.unique(column).to_pylist():  # pyright: ignore[reportAttributeAccessIssue]
                    found.setdefault(number, path)
        return found

    def clip(self, episode_index: int, key: str) -> VideoClip:
        row = self.row(episode_index)
        if any(row.get(f"videos/{key}/{name}") is None for name in ("chunk_index", "file_index", "from_timestamp")):
            raise RejectedInputError("missing_view", "Episode has no such video", where=self.root, expected=key)
        file = tuple(self._number(row, f"videos/{key}/{name}") for name in ("chunk_index", "file_index"))
        path = self._path(self.info.video_path or VIDEO_PATH, video_key=key, chunk_index=file[0], file_index=file[1])
        where = f"{self.root}, episode {episode_index}, videos/{key}"
        begin, length = row[f"videos/{key}/from_timestamp"], self._number(row, "length")
        end = row.get(f"videos/{key}/to_timestamp")  # LeRobot itself reads pictures without it
        for name, time in (("from_timestamp", begin), ("to_timestamp", begin if end is None else end)):
            if not isinstance(time, int | float) or not 0 <= time < math.inf:
                raise RejectedInputError(
                    "unreadable", f"Video has no usable {name}", where=f"{where}/{name}", got=repr(time)
                )
        if end is not None:
            self._check_window(path, where, key, episode_index, begin, end, length)
        return VideoClip(path, length, self.fps, from_time=float(begin))

    def _check_window(
        self, path: AnyPath, where: str, key: str, episode_index: int, begin: float, end: float, length: int
    ) -> None:
        """Raises: RejectedInputError (length_mismatch) for a window of another length than the rows, or that shares
        pictures with another episode's: one of the two then shows the other; (wrong_fps) where the video's own rate tells
        that the stated one is the mistake.
        """
        frames = (end - begin) * self.fps
        if abs(frames - length) >= 0.5:
            check_rate(video_size(path)[2], self.fps, where)
            raise RejectedInputError(
                "length_mismatch",
                "Video window and rows differ in length",
                where=where,
                expected=f"{length} rows: to_timestamp {begin + length / self.fps:.6g} s at {self.fps:g} fps",
                got=f"{frames:.3g} frames: {begin:.6g} .. {end:.6g} s",
                next_step="correct the window or the rate in the metadata, or drop the episode",
                evidence={"states": length, "frames": round(frames)},
            )
        others, starts, stops = self._windows(key, episode_index)
        shared = (np.minimum(stops, end) - np.maximum(starts, begin)) * self.fps
        same = (np.abs(starts - begin) * self.fps < 0.5) & (np.abs(stops - end) * self.fps < 0.5)
        for place in np.flatnonzero((shared >= 0.5) & ~same)[:1]:
            raise RejectedInputError(
                "length_mismatch",
                "Video windows of two episodes overlap",
                where=where,
                expected="pictures of one episode",
                got=f"{begin:.6g} .. {end:.6g} s, and episode {others[place]}: "
                f"{starts[place]:.6g} .. {stops[place]:.6g} s",
                next_step="correct from_timestamp and to_timestamp in the metadata, or drop both episodes",
            )

    def _windows(self, key: str, episode_index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Index, begin and end [s] of the other episodes in the same video file."""
        if key not in self._all_windows:
            names = [f"videos/{key}/{name}" for name in ("chunk_index", "file_index", "from_timestamp", "to_timestamp")]
            names.append("length")
            self._all_windows[key] = [
                pc.cast(self.episodes.column(name), pa.float64(), safe=False).to_numpy(zero_copy_only=False)
                for name in names
            ]
        chunks, files, starts, stops, lengths = self._all_windows[key]
        own = self.episodes.indices == episode_index
        near = (chunks == chunks[own][0]) & (files == files[own][0]) & ~own
        near &= np.abs((stops - starts) * self.fps - lengths) < 0.5  # others are refused themselves
        return self.episodes.indices[near], starts[near], stops[near]


def _number_of(row: object, name: str) -> float | None:
    """A row's number; None for anything else, which whoever needs the number then refuses."""
    value = row.get(name) if isinstance(row, dict) else None
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) <= MAX_INDEX:
        return None
    return float(value)


class _Task(BaseModel):
    task_index: int
    task: Any


class LeRobotV21Dataset(LeRobotDataset):
    """LeRobotDataset v2.1 or v2.0."""

    versions = ("v2.1", "v2.0")
    needed_keys = ("data_path", "video_path", "chunks_size")
    _checked: int | None = None

    @cached_property
    def episodes(self) -> EpisodeTable:
        path = self.root / "meta" / "episodes.jsonl"
        rows = list(read_json_lines(path))
        table = pa.table(
            {name: pa.array([_number_of(row, name) for row in rows], pa.float64()) for name in (INDEX, "length")}
        )
        return EpisodeTable(table, path)

    @cached_property
    def tasks(self) -> dict[int, str]:
        path = self.root / "meta" / "tasks.jsonl"
        tasks: dict[int, str] = {}
        for row in read_json_lines(path):
            task = validated(_Task, row, path, "Row of the task list")
            tasks[task.task_index] = "" if task.task is None else str(task.task)
        return tasks

    def _episode_path(self, template: str | None, episode_index: int, **values: str) -> AnyPath:
        chunk = episode_index // self.info.chunks_size
        return self._path(template or "", episode_chunk=chunk, episode_index=episode_index, **values)

    def values(self, episode_index: int, name: str) -> tuple[str, pa.ChunkedArray]:
        path = self._episode_path(self.info.data_path, episode_index)
        length = self._number(self.row(episode_index), "length")
        if self._checked != episode_index:
            numbering = read_table(path, lambda names: [name for name in (INDEX, "frame_index") if name in names])
            check_length("Data file", path, states=length, unit="rows", found=len(numbering))
            if INDEX in numbering.column_names and (numbering[INDEX].to_numpy() != episode_index).any():
                others = pc.unique(numbering[INDEX]).to_pylist()  # pyright: ignore[reportAttributeAccessIssue]
                raise _contradiction(path, f"{INDEX} {episode_index}", f"{INDEX} {', '.join(map(str, others[:5]))}")
            _check_numbering(numbering, path, frame_index=0)
            self._checked = episode_index
        values = read_table(path, [name])[name]
        check_length("Data file", path, states=length, unit="rows", found=len(values))
        return f"{path}, column {name}", values

    def clip(self, episode_index: int, key: str) -> VideoClip:
        path = self._episode_path(self.info.video_path, episode_index, video_key=key)
        return VideoClip.whole_file(path, self._number(self.row(episode_index), "length"), self.fps)


def _contradiction(where: object, expected: str, got: object) -> RejectedInputError:
    return RejectedInputError(
        "length_mismatch",
        "Rows and episode list contradict each other",
        where=where,
        expected=expected,
        got=got,
        next_step="write the dataset again with LeRobot's own tools, or drop the episode",
    )


def _check_numbering(rows: pa.Table, where: object, **first: int) -> None:
    """Raises: RejectedInputError (length_mismatch) unless these columns, as far as they are there, count up from here."""
    for name, begin in first.items():
        if name not in rows.column_names:
            continue
        numbers = numeric_column(rows[name], len(rows), f"{where}, column {name}").reshape(-1)
        wrong = np.flatnonzero(numbers != begin + np.arange(len(rows)))
        if len(wrong):
            raise _contradiction(
                where, f"{name} {begin + wrong[0]} in its row {wrong[0]}", f"{name} {numbers[wrong[0]]}"
            )


def numeric_column(column: pa.ChunkedArray, length: int, where: str) -> np.ndarray:
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
    check_columns(widths["max"], where)
    return _numeric(values.flatten(), where).reshape(len(values), -1)


def _numeric(values: pa.Array, where: str) -> np.ndarray:
    if not any(is_kind(values.type) for is_kind in (pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean)):
        raise RejectedInputError("unreadable", "Data column is not numeric", where=where, got=values.type)
    return values.to_numpy(zero_copy_only=False)
