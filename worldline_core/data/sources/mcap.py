"""MCAP files written by `worldline_core.data.mcap.io`, one episode a file."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside, is_file, relative_name
from worldline_core.data.mcap.reader import read_episode_id, read_episode_mcap
from worldline_core.data.sources.base import LoadedEpisode, SourceConfigBase
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
