"""A source whose recordings depart from the contract's conventions, read as if they did not.

Recordings of a distorting lens become those of a pinhole, before anything else looks at their pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from worldline_core.data.episodes.conventions import RecordedConventions, apply_conventions, image_frames
from worldline_core.data.episodes.recorded_poses import check_intrinsics, rejected_as
from worldline_core.data.episodes.source import EpisodeSource, LoadedEpisode
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.geometry.distortion import Distortion


class RepairedSource:
    """Wraps a source and repairs each episode it loads; the episode's own conventions say which fields were used."""

    def __init__(self, source: EpisodeSource, conventions: RecordedConventions) -> None:
        self._source = source
        self._conventions = conventions

    def episode_ids(self) -> list[str]:
        return self._source.episode_ids()

    def load(self, episode_id: str) -> LoadedEpisode:
        return repair(self._source.load(episode_id), self._conventions)


def repair(loaded: LoadedEpisode, conventions: RecordedConventions) -> LoadedEpisode:
    """The loaded episode in the contract's conventions; images and masks follow a lag.

    Raises: RejectedInputError where the conventions do not apply to the episode.
    """
    if not conventions.departures:
        return loaded
    recorded, episode_id = loaded.episode, loaded.episode.episode_id
    images = image_frames(recorded.num_frames, conventions)
    lagging = bool(conventions.camera_lag_frames or conventions.image_lag_frames)
    declared = {f"declared_{field}": str(getattr(conventions, field)) for field in conventions.departures}
    repaired = apply_conventions(recorded, conventions)

    def cut(values: np.ndarray, view: str) -> np.ndarray:
        if not lagging:
            return values
        if len(values) != recorded.num_video_frames:
            raise RejectedInputError(
                "length_mismatch",
                "Video and states differ in length",
                where=f"episode {episode_id}, view {view}",
                expected=f"{recorded.num_video_frames} frames",
                got=f"{len(values)} frames",
                evidence={"states": recorded.num_video_frames, "frames": len(values)},
            )
        return values[images]

    def cut_images(view: str) -> Iterator[np.ndarray]:
        kept = range(recorded.num_video_frames)[images] if lagging else range(recorded.num_video_frames)
        return (image for number, image in enumerate(loaded.each_image(view)) if number in kept)

    def masks(view: str) -> np.ndarray | None:
        recorded_masks = loaded.robot_masks(view)
        return None if recorded_masks is None else cut(recorded_masks, view)

    return replace(
        loaded,
        episode=replace(repaired, conventions={**repaired.conventions, **declared}),
        frames=lambda view: cut(loaded.frames(view), view),
        robot_masks=masks,
        clips={view: clip.cut(images.start, images.stop) if lagging else clip for view, clip in loaded.clips.items()},
        images=cut_images,
    )


class PinholeSource:
    """Wraps a source: the episodes it loads are those of pinhole cameras."""

    def __init__(self, source: EpisodeSource) -> None:
        self._source = source

    def episode_ids(self) -> list[str]:
        return self._source.episode_ids()

    def load(self, episode_id: str) -> LoadedEpisode:
        return undistorted(self._source.load(episode_id))


def undistorted(loaded: LoadedEpisode) -> LoadedEpisode:
    """The episode with images, masks and K of pinhole cameras; its conventions name the lenses that were taken out.

    Raises: RejectedInputError (singular_intrinsics), or (invalid_distortion) when a lens has no camera matrix, its model cannot be inverted inside
        of the image, or the images have another size than the one it was calibrated for.
    """
    if not loaded.distortions:
        return loaded
    from worldline_core.geometry.undistortion import Undistortion, undistortion

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
                evidence={"view": view},
            )
        camera = cameras[view]
        check_intrinsics(camera, f"{where}, view {view}")
        evidence = {"view": view, "model": distortion.model, "coefficients": list(distortion.coefficients)}
        with rejected_as("invalid_distortion", f"{where}, view {view}", evidence):
            lenses[view] = undistortion(distortion, camera.K, (camera.height, camera.width), None)
        cameras[view] = replace(camera, K=lenses[view].K)

    def frames(view: str) -> np.ndarray:
        images = loaded.frames(view)
        if view not in lenses:
            return images
        _check_size(images, lenses[view].image_size, where, view)
        return lenses[view].frames(images)

    def images(view: str) -> Iterator[np.ndarray]:
        for image in loaded.each_image(view):
            if view in lenses:
                _check_size(image[None], lenses[view].image_size, where, view)
                yield lenses[view].frames(image[None])[0]
            else:
                yield image

    def robot_masks(view: str) -> np.ndarray | None:
        masks = loaded.robot_masks(view)
        if masks is None or view not in lenses:
            return masks
        _check_size(masks, lenses[view].image_size, where, view)
        return lenses[view].masks(masks)

    noted = {**loaded.episode.conventions, "undistorted": _described(loaded.distortions)}
    episode = replace(loaded.episode, cameras=cameras, conventions=noted)
    return replace(
        loaded,
        episode=episode,
        frames=frames,
        robot_masks=robot_masks,
        distortions={},
        clips={view: clip for view, clip in loaded.clips.items() if view not in lenses},
        images=images,
    )


def _described(distortions: Mapping[str, Distortion]) -> str:
    return "; ".join(f"{view}: {d.model} {list(d.coefficients)}" for view, d in distortions.items())


def _check_size(images: np.ndarray, size: tuple[int, int], where: str, view: str) -> None:
    if images.shape[1:3] != size:
        raise RejectedInputError(
            "invalid_distortion",
            "Images have another size than their lens was calibrated for",
            where=f"{where}, view {view}",
            expected=f"{size[0]}x{size[1]}",
            got=f"{images.shape[1]}x{images.shape[2]}",
            evidence={"view": view, "calibrated": list(size), "images": list(images.shape[1:3])},
        )
