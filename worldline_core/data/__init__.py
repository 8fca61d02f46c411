"""Recordings: episodes, the sets they form, and the formats they come in."""

from worldline_core.data.episode import VIEWS, CameraTrack, Episode
from worldline_core.data.episode_set import EpisodeRow, EpisodeSet, EpisodeSetWriter, QuarantineRow

__all__ = ["VIEWS", "CameraTrack", "Episode", "EpisodeRow", "EpisodeSet", "EpisodeSetWriter", "QuarantineRow"]
