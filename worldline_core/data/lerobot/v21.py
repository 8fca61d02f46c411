"""LeRobotDataset v2.1 on disk: one Parquet and one mp4 a view for each episode."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from worldline_core.data.guards.plain_files import read_json_lines, read_table
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import fill_template, inside
from worldline_core.data.lerobot.metadata import DescribedDataset, EpisodeTable, read_info, whole_number
from worldline_core.data.lerobot.v3 import column_to_numpy
from worldline_core.data.video.clip import VideoClip
from worldline_core.data.video.decode import decode_video, video_size
from worldline_core.errors import DataError

VERSION = "v2.1"


class LeRobotV21Dataset(DescribedDataset):
    """Read access to one dataset folder; the same methods as `LeRobotV3Dataset`.

    Raises: DataError on opening when the folder is not a LeRobotDataset v2.1.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.info = read_info(root, VERSION, ("data_path", "video_path", "chunks_size"))

    @cached_property
    def episodes(self) -> EpisodeTable:
        """The rows of meta/episodes.jsonl."""
        return EpisodeTable.from_json_lines(self.root / "meta" / "episodes.jsonl")

    @cached_property
    def tasks(self) -> dict[int, str]:
        """Instruction by task_index."""
        path = self.root / "meta" / "tasks.jsonl"
        tasks: dict[int, str] = {}
        for row in read_json_lines(path):
            if not isinstance(row, dict) or not isinstance(row.get("task_index"), int) or "task" not in row:
                raise DataError(
                    "Row of the task list is not understood",
                    where=str(path),
                    expected='{"task_index": 0, "task": "..."}',
                    got=str(row)[:200],
                )
            tasks[row["task_index"]] = str(row["task"])
        return tasks

    def row(self, episode_index: int) -> dict[str, Any]:
        """Metadata row of one episode.

        Raises: DataError when the episode is not listed, or listed twice.
        """
        return self.episodes.row(episode_index)

    def _length(self, episode_index: int) -> int:
        return whole_number(self.row(episode_index), "length", f"{self.root}, episode {episode_index}")

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
        length = self._length(episode_index)
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
        path = self.video_path(episode_index, key)
        frames = decode_video(path, self._length(episode_index))
        return frames if indices is None else frames[np.asarray(indices, dtype=np.int64)]

    def video_path(self, episode_index: int, key: str) -> Path:
        """File of one episode's video."""
        return self._path(str(self.info["video_path"]), episode_index, video_key=key)

    def clip(self, episode_index: int, key: str) -> VideoClip:
        """One episode's video as it is encoded."""
        return VideoClip.whole_file(self.video_path(episode_index, key), self._length(episode_index), self.fps)

    def video_rate(self, episode_index: int, key: str) -> float:
        """Frames per second that the container states."""
        return video_size(self.video_path(episode_index, key))[2]

    def image_size(self, episode_index: int, key: str) -> tuple[int, int]:
        """(height, width) that the container states."""
        return video_size(self.video_path(episode_index, key))[:2]
