"""A folder of plain videos, with or without captions: one view, no states and no actions, for Stage I alone.

    <any folders>/<name>.mp4
    <any folders>/<name>.txt        the video's caption (the default), or one table for all: JSON, JSONL or CSV

The rate is the container's, and frames must keep to it: a video with a variable rate is quarantined (wrong_fps). Videos
of one folder share a scene: they may be cuts of one recording, and a split by video would test on what was trained on.
"""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Literal

import numpy as np
from pydantic import Field

from worldline_core.config.base import StrictModel
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside, relative_name
from worldline_core.data.sources.base import ForeignSourceConfig, LoadedEpisode, no_masks
from worldline_core.data.sources.captions import caption_of, caption_table
from worldline_core.data.sources.episode_names import printable, unique_names
from worldline_core.data.video.clip import VideoClip
from worldline_core.data.video.decode import decode_video, video_size
from worldline_core.data.video.times import frame_times


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
        self._files = unique_names(
            {file: "-".join([config.label, *PurePosixPath(printable(file)).with_suffix("").parts]) for file in found}
        )
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
            episode_id=episode_id,
            source=config.label,
            embodiment=config.embodiment,
            scene=config.scene or "-".join([config.label, *folder]),
            task_family=config.task_family,
            instruction=self._caption(relative, path),
            outcome=config.outcome,
            split=config.split,
            fps=rate,
            state=nothing,
            action=nothing,
            timestamps=times,
            primary_view=config.view,
            state_kind="none",
            conventions={"layout": "video_folder", "file": printable(relative)},
        )
        return LoadedEpisode(
            episode,
            (config.view,),
            lambda view: decode_video(path, len(times)),
            no_masks,
            clips={config.view: VideoClip.whole_file(path, len(times), rate)},
        )

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
