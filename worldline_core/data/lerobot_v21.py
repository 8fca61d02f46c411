"""LeRobotDataset v2.1 on disk: one Parquet and one mp4 a view for each episode."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from worldline_core.data.lerobot_v3 import column_to_numpy, read_json, read_table
from worldline_core.data.rejection import RejectedInputError
from worldline_core.data.source_paths import fill_template, inside
from worldline_core.data.video import decode_video, video_size
from worldline_core.errors import DataError

VERSION = "v2.1"


class LeRobotV21Dataset:
    """Read access to one dataset folder; the same methods as `LeRobotV3Dataset`.

    Raises: DataError on opening when the folder is not a LeRobotDataset v2.1.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.info: dict[str, Any] = read_json(root / "meta" / "info.json")
        version = str(self.info.get("codebase_version"))
        if version != VERSION:
            raise DataError("Dataset has another version", where=str(root), expected=VERSION, got=version)
        missing = [key for key in ("fps", "features", "data_path", "video_path", "chunks_size") if key not in self.info]
        if missing:
            raise DataError(
                "meta/info.json lacks a key", where=str(root), expected=", ".join(missing), got=", ".join(self.info)
            )

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
        """Rows of meta/episodes.jsonl by episode_index."""
        return sorted(_json_lines(self.root / "meta" / "episodes.jsonl"), key=lambda row: row["episode_index"])

    @cached_property
    def tasks(self) -> dict[int, str]:
        """Instruction by task_index."""
        return {row["task_index"]: row["task"] for row in _json_lines(self.root / "meta" / "tasks.jsonl")}

    def row(self, episode_index: int) -> dict[str, Any]:
        """Metadata row of one episode.

        Raises: DataError when the episode is not listed.
        """
        for row in self.episodes:
            if row["episode_index"] == episode_index:
                return row
        raise DataError(
            "No such episode", where=str(self.root), expected="an index in meta/episodes.jsonl", got=episode_index
        )

    def _path(self, template: str, episode_index: int, **values: str) -> Path:
        chunk = episode_index // int(self.info["chunks_size"])
        relative = fill_template(template, episode_chunk=chunk, episode_index=episode_index, **values)
        return inside(self.root, relative)

    def column(self, episode_index: int, name: str) -> np.ndarray:
        """One data column of an episode: (N,) or (N, D).

        Raises: DataError when the file or column is missing, or another length than listed.
        """
        path = self._path(str(self.info["data_path"]), episode_index)
        values = read_table(path, [name])[name].combine_chunks()
        if isinstance(values, pa.ChunkedArray):
            values = pa.concat_arrays(values.chunks)
        length = int(self.row(episode_index)["length"])
        if len(values) != length:
            raise RejectedInputError(
                "length_mismatch",
                "Data file has another length than listed",
                where=path,
                expected=f"{length} rows",
                got=f"{len(values)} rows",
                evidence={"listed": length, "rows": len(values)},
            )
        return column_to_numpy(values, f"{path}, column {name}")

    def frames(self, episode_index: int, key: str, indices: Sequence[int] | None = None) -> np.ndarray:
        """uint8 (len, H, W, 3) frames of one episode.

        Raises: DataError when the video is missing, truncated or of another length than listed.
        """
        path = self._path(str(self.info["video_path"]), episode_index, video_key=key)
        frames = decode_video(path, int(self.row(episode_index)["length"]))
        return frames if indices is None else frames[np.asarray(indices, dtype=np.int64)]

    def video_rate(self, episode_index: int, key: str) -> float:
        """Frames per second that the container states."""
        return video_size(self._path(str(self.info["video_path"]), episode_index, video_key=key))[2]


def _json_lines(path: Path) -> list[dict[str, Any]]:
    if not path.is_file():
        raise RejectedInputError("missing_file", "File is missing", where=path)
    try:
        return [json.loads(line) for line in path.read_text().splitlines() if line.strip()]
    except json.JSONDecodeError as error:
        raise DataError("File is not JSON lines", where=path, got=str(error)) from error
