"""One recorded episode: checked, brought to the wanted rate and size."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from worldline_core.data.curation.checks import (
    check_camera,
    check_joints,
    check_times,
    check_values,
    stride_to,
)
from worldline_core.data.curation.config import CurateConfig
from worldline_core.data.curation.description import described
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.view_recording import RecordedView
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.sources.base import LoadedEpisode
from worldline_core.data.video.resize import fitted
from worldline_core.data.video.thumbnails import ViewThumbnails


def check_episode(config: CurateConfig, loaded: LoadedEpisode) -> None:
    """Raises: RejectedInputError with the reason, where the recording does not satisfy the contract or the configuration."""
    episode = loaded.episode
    check_values(episode)
    check_times(episode, config.time_tolerance_frames)
    check_joints(episode, config.joint_tolerance_rad)
    for camera in episode.cameras.values():
        check_camera(episode, camera)
    missing = [view for view in config.views or () if view not in loaded.views]
    if missing:
        raise RejectedInputError(
            "missing_view",
            "Episode lacks a view",
            where=f"episode {episode.episode_id}",
            expected=", ".join(missing),
            got=", ".join(loaded.views),
            evidence={"missing": missing, "found": list(loaded.views)},
        )
    uncalibrated = [view for view in config.views or loaded.views if view not in episode.cameras]
    if config.require_calibration and uncalibrated:
        raise RejectedInputError(
            "missing_calibration",
            "View has no calibration",
            where=f"episode {episode.episode_id}",
            expected="K and T_base_camera of each view",
            got="none for " + ", ".join(uncalibrated),
            evidence={"views": uncalibrated},
        )


@dataclass(frozen=True)
class PreparedEpisode:
    """An episode at the wanted rate and size, ready to be written; its images are read while they are.

    Attributes:
        frames: by view.
        masks: by view, bool (N, H, W), of the views that have them.
        described: the episode as the configuration describes it, once the thumbnails of its views are there.
    """

    episode: Episode
    frames: dict[str, RecordedView]
    masks: dict[str, np.ndarray]
    described: Callable[[Mapping[str, ViewThumbnails]], Episode]


def prepare_episode(config: CurateConfig, loaded: LoadedEpisode) -> PreparedEpisode:
    """The episode as the set will hold it. No image is decoded yet: that happens once, while the episode is written.

    Raises: RejectedInputError (too_short, wrong_fps).
    """
    recorded = loaded.episode
    step = config.stride or stride_to(recorded, config.fps)
    views = config.views or loaded.views
    episode = recorded if step == 1 else recorded.cut(0, recorded.num_frames, step)
    if episode.num_frames < config.min_frames:
        raise RejectedInputError(
            "too_short",
            "Episode has too few frames",
            where=f"episode {episode.episode_id}",
            expected=f"at least {config.min_frames}",
            got=episode.num_frames,
            evidence={"frames": episode.num_frames},
        )
    frames = {
        view: RecordedView(
            partial(loaded.each_image, view),
            recorded.num_video_frames,
            loaded.clips.get(view),
            step,
            config.image_size,
            config.fit,
        )
        for view in views
    }
    masks: dict[str, np.ndarray] = {}
    for view in views:
        mask = loaded.robot_masks(view)
        if mask is not None:
            masks[view] = fitted(mask.shape[1:3], config.image_size, config.fit).masks(mask[::step])
    cameras = {
        view: camera.transformed(fitted((camera.height, camera.width), config.image_size, config.fit))
        for view in views
        if (camera := episode.cameras.get(view)) is not None
    }
    prepared = replace(
        episode,
        fps=config.fps or episode.fps,
        timestamps=np.arange(episode.num_frames) / (config.fps or episode.fps),
        cameras=cameras,
    )
    return PreparedEpisode(prepared, frames, masks, partial(described, config, prepared, tuple(views)))
