"""Metadata of a LeRobot dataset: `info.json`, checked once so that readers may rely on it, the list of episodes, and the
statistics of features as LeRobot stores them: min, max, mean, std, count and quantiles.

The list is kept as columns: 10^6 episodes are 10^6 rows of Arrow, not of Python objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.json
from pydantic import BaseModel, ConfigDict, Field

from worldline_core.data.guards.plain_files import column_names, read_json, read_table, validated
from worldline_core.data.guards.rejection import MAX_TEXT_BYTES, RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, note_file, regular_file
from worldline_core.errors import DataError


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
    content = read_json(root / "meta" / "info.json")
    info = validated(DatasetInfo, content, where, "meta/info.json")
    if info.codebase_version != version:
        raise DataError("Dataset has another version", where=str(root), expected=version, got=info.codebase_version)
    missing = sorted(set(keys) - info.model_fields_set)
    if missing:
        raise DataError("meta/info.json lacks a key", where=where, expected=", ".join(missing), got=", ".join(content))
    return info


INDEX = "episode_index"
MAX_INDEX = 10**12
_BLOCK_BYTES = 16 << 20


class EpisodeTable:
    """Rows by `episode_index`, made into a dict when asked for.

    Args:
        table: with a column `episode_index`; order and gaps do not matter.
        where: named in messages. files: that the table was read from; every row is noted as read from them.

    Raises: DataError when `episode_index` is not a column of whole numbers.
    """

    def __init__(self, table: pa.Table, where: object, files: Sequence[AnyPath] = ()) -> None:
        self._where = str(where)
        self._files = tuple(files)
        if INDEX not in table.column_names:
            raise DataError(
                "Episode list lacks a column",
                where=self._where,
                expected=INDEX,
                got=", ".join(table.column_names) or "none",
            )
        column = table[INDEX]
        if not pa.types.is_integer(column.type) or column.null_count:
            raise DataError(
                "Episode list has rows without a number",
                where=self._where,
                expected=f"{INDEX}: a whole number in each row",
                got=f"{column.type} with {column.null_count} empty rows",
            )
        numbers = column.to_numpy()
        if len(numbers) and (numbers.min() < 0 or numbers.max() > MAX_INDEX):
            raise DataError(
                "Episode list numbers episodes out of range",
                where=self._where,
                expected=f"0..{MAX_INDEX}",
                got=f"{numbers.min()}..{numbers.max()}",
            )
        order = np.argsort(numbers, kind="stable")
        self.indices: np.ndarray = numbers[order].astype(np.int64)
        in_order = bool((order[1:] > order[:-1]).all())
        # One chunk per column: looking up a row among a hundred chunks takes a millisecond.
        self._table = (table if in_order else table.take(pa.array(order))).combine_chunks()

    @classmethod
    def from_parquet(cls, files: Sequence[AnyPath], where: object) -> EpisodeTable:
        """From LeRobot v3's meta/episodes; the statistics (`stats/*`) are left out.

        Raises: DataError when a file is unreadable or the files differ in their columns.
        """
        tables = []
        for file in files:
            wanted = [name for name in column_names(file) if not name.startswith("stats/")]
            tables.append(read_table(file, wanted))
        try:
            return cls(pa.concat_tables(tables, promote_options="default"), where, files)
        except pa.ArrowException as error:
            raise DataError("Files of the episode list differ", where=str(where), got=str(error)) from error

    @classmethod
    def from_json_lines(cls, path: AnyPath) -> EpisodeTable:
        """From LeRobot v2.1's meta/episodes.jsonl; of each line `episode_index` and `length`.

        Raises: RejectedInputError: missing_file, special_file, too_large, unreadable.
        """
        file = regular_file(path, "Episode list", max_bytes=MAX_TEXT_BYTES)
        schema = pa.schema([(INDEX, pa.int64()), ("length", pa.int64())])
        try:
            table = pyarrow.json.read_json(
                str(file),
                read_options=pyarrow.json.ReadOptions(use_threads=False, block_size=_BLOCK_BYTES),
                parse_options=pyarrow.json.ParseOptions(explicit_schema=schema, unexpected_field_behavior="ignore"),
            )
        except (pa.ArrowException, OSError, ValueError) as error:
            raise RejectedInputError("unreadable", "File is not JSON lines", where=str(path), got=str(error)) from error
        return cls(table, path, [path])

    def __len__(self) -> int:
        return len(self.indices)

    def row(self, episode_index: int) -> dict[str, Any]:
        """One episode's row.

        Raises: DataError when it is not listed; RejectedInputError (duplicate_id) when it is listed twice, since which row
            is meant cannot be told.
        """
        for file in self._files:
            note_file(file)
        first, last = (int(np.searchsorted(self.indices, episode_index, side)) for side in ("left", "right"))
        if first == last:
            raise DataError(
                "No such episode",
                where=self._where,
                expected=f"one of {len(self)} episodes, {self._range()}",
                got=str(episode_index),
            )
        if last - first > 1:
            raise RejectedInputError(
                "duplicate_id",
                "Episode is listed more than once",
                where=self._where,
                expected="one row per episode",
                got=f"{last - first} rows of {INDEX} {episode_index}",
            )
        return self._table.slice(first, 1).to_pylist()[0]

    def _range(self) -> str:
        return f"{self.indices[0]}..{self.indices[-1]}" if len(self) else "none"


def whole_number(row: dict[str, Any], key: str, where: object) -> int:
    """A count or a position out of a row of metadata.

    Raises: RejectedInputError: missing_column, or unreadable for what is no whole number from 0 on.
    """
    if key not in row:
        raise RejectedInputError(
            "missing_column", "Episode list lacks a column", where=str(where), expected=key, got=", ".join(row)
        )
    value = row[key]
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= MAX_INDEX:
        raise RejectedInputError(
            "unreadable",
            "Episode list holds no usable number",
            where=f"{where}, {key}",
            expected="a whole number from 0 on",
            got=repr(value),
        )
    return value


QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_MAX_IMAGES = 32
_LARGE_SIDE = 300
_SAMPLED_SIDE = 150


def vector_statistics(values: np.ndarray) -> dict[str, np.ndarray]:
    """Statistics over axis 0 of (N, D) values; exact, in float64.

    Rows with a value that is not finite are left out (a broken recording can still be stored, and is told apart later).
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
        """Whether a picture is one of those to be added."""
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


def as_json(statistics: dict[str, dict[str, np.ndarray]]) -> dict[str, Any]:
    """Nested lists, for meta/stats.json."""
    return {key: {name: value.tolist() for name, value in feature.items()} for key, feature in statistics.items()}
