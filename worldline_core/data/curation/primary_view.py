"""Which view stands for an episode in single-view training (Stage I), and why.

In this order: the configured view, the one that the source declares, the head's, the one that shows most motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from worldline_core.data.episodes.episode import Episode

if TYPE_CHECKING:
    from worldline_core.data.video.thumbnails import ViewThumbnails

PRIMARY_VIEW_REASON = "primary_view_reason"
Why = Literal["configured", "head", "most_motion"]


def with_primary_view(
    episode: Episode, configured: str | None, views: Sequence[str], thumbnails: Mapping[str, ViewThumbnails]
) -> Episode:
    """The episode with its primary view, and in its conventions why, unless the source's own declaration holds.

    A configured view that the episode lacks is its choice all the same: it then stays out of Stage I, as the configuration
    asks. Of views with equal motion the last by name is taken.
    """
    if configured is not None:
        return _chosen(episode, configured, "configured")
    if episode.primary_view in views:
        return episode
    if "head" in views:
        return _chosen(episode, "head", "head")
    return _chosen(episode, max(views, key=lambda view: (motion(thumbnails[view]), view)), "most_motion")


def motion(view: ViewThumbnails) -> float:
    """Mean absolute change between the moments of a view, in grey levels of 255, over at most 64 moments."""
    step = max(1, len(view.gray) // 64)
    moments = view.gray[::step].astype(np.int16)
    return float(np.abs(np.diff(moments, axis=0)).mean()) if len(moments) > 1 else 0.0


def _chosen(episode: Episode, view: str, why: Why) -> Episode:
    return replace(episode, primary_view=view, conventions={**episode.conventions, PRIMARY_VIEW_REASON: why})
