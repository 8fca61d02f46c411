"""One recorded episode: checked, brought to the wanted rate and size, and described as the configuration asks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from worldline_core.data.curation.checks import (
    check_camera,
    check_joints,
    check_split,
    check_times,
    check_values,
    stride_to,
)
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.curation.scenes import with_split
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.instructions import with_instruction
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.episodes.view_recording import RecordedView
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.video.thumbnails import ViewThumbnails
from worldline_core.geometry.cameras import ImageTransform

PRIMARY_VIEW_REASON = "primary_view_reason"
Why = Literal["configured", "head", "most_motion"]


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
    """An episode at the wanted rate and size, ready to be written; its images are read while they are written.

    Attributes:
        frames: by view.
        masks: by view, bool (N, H, W), of the views that have them.
        things: by view, uint8 (N, H, W) labels of things, of the views that have them.
        described: the episode as the configuration describes it, given the thumbnails of its views.
    """

    episode: Episode
    frames: dict[str, RecordedView]
    masks: dict[str, np.ndarray]
    things: dict[str, np.ndarray]
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
    things: dict[str, np.ndarray] = {}
    for view in views:
        mask, labels = loaded.robot_masks(view), loaded.thing_labels(view)
        if mask is not None:
            masks[view] = ImageTransform.of(mask.shape[1:3]).fitted(config.image_size, config.fit).masks(mask[::step])
        if labels is not None:
            fitted = ImageTransform.of(labels.shape[1:3]).fitted(config.image_size, config.fit)
            things[view] = fitted.labels(labels[::step])
    cameras = {
        view: camera.transformed(ImageTransform.of((camera.height, camera.width)).fitted(config.image_size, config.fit))
        for view in views
        if (camera := episode.cameras.get(view)) is not None
    }
    prepared = replace(
        episode,
        fps=config.fps or episode.fps,
        timestamps=np.arange(episode.num_frames) / (config.fps or episode.fps),
        cameras=cameras,
    )
    return PreparedEpisode(prepared, frames, masks, things, partial(described, config, prepared, tuple(views)))


def described(
    config: CurateConfig, episode: Episode, views: Sequence[str], thumbnails: Mapping[str, ViewThumbnails]
) -> Episode:
    """The episode as the set describes it: its split, instruction and primary view. None of them depends on its outcome.

    Args:
        views: views that the set keeps. thumbnails: of these.

    Raises: ConfigError when a recording for evaluation only is given a training split.
    """
    primary = with_primary_view(episode, config.primary_view, views, thumbnails)
    result = with_split(with_instruction(primary, config.instructions), config.splits)
    check_split(result)
    return result


def with_primary_view(
    episode: Episode, configured: str | None, views: Sequence[str], thumbnails: Mapping[str, ViewThumbnails]
) -> Episode:
    """The episode with the view that stands for it in single-view training (Stage I), and in its conventions why.

    In this order: the configured view, the one that the source declares, the head's, the one that shows most motion (of
    equal ones the last by name). An episode that lacks the configured view stays out of Stage I, as the configuration
    asks.
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
