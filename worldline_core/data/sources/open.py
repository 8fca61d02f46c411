"""Open a configured source: the kinds there are, and the reader of each, here or in a process with limits.

A loaded episode is brought to the contract before anything else looks at its pixels: declared departures from the
conventions are repaired, and distorting lenses taken out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from worldline_core.data.episodes.conventions import RecordedConventions, apply_conventions, image_frames
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.recorded_poses import check_intrinsics, rejected_as, with_rigid_poses
from worldline_core.data.episodes.source import EpisodeSource, LoadedEpisode, Masks, SourceConfigBase
from worldline_core.data.guards.reader_process import ReaderLimits, read_limited
from worldline_core.data.guards.rejection import RejectedInputError, check_rate
from worldline_core.data.guards.source_paths import AnyPath, SourceFolder, exists
from worldline_core.data.sources.agibot import (
    AgibotGesimSource,
    AgibotGesimSourceConfig,
    AgibotWorldSource,
    AgibotWorldSourceConfig,
    EnerverseAcSource,
    EnerverseAcSourceConfig,
)
from worldline_core.data.sources.calibration_file import calibrated, read_calibration
from worldline_core.data.sources.droid_annotation import DroidAnnotationSource, DroidAnnotationSourceConfig
from worldline_core.data.sources.lerobot import LeRobotSourceConfig, open_lerobot
from worldline_core.data.sources.mcap import McapSource, McapSourceConfig, McapTopicsSource, McapTopicsSourceConfig
from worldline_core.data.sources.robomind import RobomindSource, RobomindSourceConfig
from worldline_core.data.sources.robotwin import RobotwinSource, RobotwinSourceConfig
from worldline_core.data.sources.unitree_h5 import UnitreeH5Source, UnitreeH5SourceConfig
from worldline_core.data.sources.video_folder import VideoFolderSource, VideoFolderSourceConfig
from worldline_core.data.sources.worldarena import WorldArenaSource, WorldArenaSourceConfig
from worldline_core.data.video.clip import video_size
from worldline_core.data.video.frames import MadeFrames
from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import carry_embodiments, own_embodiment


class EpisodeSetSourceConfig(SourceConfigBase):
    """This project's own recordings, for example an EpisodeSet that the recorder wrote."""

    kind: Literal["episode_set"] = "episode_set"


class RecordingSourceConfig(EpisodeSetSourceConfig):
    """A recording that the run makes: one of its section ``record``."""

    kind: Literal["recording"] = "recording"  # pyright: ignore[reportIncompatibleVariableOverride]
    recording: str
    path: SourceFolder = Path("record")

    @property
    def label(self) -> str:
        return self.name or self.recording


SourceConfig = Annotated[
    EpisodeSetSourceConfig
    | RecordingSourceConfig
    | LeRobotSourceConfig
    | AgibotGesimSourceConfig
    | AgibotWorldSourceConfig
    | DroidAnnotationSourceConfig
    | EnerverseAcSourceConfig
    | McapSourceConfig
    | McapTopicsSourceConfig
    | RobomindSourceConfig
    | RobotwinSourceConfig
    | UnitreeH5SourceConfig
    | VideoFolderSourceConfig
    | WorldArenaSourceConfig,
    Field(discriminator="kind"),
]


class EpisodeSetSource:
    """Reads an EpisodeSet; its datasets must be inside its folder.

    Raises: DataError when the set has no readable index.
    """

    looked_for = "rows in index.parquet"

    def __init__(self, _: EpisodeSetSourceConfig, root: AnyPath) -> None:
        self._set = EpisodeSet.open(root, allow_linked=False)
        self._listed = Counter(row.episode_id for row in self._set.rows)

    def episode_ids(self) -> list[str]:
        return [row.episode_id for row in self._set.rows]

    def load(self, episode_id: str) -> LoadedEpisode:
        if self._listed[episode_id] > 1:
            where = f"{self._set.root}, {episode_id}"
            raise RejectedInputError("duplicate_id", "Several episodes of the set have this id", where=where)
        position = self._set.position(episode_id)
        episode = with_rigid_poses(self._set.episode(position))
        clips = {view: self._set.clip(position, view) for view in self._set.rows[position].views}
        for view, clip in clips.items():
            check_rate(video_size(clip.path)[2], episode.fps, f"{episode_id}, view {view}")
        return LoadedEpisode(
            episode,
            tuple(clips),
            robot_masks=lambda view: self._set.robot_masks(position, view),
            thing_labels=lambda view: self._set.thing_labels(position, view),
            clips=clips,
        )


_READERS: dict[type, Callable[[Any, AnyPath], EpisodeSource]] = {
    EpisodeSetSourceConfig: EpisodeSetSource,
    RecordingSourceConfig: EpisodeSetSource,
    LeRobotSourceConfig: open_lerobot,
    AgibotGesimSourceConfig: AgibotGesimSource,
    AgibotWorldSourceConfig: AgibotWorldSource,
    DroidAnnotationSourceConfig: DroidAnnotationSource,
    EnerverseAcSourceConfig: EnerverseAcSource,
    McapSourceConfig: McapSource,
    McapTopicsSourceConfig: McapTopicsSource,
    RobomindSourceConfig: RobomindSource,
    RobotwinSourceConfig: RobotwinSource,
    UnitreeH5SourceConfig: UnitreeH5Source,
    VideoFolderSourceConfig: VideoFolderSource,
    WorldArenaSourceConfig: WorldArenaSource,
}


