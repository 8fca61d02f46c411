"""Open a configured source: the kinds there are, and the reader of each."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

from pydantic import Field

from worldline_core.data.episodes.conventions import RecordedConventions
from worldline_core.data.episodes.source import EpisodeSource, LoadedEpisode
from worldline_core.data.guards.source_paths import AnyPath, exists
from worldline_core.data.sources.agibot_gesim import AgibotGesimSource, AgibotGesimSourceConfig
from worldline_core.data.sources.agibot_world import AgibotWorldSource, AgibotWorldSourceConfig
from worldline_core.data.sources.droid_annotation import DroidAnnotationSource, DroidAnnotationSourceConfig
from worldline_core.data.sources.episode_set import EpisodeSetSource, EpisodeSetSourceConfig
from worldline_core.data.sources.lerobot import LeRobotSourceConfig, open_lerobot
from worldline_core.data.sources.mcap import McapSource, McapSourceConfig, McapTopicsSource, McapTopicsSourceConfig
from worldline_core.data.sources.repaired import repair, undistorted
from worldline_core.data.sources.robomind import RobomindSource, RobomindSourceConfig
from worldline_core.data.sources.robotwin import RobotwinSource, RobotwinSourceConfig
from worldline_core.data.sources.video_folder import VideoFolderSource, VideoFolderSourceConfig
from worldline_core.errors import DataError

SourceConfig = Annotated[
    EpisodeSetSourceConfig
    | LeRobotSourceConfig
    | AgibotGesimSourceConfig
    | AgibotWorldSourceConfig
    | DroidAnnotationSourceConfig
    | McapSourceConfig
    | McapTopicsSourceConfig
    | RobomindSourceConfig
    | RobotwinSourceConfig
    | VideoFolderSourceConfig,
    Field(discriminator="kind"),
]


_READERS: dict[type, Callable[[Any, AnyPath], EpisodeSource]] = {
    EpisodeSetSourceConfig: EpisodeSetSource,
    LeRobotSourceConfig: open_lerobot,
    AgibotGesimSourceConfig: AgibotGesimSource,
    AgibotWorldSourceConfig: AgibotWorldSource,
    DroidAnnotationSourceConfig: DroidAnnotationSource,
    McapSourceConfig: McapSource,
    McapTopicsSourceConfig: McapTopicsSource,
    RobomindSourceConfig: RobomindSource,
    RobotwinSourceConfig: RobotwinSource,
    VideoFolderSourceConfig: VideoFolderSource,
}


def open_source(config: SourceConfig, root: AnyPath) -> EpisodeSource:
    """The reader of a configured source. Its episodes keep the contract's conventions, whatever the configuration declares
    as departing from them, and are those of pinhole cameras.

    Raises: DataError when the folder is missing or not of that kind.
    """
    if not exists(root):
        raise DataError("Source folder is missing", where=str(root), next_step="check curate.sources[].path")
    return _RepairedSource(_READERS[type(config)](config, root), config.conventions)


class _RepairedSource:
    def __init__(self, source: EpisodeSource, conventions: RecordedConventions) -> None:
        self._source = source
        self._conventions = conventions

    def episode_ids(self) -> list[str]:
        return self._source.episode_ids()

    def load(self, episode_id: str) -> LoadedEpisode:
        return undistorted(repair(self._source.load(episode_id), self._conventions))
