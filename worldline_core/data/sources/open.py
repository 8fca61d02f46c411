"""Open a configured source: the kinds there are, and the reader of each.

What a reader loads is brought to the contract before anything else looks at its pixels: declared departures from the
conventions are repaired, and distorting lenses taken out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from worldline_core.data.episodes.conventions import RecordedConventions, apply_conventions, image_frames
from worldline_core.data.episodes.recorded_poses import check_intrinsics, rejected_as
from worldline_core.data.episodes.source import EpisodeSource, LoadedEpisode, Masks, SourceConfigBase
from worldline_core.data.guards.rejection import RejectedInputError, check_length
from worldline_core.data.guards.source_paths import AnyPath, content_of, exists
from worldline_core.data.sources.agibot_gesim import AgibotGesimSource, AgibotGesimSourceConfig
from worldline_core.data.sources.agibot_world import AgibotWorldSource, AgibotWorldSourceConfig
from worldline_core.data.sources.droid_annotation import DroidAnnotationSource, DroidAnnotationSourceConfig
from worldline_core.data.sources.enerverse_ac import EnerverseAcSource, EnerverseAcSourceConfig
from worldline_core.data.sources.episode_set import EpisodeSetSource, EpisodeSetSourceConfig
from worldline_core.data.sources.lerobot import LeRobotSourceConfig, open_lerobot
from worldline_core.data.sources.mcap import McapSource, McapSourceConfig, McapTopicsSource, McapTopicsSourceConfig
from worldline_core.data.sources.robomind import RobomindSource, RobomindSourceConfig
from worldline_core.data.sources.robotwin import RobotwinSource, RobotwinSourceConfig
from worldline_core.data.sources.unitree_h5 import UnitreeH5Source, UnitreeH5SourceConfig
from worldline_core.data.sources.video_folder import VideoFolderSource, VideoFolderSourceConfig
from worldline_core.data.video.frames import MadeFrames
from worldline_core.errors import DataError

SourceConfig = Annotated[
    EpisodeSetSourceConfig
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
    | VideoFolderSourceConfig,
    Field(discriminator="kind"),
]


_READERS: dict[type, Callable[[Any, AnyPath], EpisodeSource]] = {
    EpisodeSetSourceConfig: EpisodeSetSource,
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
}


class _NoDataset:
    """A folder without the file that a data set of its kind begins with: it lists nothing."""

    def __init__(self, looked_for: str) -> None:
        self.looked_for = looked_for

    def episode_ids(self) -> list[str]:
        return []

    def load(self, episode_id: str) -> LoadedEpisode:
        raise DataError("Source holds no episode", where=episode_id, expected=self.looked_for)


def _reader(config: SourceConfig, root: AnyPath) -> EpisodeSource:
    if isinstance(config, EpisodeSetSourceConfig) and not exists(root / "index.parquet"):
        return _NoDataset("index.parquet, which an EpisodeSet begins with")
    if isinstance(config, LeRobotSourceConfig) and not config.collection and not exists(root / "meta" / "info.json"):
        return _NoDataset("meta/info.json, which a LeRobotDataset begins with (a folder of several: collection: true)")
    return _READERS[type(config)](config, root)


def open_source(config: SourceConfig, root: AnyPath) -> EpisodeSource:
    """The reader of a configured source. Its episodes keep the contract's conventions, whatever the configuration declares
    as departing from them, and are those of pinhole cameras.

    Raises: DataError when the folder is missing or not of that kind.
    """
    if not exists(root):
        raise DataError("Source folder is missing", where=str(root), next_step="check curate.sources[].path")
    return _RepairedSource(_reader(config, root), config)


def nothing_found(config: SourceConfig, source: EpisodeSource, root: AnyPath) -> DataError:
    """What to say of a source of which there is nothing to read: what was looked for, and what is there instead."""
    listed, where = source.episode_ids(), f"source {config.label}, {root}"
    if listed:
        return DataError(
            "None of the source's episodes is wanted",
            where=where,
            expected=f"include: {', '.join(config.include or ())}",
            got=f"{len(listed)} episodes: {', '.join(listed[:3])}{', ...' if len(listed) > 3 else ''}",
            next_step="correct the patterns, or leave `include` out",
        )
    return DataError(
        "Source holds no episode",
        where=where,
        expected=source.looked_for,
        got=content_of(root),
        next_step="check `path` and `kind` of the source (docs/sources.md)",
    )


class _RepairedSource:
    def __init__(self, source: EpisodeSource, config: SourceConfigBase) -> None:
        self._source = source
        self._config = config

    @property
    def looked_for(self) -> str:
        return self._source.looked_for

    def episode_ids(self) -> list[str]:
        return self._source.episode_ids()

    def load(self, episode_id: str) -> LoadedEpisode:
        loaded = undistorted(repair(self._source.load(episode_id), self._config.conventions))
        source = self._config.name or loaded.episode.source
        return replace(loaded, episode=replace(loaded.episode, source=source))


def repair(loaded: LoadedEpisode, conventions: RecordedConventions) -> LoadedEpisode:
    """The loaded episode in the contract's conventions; images and masks follow a lag.

    Raises: RejectedInputError where the conventions do not apply to the episode.
    """
    if not conventions.departures:
        return loaded
    recorded = loaded.episode
    kept = range(recorded.num_video_frames)[image_frames(recorded.num_frames, conventions)]
    lagging = bool(conventions.camera_lag_frames or conventions.image_lag_frames)
    declared = {f"declared_{field}": str(getattr(conventions, field)) for field in conventions.departures}
    repaired = apply_conventions(recorded, conventions)

    def check_count(found: int, view: str) -> None:
        where = f"episode {recorded.episode_id}, view {view}"
        check_length("Video", where, states=recorded.num_video_frames, unit="frames", found=found)

    def images(view: str) -> Iterator[np.ndarray]:
        count = 0
        for count, image in enumerate(loaded.each_image(view), 1):
            if count - 1 in kept:
                yield image
        check_count(count, view)

    def cut(found: Masks | None, view: str) -> Masks | None:
        if found is not None:
            check_count(len(found), view)
        return None if found is None else found[kept.start : kept.stop]

    clips = {view: clip.cut(kept.start, kept.stop) for view, clip in loaded.clips.items()}
    episode = replace(repaired, conventions={**repaired.conventions, **declared})
    if not lagging:
        return replace(loaded, episode=episode)
    return replace(
        loaded,
        episode=episode,
        images=images,
        robot_masks=lambda view: cut(loaded.robot_masks(view), view),
        thing_labels=lambda view: cut(loaded.thing_labels(view), view),
        clips=clips,
    )


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
                expected=", ".join(cameras) or "a calibrated view",
                got=view,
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
