"""One recorded episode: checked, brought to the wanted rate and size."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import numpy as np

from worldline_core.data.curate_checks import (
    check_camera,
    check_joints,
    check_split,
    check_times,
    check_values,
    stride_to,
)
from worldline_core.data.curate_config import CurateConfig
from worldline_core.data.episode import Episode
from worldline_core.data.rejection import RejectedInputError
from worldline_core.data.resize import fitted
from worldline_core.data.sources.base import LoadedEpisode


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
    """An episode at the wanted rate and size, with its images in memory.

    Attributes:
        frames: by view, uint8 (N, H, W, 3).
        masks: by view, bool (N, H, W), of the views that have them.
        fingerprint: digest of the recorded states, actions and images.
    """

    episode: Episode
    frames: dict[str, np.ndarray]
    masks: dict[str, np.ndarray]
    fingerprint: str


def prepare_episode(config: CurateConfig, loaded: LoadedEpisode) -> PreparedEpisode:
    """The episode as the set will hold it.

    Raises: RejectedInputError (length_mismatch, too_short, wrong_fps, and whatever decoding raises); ConfigError when a
        recording for evaluation only is given a training split.
    """
    step = stride_to(loaded.episode, config.fps)
    views = config.views or loaded.views
    source_frames = {view: loaded.frames(view) for view in views}
    for view, images in source_frames.items():
        if len(images) != loaded.episode.num_video_frames:
            raise RejectedInputError(
                "length_mismatch",
                "Video and states differ in length",
                where=f"episode {loaded.episode.episode_id}, view {view}",
                expected=f"{loaded.episode.num_video_frames} frames",
                got=f"{len(images)} frames",
                evidence={"states": loaded.episode.num_video_frames, "frames": len(images)},
            )
    fingerprint = _fingerprint(loaded.episode, source_frames)
    episode = loaded.episode if step == 1 else loaded.episode.cut(0, loaded.episode.num_frames, step)
    if episode.num_frames < config.min_frames:
        raise RejectedInputError(
            "too_short",
            "Episode has too few frames",
            where=f"episode {episode.episode_id}",
            expected=f"at least {config.min_frames}",
            got=episode.num_frames,
            evidence={"frames": episode.num_frames},
        )
    fits = {view: fitted(images.shape[1:3], config.image_size, config.fit) for view, images in source_frames.items()}
    frames = {view: fits[view].frames(images[::step]) for view, images in source_frames.items()}
    masks: dict[str, np.ndarray] = {}
    for view in views:
        mask = loaded.robot_masks(view)
        if mask is not None:
            masks[view] = fits[view].masks(mask[::step])
    cameras = {view: episode.cameras[view].transformed(fits[view]) for view in views if view in episode.cameras}
    split = next((s for pattern, s in config.splits.items() if fnmatchcase(episode.scene, pattern)), episode.split)
    prepared = replace(
        episode,
        fps=config.fps or episode.fps,
        timestamps=np.arange(episode.num_frames) / (config.fps or episode.fps),
        cameras=cameras,
        split=split,
        primary_view=config.primary_view or episode.primary_view,
    )
    check_split(prepared)
    return PreparedEpisode(prepared, frames, masks, fingerprint)


def _fingerprint(episode: Episode, frames: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for array in (episode.state, episode.action, *(frames[view] for view in sorted(frames))):
        digest.update(str((array.shape, array.dtype.str)).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
