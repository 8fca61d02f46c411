"""A source read in a process with limits before it is read here.

Apart from what looks at the episodes afterwards: the reader process imports this module, and starts in half the time without torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

from worldline_core.data.episodes.source import EpisodeSource, LoadedEpisode
from worldline_core.data.guards.reader_process import ReaderLimits, read_limited
from worldline_core.data.sources.open import SourceConfig, open_source


class GuardedSource:
    """A source of which this process reads what a reader process has read to its end."""

    def __init__(self, config: SourceConfig, limits: ReaderLimits) -> None:
        self.config, self.limits = config, limits
        self._read_through: set[str] = set()

    @cached_property
    def _source(self) -> EpisodeSource:
        return open_source(self.config, self.config.path)

    def episode_ids(self) -> Sequence[str]:
        """Raises: DataError, UnavailableError."""
        return read_limited(self.limits, _episode_ids, self.config)

    def load(self, episode_id: str) -> LoadedEpisode:
        """Raises: RejectedInputError, DataError."""
        if episode_id not in self._read_through:
            read_limited(self.limits, _read_through, self.config, episode_id)
            self._read_through.add(episode_id)
        return self._source.load(episode_id)


_opened: dict[str, EpisodeSource] = {}
"""The source that a reader process read last, by its configuration."""


def _open(config: SourceConfig) -> EpisodeSource:
    key = config.model_dump_json()
    if key not in _opened:
        _opened.clear()
        _opened[key] = open_source(config, config.path)
    return _opened[key]


def _episode_ids(config: SourceConfig) -> list[str]:
    return list(_open(config).episode_ids())


def _read_through(config: SourceConfig, episode_id: str) -> None:
    loaded = _open(config).load(episode_id)
    for view in loaded.views:
        for _ in loaded.each_image(view):
            pass
