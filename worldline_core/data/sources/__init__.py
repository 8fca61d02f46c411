"""Readers of recordings: each turns its own format, units and conventions into `Episode`."""

from worldline_core.data.episodes.source import EpisodeSource, LoadedEpisode

__all__ = ["EpisodeSource", "LoadedEpisode"]
