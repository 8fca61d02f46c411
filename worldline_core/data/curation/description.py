"""What the configuration says of a recorded episode: its split, its instruction, its primary view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from worldline_core.data.curation.checks import check_split
from worldline_core.data.curation.config import CurateConfig
from worldline_core.data.curation.instructions import with_instruction
from worldline_core.data.curation.primary_view import with_primary_view
from worldline_core.data.curation.scene_splits import with_split
from worldline_core.data.episodes.episode import Episode

if TYPE_CHECKING:
    from worldline_core.data.video.thumbnails import ViewThumbnails


def described(
    config: CurateConfig, episode: Episode, views: Sequence[str], thumbnails: Mapping[str, ViewThumbnails]
) -> Episode:
    """The episode as the set describes it. Its outcome is left alone, and nothing here depends on it.

    Args:
        views: views that the set keeps. thumbnails: of these.

    Raises: ConfigError when a recording for evaluation only is given a training split.
    """
    primary = with_primary_view(episode, config.primary_view, views, thumbnails)
    result = with_split(with_instruction(primary, config.instructions), config.splits)
    check_split(result)
    return result
