"""A folder of plain videos, with or without captions: one view, no states and no actions, for Stage I alone.

    <any folders>/<name>.mp4
    <any folders>/<name>.txt        the video's caption (the default), or one table for all videos: JSON, JSONL or CSV

The rate is the container's, and frames must keep to it: a video with a variable rate is quarantined (wrong_fps). Videos
of one folder share a scene: they may be cuts of one recording, and a split by video would test on what was trained on.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any, Literal

import numpy as np
from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.data.episodes.source import ForeignSourceConfig, LoadedEpisode
from worldline_core.data.guards.plain_files import read_json, read_json_lines, read_text
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside, is_file
from worldline_core.data.sources.episode_files import EpisodeFiles, printable
from worldline_core.data.video.clip import VideoClip, frame_times, video_size
from worldline_core.errors import ConfigError, DataError

TABLE_SUFFIXES = (".json", ".jsonl", ".csv")


def caption_table(path: AnyPath, video_key: str, caption_key: str) -> dict[str, str]:
    """Captions by the video's path in the folder, from a table.

    JSON: an object {video: caption}, or a list of objects with the two keys; JSONL: one such object per line; CSV: a header
    with the two names.

    Raises: DataError when the file is missing, damaged or says two things of one video; ConfigError for another suffix
        or a key that is not there.
    """
    suffix = path.suffix.lower()
    if suffix not in TABLE_SUFFIXES:
        raise ConfigError(
            "Captions are in a file of unknown kind", where=str(path), expected=" | ".join(TABLE_SUFFIXES), got=suffix
        )
    if not is_file(path):
        raise DataError(
            "Table of captions is missing", where=str(path), next_step="check the file's name in the source"
        )
    table: dict[str, str] = {}
    for number, row in enumerate(_rows(path, suffix, video_key, caption_key), start=1):
        video, caption = (_field(row, key, number, path) for key in (video_key, caption_key))
        name, text = video.removeprefix("./"), " ".join(caption.split())
        if table.setdefault(name, text) != text:
            raise DataError("Table has two captions for one video", where=str(path), got=name)
    return table


def _rows(path: AnyPath, suffix: str, video_key: str, caption_key: str) -> list[Any]:
    if suffix == ".csv":
        text = io.StringIO(read_text(path, encoding="utf-8-sig"), newline="")
        try:
            return list(csv.DictReader(text, strict=True))
        except csv.Error as error:
            raise DataError("Table of captions is no CSV", where=str(path), got=str(error)) from error
    if suffix == ".jsonl":
        return list(read_json_lines(path))
    listed = read_json(path)
    if isinstance(listed, dict):
        return [{video_key: video, caption_key: caption} for video, caption in listed.items()]
    if not isinstance(listed, list):
        raise DataError(
            "Table of captions has a wrong shape", where=str(path), expected="rows", got=type(listed).__name__
        )
    return listed


def _field(row: Any, key: str, number: int, path: AnyPath) -> str:
    value = row.get(key) if isinstance(row, Mapping) else None
    if not isinstance(value, str):
        raise ConfigError(
            "Row of the table of captions lacks a text",
            where=f"{path}, row {number}",
            expected=f"a text named {key}",
            got=", ".join(map(str, row)) if isinstance(row, Mapping) else type(row).__name__,
            next_step="give the source the names that the table has, or the right table",
        )
    return value


class CaptionTable(StrictModel):
    """A file that holds the captions of all videos."""

    file: str = Field(description="path in the folder: .json, .jsonl or .csv")
    video: str = Field(default="video", description="column or key of the video's path in the folder")
    caption: str = Field(default="caption", description="column or key of its caption")


class VideoFolderSourceConfig(ForeignSourceConfig):
    """Videos below a folder. They say nothing of their robot, so `embodiment` is a mere name here."""

    kind: Literal["video_folder"] = "video_folder"
    embodiment: str = "unspecified"
    view: str = Field(default="head", description="slot that the picture takes: the task-facing one")
    suffixes: tuple[str, ...] = Field(default=(".mp4",), min_length=1)
    captions: CaptionTable | None = Field(
        default=None, description="null: the text file beside each video, where there is one"
    )


class VideoFolderSource(EpisodeFiles[VideoFolderSourceConfig]):
    """Lists every video below the root; ids are the label and the path.

    Raises: DataError or ConfigError when a table of captions is configured and cannot be used.
    """

    def __init__(self, config: VideoFolderSourceConfig, root: AnyPath) -> None:
        self.looked_for = "files that end in " + ", ".join(config.suffixes)
        suffixes = {suffix.lower() for suffix in config.suffixes}
        super().__init__(config, root, [path for path in find_files(root, "*") if path.suffix.lower() in suffixes])
        table = config.captions
        self._captions = None if table is None else caption_table(inside(root, table.file), table.video, table.caption)

    def load(self, episode_id: str) -> LoadedEpisode:
        config, relative, path = self.config, self.files[episode_id], self.path(episode_id)
        rate = video_size(path)[2]
        times = frame_times(path)
        if not rate > 0:
            raise RejectedInputError("wrong_fps", "Video states no frame rate", where=str(path), got=rate)
        nothing = np.zeros((len(times), 0))
        episode = self.episode(
            episode_id,
            "-".join([config.label, *relative.parent.parts]),
            layout="video_folder",
            state=nothing,
            action=nothing,
            instruction=self._caption(relative),
            fps=rate,
            timestamps=times,
            primary_view=config.view,
            state_kind="none",
            conventions={"file": printable(str(relative))},
        )
        return LoadedEpisode(episode, (config.view,), clips={config.view: VideoClip.whole_file(path, len(times), rate)})

    def _caption(self, relative: PurePosixPath) -> str:
        if self._captions is not None:
            return self._captions.get(str(relative), "")
        text = inside(self.root, str(relative.with_suffix(".txt")))
        return " ".join(read_text(text, encoding="utf-8-sig").split()) if is_file(text) else ""
