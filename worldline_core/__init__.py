"""WorldLine: from robot recordings to an action-driven visual simulator.

``WorldLine.from_pretrained(folder).predict(images, controls, cameras)`` predicts videos, ``EpisodeSet.open(folder)`` reads recordings.
Importing the package imports no torch.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from worldline_core.data.episodes.episode_set import EpisodeSet
    from worldline_core.rollout.worldline import Camera, WorldLine

__all__ = ["Camera", "EpisodeSet", "WorldLine"]


def __getattr__(name: str) -> object:
    if name == "EpisodeSet":
        from worldline_core.data.episodes.episode_set import EpisodeSet

        return EpisodeSet
    if name in __all__:
        from worldline_core.rollout import worldline

        return getattr(worldline, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
