"""A folder of plain videos, with or without captions: one view, no states and no actions, for Stage I alone.

    <any folders>/<name>.mp4
    <any folders>/<name>.txt        the video's caption (the default), or one table for all videos: JSON, JSONL or CSV

The rate is the container's, and frames must keep to it: a video with a variable rate is quarantined (wrong_fps). Videos
of one folder share a scene: they may be cuts of one recording, and a split by video would test on what was trained on.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping
from pathlib import PurePosixPath
from typing import Any, Literal

import numpy as np
from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.source import ForeignSourceConfig, LoadedEpisode
from worldline_core.data.guards.plain_files import read_json, read_json_lines, read_text
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside, is_file, relative_name
from worldline_core.data.sources.ids import file_ids, printable
from worldline_core.data.video.clip import VideoClip, frame_times, video_size
from worldline_core.errors import ConfigError, DataError

MAX_CAPTION_BYTES = 1 << 16
TABLE_SUFFIXES = (".json", ".jsonl", ".csv")


def caption_of(path: AnyPath) -> str | None:
    """The text of a file that holds one caption, or None where there is no such file.

    Raises: RejectedInputError: unreadable (no UTF-8 text), too_large.
    """
    return (
        " ".join(read_text(path, max_bytes=MAX_CAPTION_BYTES, encoding="utf-8-sig").split()) if is_file(path) else None
    )


def caption_table(path: AnyPath, video_key: str, caption_key: str) -> dict[str, str]:
    """Captions by the video's path in the folder, from a table.

    JSON: an object {video: caption}, or a list of objects with the two keys; JSONL: one such object a line; CSV: a header
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
    for video, caption in _rows(path, suffix, video_key, caption_key):
        name, said = video.removeprefix("./"), " ".join(caption.split())
        if table.setdefault(name, said) != said:
            raise DataError("Table has two captions for one video", where=str(path), got=name)
    return table


def _rows(path: AnyPath, suffix: str, video_key: str, caption_key: str) -> Iterable[tuple[str, str]]:
    if suffix == ".csv":
        try:
            listed: Any = list(
                csv.DictReader(io.StringIO(read_text(path, encoding="utf-8-sig"), newline=""), strict=True)
            )
        except csv.Error as error:
            raise DataError("Table of captions is no CSV", where=str(path), got=str(error)) from error
    elif suffix == ".jsonl":
        listed = list(read_json_lines(path))
    else:
        listed = read_json(path)
        if isinstance(listed, dict):
            listed = [{video_key: video, caption_key: caption} for video, caption in listed.items()]
    if not isinstance(listed, list):
        raise DataError(
            "Table of captions has a wrong shape", where=str(path), expected="rows", got=type(listed).__name__
        )
    return [
        (_field(row, video_key, number, path), _field(row, caption_key, number, path))
        for number, row in enumerate(listed, start=1)
    ]


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
    require_caption: bool = Field(default=False, description="quarantine videos without a caption")


class VideoFolderSource:
    """Lists every video below the root; ids are the label and the path.

    Raises: DataError or ConfigError when a table of captions is configured and cannot be used.
    """

    def __init__(self, config: VideoFolderSourceConfig, root: AnyPath) -> None:
        self._config = config
        self._root = root
        suffixes = {suffix.lower() for suffix in config.suffixes}
        found = [str(relative_name(p, root)) for p in find_files(root, "*") if p.suffix.lower() in suffixes]
        self._files = file_ids(config.label, {file: PurePosixPath(file).with_suffix("").parts for file in found})
        table = config.captions
        self._captions = None if table is None else caption_table(inside(root, table.file), table.video, table.caption)

    def episode_ids(self) -> list[str]:
        return sorted(self._files)

    def load(self, episode_id: str) -> LoadedEpisode:
        config = self._config
        relative = self._files[episode_id]
        path = inside(self._root, relative)
        rate = video_size(path)[2]
        times = frame_times(path)
        if not rate > 0:
            raise RejectedInputError("wrong_fps", "Video states no frame rate", where=str(path), got=rate)
        folder = PurePosixPath(relative).parent.parts
        nothing = np.zeros((len(times), 0), dtype=np.float32)
        episode = Episode(
            **config.declared("-".join([config.label, *folder])),
            episode_id=episode_id,
            embodiment=config.embodiment,
            instruction=self._caption(relative, path),
            outcome=config.outcome,
            fps=rate,
            state=nothing,
            action=nothing,
            timestamps=times,
            primary_view=config.view,
            state_kind="none",
            conventions={"layout": "video_folder", "file": printable(relative)},
        )
        return LoadedEpisode(episode, (config.view,), clips={config.view: VideoClip.whole_file(path, len(times), rate)})

    def _caption(self, relative: str, path: AnyPath) -> str:
        if self._captions is None:
            caption = caption_of(inside(self._root, str(PurePosixPath(relative).with_suffix(".txt"))))
        else:
            caption = self._captions.get(relative)
        if not caption and self._config.require_caption:
            raise RejectedInputError(
                "missing_column",
                "Video has no caption",
                where=str(path),
                expected="a text file of the video's name" if self._captions is None else "a row in the table",
                got="none" if caption is None else "an empty one",
                evidence={"missing": "caption"},
            )
        return caption or ""
