"""Open a configured source: the kinds there are, and the reader of each."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from worldline_core.data.episodes.source import EpisodeSource
from worldline_core.data.guards.source_paths import AnyPath, exists
from worldline_core.data.sources.agibot_gesim import AgibotGesimSource, AgibotGesimSourceConfig
from worldline_core.data.sources.agibot_world import AgibotWorldSource, AgibotWorldSourceConfig
from worldline_core.data.sources.droid_annotation import DroidAnnotationSource, DroidAnnotationSourceConfig
from worldline_core.data.sources.episode_set import EpisodeSetSource, EpisodeSetSourceConfig
from worldline_core.data.sources.lerobot import LeRobotCollection, LeRobotSource, LeRobotSourceConfig
from worldline_core.data.sources.mcap import McapSource, McapSourceConfig, McapTopicsSource, McapTopicsSourceConfig
from worldline_core.data.sources.repaired import PinholeSource, RepairedSource
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


def open_source(config: SourceConfig, root: AnyPath) -> EpisodeSource:
    """The reader of a configured source: it repairs what the configuration declares as departing from the contract, and
    takes out lens distortion.

    Raises: DataError when the folder is missing or not of that kind.
    """
    if not exists(root):
        raise DataError("Source folder is missing", where=str(root), next_step="check curate.sources[].path")
    source = _reader(config, root)
    return PinholeSource(RepairedSource(source, config.conventions) if config.conventions.departures else source)


def _reader(config: SourceConfig, root: AnyPath) -> EpisodeSource:
    match config:
        case EpisodeSetSourceConfig():
            return EpisodeSetSource(config, root)
        case LeRobotSourceConfig():
            return LeRobotCollection(config, root) if config.collection else LeRobotSource(config, root)
        case AgibotGesimSourceConfig():
            return AgibotGesimSource(config, root)
        case AgibotWorldSourceConfig():
            return AgibotWorldSource(config, root)
        case DroidAnnotationSourceConfig():
            return DroidAnnotationSource(config, root)
        case McapSourceConfig():
            return McapSource(config, root)
        case McapTopicsSourceConfig():
            return McapTopicsSource(config, root)
        case RobomindSourceConfig():
            return RobomindSource(config, root)
        case RobotwinSourceConfig():
            return RobotwinSource(config, root)
        case VideoFolderSourceConfig():
            return VideoFolderSource(config, root)