def open_source(config: SourceConfig, root: AnyPath) -> EpisodeSource:
    """The reader of a configured source. Its episodes keep the contract's conventions, whatever the configuration declares
    as departing from them, and are those of pinhole cameras.

    Raises: DataError when the folder is missing or not of that kind.
    """
    if not exists(root):
        raise DataError("Source folder is missing", where=str(root), next_step="check curate.sources[].path")
    if robot := own_embodiment(getattr(config, "embodiment", None) or ""):
        config = config.model_copy(update={"embodiment": carry_embodiments([robot])[0]})
    return _RepairedSource(_READERS[type(config)](config, root), config, root)


class _RepairedSource:
    def __init__(self, source: EpisodeSource, config: SourceConfigBase, root: AnyPath) -> None:
        self._source = source
        self._config = config
        self._root = root
        self._calibration = lru_cache(maxsize=1)(partial(read_calibration, root))
        self.looked_for = source.looked_for

    def episode_ids(self) -> list[str]:
        """Ids of the episodes that the configuration includes.

        Raises: DataError when there is none.
        """
        listed = self._source.episode_ids()
        included = [episode_id for episode_id in listed if self._config.includes(episode_id)]
        if not included:
            raise DataError(
                "None of the source's episodes is included" if listed else "Source holds no episode",
                where=f"source {self._config.label}, {self._root}",
                expected=f"include: {', '.join(self._config.include or ())}" if listed else self.looked_for,
                got=f"{len(listed)} episodes: {', '.join(listed[:3])}, ..." if listed else None,
                next_step="check `path`, `kind` and `include` of the source (docs/sources.md)",
            )
        return included

    def load(self, episode_id: str) -> LoadedEpisode:
        loaded = self._source.load(episode_id)
        name = getattr(self._config, "calibration", None)
        # LeRobot's sources read it themselves: it may be a file of each episode, and name columns.
        if name is not None and not isinstance(self._config, LeRobotSourceConfig):
            read = {*loaded.views, *loaded.absent, *(getattr(self._config, "views", None) or ())}
            loaded = calibrated(loaded, self._calibration(name), f"{self._root}, {name}", read)
        loaded = repair(loaded, self._config.conventions)
        loaded = undistorted(loaded.with_mounted(loaded))
        source = self._config.name or loaded.episode.source
        return replace(loaded, episode=replace(loaded.episode, source=source))


def repair(loaded: LoadedEpisode, conventions: RecordedConventions) -> LoadedEpisode:
    """The loaded episode in the contract's conventions; images and masks follow a lag.

    Raises: RejectedInputError where the conventions do not apply to the episode.
    """
    if not conventions.departures:
        return loaded
    recorded = loaded.episode
    declared = {f"declared_{field}": str(getattr(conventions, field)) for field in conventions.departures}
    repaired = apply_conventions(recorded, conventions)
    episode = replace(repaired, conventions={**repaired.conventions, **declared})
    if not (conventions.camera_lag_frames or conventions.image_lag_frames):
        return replace(loaded, episode=episode)

    def kept(view: str) -> range:
        images = range(recorded.num_video_frames)[image_frames(recorded.num_frames, conventions, view)]
        return images[: repaired.num_video_frames]

    return loaded.cut(episode, kept)


def undistorted(loaded: LoadedEpisode) -> LoadedEpisode:
    """The episode with images, masks and K of pinhole cameras; its conventions name the lenses that were taken out.

    Raises: RejectedInputError: singular_intrinsics; invalid_distortion when a lens has no camera matrix, its model cannot
        be inverted inside of the image, or the images have another size than the one it was calibrated for.
    """
    if not loaded.distortions:
        return loaded
    from worldline_core.geometry.lens import Undistortion, undistortion

    where = f"episode {loaded.episode.episode_id}"
    cameras = dict(loaded.episode.cameras)
    lenses: dict[str, Undistortion] = {}
    for view, distortion in loaded.distortions.items():
        if view not in cameras:
            raise RejectedInputError(
                "invalid_distortion",
                "A lens is stated for a view without a camera matrix",
                where=f"{where}, view {view}",
            )
        camera = cameras[view]
        check_intrinsics(camera, f"{where}, view {view}")
        evidence = {"view": view, "model": distortion.model, "coefficients": list(distortion.coefficients)}
        with rejected_as("invalid_distortion", f"{where}, view {view}", evidence):
            lenses[view] = undistortion(distortion, camera.K, (camera.height, camera.width))
        cameras[view] = replace(camera, K=lenses[view].K)

    def straightened(image: np.ndarray, view: str) -> np.ndarray:
        """An image (H, W, 3) or mask (H, W) of a view with a lens."""
        size = lenses[view].image_size
        if image.shape[:2] != size:
            raise RejectedInputError(
                "invalid_distortion",
                "Images have another size than their lens was calibrated for",
                where=f"{where}, view {view}",
                expected=f"{size[0]}x{size[1]}",
                got=f"{image.shape[0]}x{image.shape[1]}",
            )
        return (lenses[view].masks if image.ndim == 2 else lenses[view].frames)(image[None])[0]

    def images(view: str) -> Iterator[np.ndarray]:
        for image in loaded.each_image(view):
            yield straightened(image, view) if view in lenses else image

    def robot_masks(view: str) -> Masks | None:
        masks = loaded.robot_masks(view)
        if masks is None or view not in lenses:
            return masks
        return MadeFrames(lambda: (straightened(mask, view) for mask in masks), masks.shape, bool)

    taken_out = "; ".join(f"{view}: {d.model} {list(d.coefficients)}" for view, d in loaded.distortions.items())
    conventions = {**loaded.episode.conventions, "undistorted": taken_out}
    return replace(
        loaded,
        episode=replace(loaded.episode, cameras=cameras, conventions=conventions),
        images=images,
        robot_masks=robot_masks,
        distortions={},
        clips={view: clip for view, clip in loaded.clips.items() if view not in lenses},
    )


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
