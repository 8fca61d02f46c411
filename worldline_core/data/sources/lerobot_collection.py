"""Every LeRobot dataset below a folder: RoboCOIN and Galaxea publish one a task, hundreds of them."""

from __future__ import annotations

from functools import lru_cache

from worldline_core.data.guards.source_paths import AnyPath, find_files, relative_name
from worldline_core.data.sources.base import LoadedEpisode
from worldline_core.data.sources.lerobot import LeRobotSource
from worldline_core.data.sources.lerobot_config import LeRobotSourceConfig
from worldline_core.errors import DataError

_OPEN_DATASETS = 8


class LeRobotCollection:
    """Datasets of one layout; each has its own scene unless the configuration names one.

    A dataset that cannot be opened stands in the list as one input, and is quarantined with what is wrong with it; what
    the configuration itself gets wrong of any of them stops the listing.

    Raises: DataError when there is no dataset at all; ConfigError as `LeRobotSource`.
    """

    def __init__(self, config: LeRobotSourceConfig, root: AnyPath) -> None:
        self._config = config
        self._roots: dict[str, AnyPath] = {}
        for info in find_files(root, "info.json"):
            place = relative_name(info, root)
            if place.parent.name == "meta":
                self._roots["-".join([config.label, *place.parts[:-2]])] = info.parent.parent
        if not self._roots:
            raise DataError(
                "Folder holds no LeRobot dataset",
                where=str(root),
                expected="folders with meta/info.json",
                next_step="unpack the archives; leave `collection` out for a single dataset of another layout",
            )
        self._open = lru_cache(maxsize=_OPEN_DATASETS)(self._opened)

    def _opened(self, label: str) -> LeRobotSource:
        return LeRobotSource(self._config, self._roots[label], label)

    def episode_ids(self) -> list[str]:
        listed: list[str] = []
        for label in sorted(self._roots):
            try:
                listed += self._open(label).episode_ids()
            except DataError:
                listed.append(label)
        return listed

    def load(self, episode_id: str) -> LoadedEpisode:
        if episode_id in self._roots:
            self._open(episode_id).episode_ids()  # raises what the listing met
        return self._open(episode_id.rsplit("-", 1)[0]).load(episode_id)
