"""MCAP files: those written by this project, one episode per file, and recordings of other tools (ROS 2, Foxglove).

Of the latter, topics are declared (`McapTopicsSourceConfig`), nothing is guessed, and the recording is brought to a fixed
rate: every instant gets the nearest image of each view, joints and poses between their neighbours, transforms by slerp.
How far off in time that is, what was out of order, lost or timed by another clock is written into the episode's
conventions. See docs/mcap.md.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from worldline_core.data.episodes.source import LoadedEpisode, SourceConfigBase
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside, is_file, relative_name
from worldline_core.data.mcap.episode import read_episode
from worldline_core.data.mcap.episodes import Segment, segments
from worldline_core.data.mcap.file import McapFile
from worldline_core.data.mcap.reader import read_episode_id, read_episode_mcap
from worldline_core.data.mcap.topics_config import Markers, McapTopicsSourceConfig
from worldline_core.errors import DataError


class McapSourceConfig(SourceConfigBase):
    """Every *.mcap below the folder, or one file."""

    kind: Literal["mcap"] = "mcap"


class McapSource:
    """Reads a folder of MCAP files; a damaged file is known by its name."""

    def __init__(self, config: McapSourceConfig, root: AnyPath) -> None:
        self._name = config.name
        self._root = root
        self._files: dict[str, AnyPath] = {}
        for path in [root] if is_file(root) else find_files(root, "*.mcap"):
            try:
                if path != root:
                    inside(root, str(relative_name(path, root)))
                identity = read_episode_id(path)
            except DataError:
                identity = str(relative_name(path, root)) if path != root else path.name  # `load` says what is wrong
            if identity in self._files:
                identity = f"{identity}@{path.name}"
            self._files[identity] = path

    def episode_ids(self) -> list[str]:
        return list(self._files)

    def load(self, episode_id: str) -> LoadedEpisode:
        path = self._files[episode_id]
        if path != self._root:
            inside(self._root, str(relative_name(path, self._root)))
        read = read_episode_mcap(path)
        if read.episode.episode_id != episode_id:
            raise RejectedInputError(
                "duplicate_id",
                "Two files hold an episode of this id",
                where=self._files[episode_id],
                got=read.episode.episode_id,
            )
        episode = read.episode if self._name is None else replace(read.episode, source=self._name)
        return LoadedEpisode(
            episode, tuple(read.frames), read.frames.__getitem__, read.robot_masks.get, read.distortions
        )


class McapTopicsSource:
    """Reads every *.mcap below a folder, or one file; ids are label-path[-episode].

    A file whose markers cannot be read is listed as one episode, which then says why.
    """

    def __init__(self, config: McapTopicsSourceConfig, root: AnyPath) -> None:
        self._config = config
        self._episodes: dict[str, tuple[AnyPath, str, Segment]] = {}
        alone = is_file(root)
        for path in [root] if alone else find_files(root, "*.mcap"):
            name = path.name if alone else str(relative_name(path, root))
            stem = f"{config.label}-{name.removesuffix('.mcap')}"
            try:
                checked = path if alone else inside(root, name)
                file = McapFile(checked) if isinstance(config.episodes, Markers) else None
                found = list(segments(config.episodes, file, name))
            except RejectedInputError as error:
                found = [Segment(fault=error)]
            for segment in found:
                self._episodes[f"{stem}-{segment.name}" if segment.name else stem] = path, stem, segment

    def episode_ids(self) -> list[str]:
        return list(self._episodes)

    def load(self, episode_id: str) -> LoadedEpisode:
        path, stem, segment = self._episodes[episode_id]
        if segment.fault is not None:
            raise segment.fault
        return read_episode(self._config, McapFile(path), segment, episode_id, self._config.scene or stem)
