"""MCAP recordings of other tools (ROS 2, Foxglove), brought to a fixed rate.

Topics are declared (`McapTopicsSourceConfig`), nothing is guessed. Every instant gets the nearest image of each view,
joints and poses between their neighbours, transforms by slerp; how far off in time that is, what was out of order, lost
or timed by another clock is written into the episode's conventions. See docs/mcap.md.
"""

from __future__ import annotations

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside, is_file, relative_name
from worldline_core.data.mcap.topics.config import Markers, McapTopicsSourceConfig
from worldline_core.data.mcap.topics.episode import read_episode
from worldline_core.data.mcap.topics.episodes import Segment, segments
from worldline_core.data.mcap.topics.file import McapFile
from worldline_core.data.sources.base import LoadedEpisode


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
