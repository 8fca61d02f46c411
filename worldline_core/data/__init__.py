"""Recordings: episodes, the sets they form, and the formats they come in."""

from worldline_core.data.episodes.episode import VIEWS, CameraTrack, Episode
from worldline_core.data.episodes.episode_set import EpisodeRow, EpisodeSet, EpisodeSetWriter, QuarantineRow

__all__ = ["VIEWS", "CameraTrack", "Episode", "EpisodeRow", "EpisodeSet", "EpisodeSetWriter", "QuarantineRow"]
