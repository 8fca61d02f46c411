"""A folder of plain videos, with or without captions: one view, no states and no actions, for Stage I alone.

    <any folders>/<name>.mp4
    <any folders>/<name>.txt        the video's caption (the default), or one table for all videos: JSONL or CSV

The rate is the container's, and frames must keep to it: a video with a variable rate is quarantined (wrong_fps). Videos
of one folder share a scene: they may be cuts of one recording, and a split by video would test on what was trained on.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable
from pathlib import PurePosixPath
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.data.episodes.source import EpisodeFiles, ForeignSourceConfig, LoadedEpisode
from worldline_core.data.guards.plain_files import read_text
from worldline_core.data.guards.rejection import RejectedInputError, unreadable
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside, is_file, regular_file
from worldline_core.data.video.clip import VideoClip, frame_times, video_size
from worldline_core.errors import DataError
from worldline_core.untrusted_text import printable


def caption_table(path: AnyPath, video_key: str, caption_key: str) -> dict[str, str]:
    """Captions by the video's path in the folder, from a CSV file with a header, or JSON lines.

    A text that is no valid Unicode is kept as it is: it costs its own episode.

    Raises: RejectedInputError: missing_file, special_file; unreadable for a table that is damaged, lacks a column or a
        text, or has two captions for one video.
    """
    file = regular_file(path, "Table of captions")
    with (
        unreadable("Table of captions cannot be read", path, (csv.Error, ValueError, OSError, RecursionError)),
        file.open(encoding="utf-8-sig", errors="surrogateescape", newline="") as lines,
    ):
        rows: Iterable[Any] = (
            csv.DictReader(lines, strict=True)
            if path.suffix.lower() == ".csv"
            else (json.loads(line) for line in lines if line.strip())
        )
        captions: dict[str, str] = {}
        for number, row in enumerate(rows, 1):
            texts = (row.get(video_key), row.get(caption_key)) if isinstance(row, dict) else (None,)
            if not all(isinstance(text, str) for text in texts):
                raise ValueError(f"row {number} lacks a text {video_key} or {caption_key}: {ascii(row)[:200]}")
            video, caption = row[video_key].removeprefix("./"), " ".join(row[caption_key].split())
            if captions.setdefault(video, caption) != caption:
                raise ValueError(f"two captions for {video}")
    if not captions:
        raise RejectedInputError("unreadable", "Table of captions cannot be read", where=path, got="no row")
    return captions


class CaptionTable(StrictModel):
    """A file that holds the captions of all videos."""

    file: str = Field(description="path in the folder: .jsonl or .csv")
    video: str = Field(default="video", description="column or key of the video's path in the folder")
    caption: str = Field(default="caption", description="column or key of its caption")


class VideoFolderSourceConfig(ForeignSourceConfig):
    """Videos below a folder. They say nothing of their robot, so `embodiment` is a mere name here."""

    kind: Literal["video_folder"] = "video_folder"
    embodiment: str = "unspecified"
    suffixes: tuple[str, ...] = Field(default=(".mp4",), min_length=1)
    captions: CaptionTable | None = Field(
        default=None, description="null: the text file beside each video, where there is one"
    )
    starts: dict[str, Annotated[int, Field(ge=0)]] = Field(
        default_factory=dict, description="first frame that is taken of a video, by its path in the folder; others: 0"
    )
    frames: int | None = Field(default=None, ge=2, description="how many frames are taken of each video; null: all")


class VideoFolderSource(EpisodeFiles[VideoFolderSourceConfig]):
    """Lists every video below the root; ids are the label and the path."""

    def __init__(self, config: VideoFolderSourceConfig, root: AnyPath) -> None:
        self.looked_for = "files that end in " + ", ".join(config.suffixes)
        suffixes = {suffix.lower() for suffix in config.suffixes}
        super().__init__(config, root, [path for path in find_files(root, "*") if path.suffix.lower() in suffixes])
        if absent := sorted(set(config.starts) - set(map(str, self.files.values()))):
            raise DataError(
                "Not a video of the folder", where=f"{root}, starts", got=", ".join(absent[:8]),
                next_step="correct its path in the folder, or leave it out",
            )  # fmt: skip
        table = config.captions
        self._captions = None if table is None else caption_table(inside(root, table.file), table.video, table.caption)

    def load(self, episode_id: str) -> LoadedEpisode:
        config, relative, path = self.config, self.files[episode_id], self.path(episode_id)
        rate = video_size(path)[2]
        times = frame_times(path)
        if not rate > 0:
            raise RejectedInputError("wrong_fps", "Video states no frame rate", where=str(path), got=rate)
        start = config.starts.get(str(relative), 0)
        stop = len(times) if config.frames is None else start + config.frames
        if not start < stop <= len(times):
            raise RejectedInputError(
                "too_short",
                "Video ends before the part that is taken",
                where=str(path),
                expected=f"frames {start} to {max(start, stop - 1)}",
                got=f"{len(times)} frames",
            )
        nothing = np.zeros((stop - start, 0))
        episode = self.episode(
            episode_id,
            "-".join([config.label, *relative.parent.parts]),
            layout="video_folder",
            state=nothing,
            action=nothing,
            instruction=self._caption(relative),
            fps=rate,
            timestamps=times[start:stop] - times[start],
            primary_view="head",
            state_kind="none",
            conventions={"file": printable(str(relative))},
        )
        clip = VideoClip.whole_file(path, len(times), rate).cut(start, stop)
        return LoadedEpisode(episode, ("head",), clips={"head": clip})

    def _caption(self, relative: PurePosixPath) -> str:
        if self._captions is not None:
            return self._captions.get(str(relative), "")
        caption = inside(self.root, str(relative.with_suffix(".txt")))
        return " ".join(read_text(caption, encoding="utf-8-sig").split()) if is_file(caption) else ""
