"""What a recorded episode must satisfy to enter a set. Each failed check has its reason code and its numbers."""

from __future__ import annotations

from functools import lru_cache, partial

import numpy as np

from worldline_core.data.curation.curate_config import AVAILABLE, CurateConfig
from worldline_core.data.episodes.episode import NO_EMBODIMENT, CameraTrack, Episode
from worldline_core.data.episodes.recorded_poses import camera_pose, check_intrinsics
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.guards.rejection import RejectedInputError, all_of, check_finite, check_length, collect_faults
from worldline_core.errors import ConfigError
from worldline_core.geometry.embodiment import Embodiment, check_embodiment_name, load_embodiment

MAX_JOINT_RAD = 4 * np.pi
"""No joint of a manipulator turns further; larger numbers are degrees or encoder ticks."""
_GRIPPER_MARGIN = 0.05
_JOINT_TOLERANCE_RAD = 0.05
_TIME_TOLERANCE_FRAMES = 0.25
"""Largest distance of a frame from its place on the grid of its rate."""


def check_episode(config: CurateConfig, loaded: LoadedEpisode) -> None:
    """Raises: RejectedInputError where the recording does not satisfy the contract or the configuration, with the reason of
    the first failed check and what all of them say."""
    episode = loaded.episode
    check_values(episode)  # what is no number cannot be compared with anything
    faults: list[RejectedInputError] = []
    for check in (
        partial(check_lengths, loaded),
        partial(check_times, episode),
        partial(check_joints, episode),
        *(partial(check_camera, episode, camera) for camera in episode.cameras.values()),
        partial(check_views, config, loaded),
    ):
        with collect_faults(faults):
            check()
    if config.views != AVAILABLE or not loaded.views:
        faults += loaded.absent.values()
    if faults:
        raise all_of(faults, f"episode {episode.episode_id}")


def check_lengths(loaded: LoadedEpisode) -> None:
    """Raises: RejectedInputError (length_mismatch) for a video with another number of frames than there are states."""
    states = loaded.episode.num_video_frames
    for view, clip in loaded.clips.items():
        where = f"episode {loaded.episode.episode_id}, view {view}, {clip.path}"
        check_length("Video", where, states=states, unit="frames", found=clip.num_frames)


def check_views(config: CurateConfig, loaded: LoadedEpisode) -> None:
    """Raises: RejectedInputError (missing_view, missing_calibration) for views that the configuration asks for."""
    episode = loaded.episode
    where = f"episode {episode.episode_id}"
    wanted = config.views if isinstance(config.views, tuple) else loaded.views
    missing = [view for view in wanted if view not in (*loaded.views, *loaded.absent)]
    if missing:
        raise RejectedInputError(
            "missing_view",
            "Episode lacks a view",
            where=where,
            expected=", ".join(missing),
            got=", ".join(loaded.views),
        )
    uncalibrated = [view for view in wanted if view not in episode.cameras]
    if config.require_calibration and uncalibrated:
        got = "none for " + ", ".join(uncalibrated)
        raise RejectedInputError("missing_calibration", "View has no calibration", where=where, got=got)


def check_values(episode: Episode) -> None:
    """Raises: RejectedInputError (nan_state) when a state, action, time or pose is not a finite number."""
    tracks = {"state": episode.state, "action": episode.action, "timestamps": episode.timestamps}
    if episode.T_base_ee is not None:
        tracks["T_base_ee"] = episode.T_base_ee
    for name, values in tracks.items():
        check_finite(name, values, f"episode {episode.episode_id}")


def check_joints(episode: Episode) -> None:
    """Compare joints with the limits of the embodiment, where it is described.

    Raises: RejectedInputError (unknown_embodiment, joint_out_of_range, invalid_gripper, length_mismatch).
    """
    where = f"episode {episode.episode_id}"
    described = episode.state_kind != "none" and episode.embodiment != NO_EMBODIMENT
    if described:
        try:
            check_embodiment_name(episode.embodiment)
        except ConfigError as error:
            raise RejectedInputError(
                "unknown_embodiment",
                "The robot has no description",
                where=where,
                expected=error.expected,
                got=episode.embodiment,
                next_step=error.next_step,
            ) from error
    if episode.state_kind != "joints":
        return
    names = episode.state_names or ()
    joints = [i for i in range(episode.state.shape[1]) if i >= len(names) or not names[i].endswith("gripper")]
    worst = float(np.abs(episode.state[:, joints]).max()) if joints else 0.0
    if worst > MAX_JOINT_RAD:
        raise RejectedInputError(
            "joint_out_of_range",
            "Joint positions are no angles in radians",
            where=where,
            expected=f"at most {MAX_JOINT_RAD:.2f} rad",
            got=worst,
            next_step="declare the unit of the source",
            evidence={"max_abs_rad": worst},
        )
    if not described:
        return
    embodiment = _embodiment(episode.embodiment)
    if embodiment.state_size != episode.state.shape[1]:
        raise RejectedInputError(
            "length_mismatch",
            "State has another size than the embodiment",
            where=f"{where}, {episode.embodiment}",
            expected=embodiment.state_size,
            got=episode.state.shape[1],
        )
    outside = embodiment.outside_limits(episode.state, _JOINT_TOLERANCE_RAD)
    if outside.any():
        frame, column = (int(value) for value in np.argwhere(outside)[0])
        raise RejectedInputError(
            "joint_out_of_range",
            "Joint position is beyond its limit",
            where=f"{where}, frame {frame}, {embodiment.state_names[column]}",
            expected="a position within the embodiment's limits",
            got=float(episode.state[frame, column]),
            evidence={
                "frame": frame,
                "joint": embodiment.state_names[column],
                "position_rad": float(episode.state[frame, column]),
                "frames_outside": int(outside.any(axis=1).sum()),
            },
        )
    columns = [embodiment.gripper_column(arm) for arm in embodiment.arms]
    opening = episode.state[:, columns]
    if opening.min() < -_GRIPPER_MARGIN or opening.max() > 1 + _GRIPPER_MARGIN:
        raise RejectedInputError(
            "invalid_gripper",
            "Gripper opening is not in 0 closed .. 1 open",
            where=where,
            expected="0..1",
            got=f"{opening.min():.3f}..{opening.max():.3f}",
            evidence={"min": float(opening.min()), "max": float(opening.max())},
        )


@lru_cache(maxsize=32)
def _embodiment(name: str) -> Embodiment:
    """Read once: parsing takes as long as decoding a hundred frames."""
    return load_embodiment(name)


def check_times(episode: Episode) -> None:
    """Raises: RejectedInputError (wrong_fps) when frame times leave the grid of the stated rate."""
    grid = np.arange(episode.num_frames) / episode.fps
    off = np.abs(episode.timestamps - episode.timestamps[0] - grid) * episode.fps
    if off.max() > _TIME_TOLERANCE_FRAMES:
        steps = np.diff(episode.timestamps)
        raise RejectedInputError(
            "wrong_fps",
            "Frame times do not follow the stated rate",
            where=f"episode {episode.episode_id}",
            expected=f"{episode.fps} fps within {_TIME_TOLERANCE_FRAMES} frames",
            got=f"{off.max():.2f} frames off; median step {np.median(steps) * 1e3:.2f} ms",
            evidence={
                "stated_fps": float(episode.fps),
                "measured_fps": float(1 / np.median(steps)) if len(steps) and np.median(steps) > 0 else None,
                "max_frames_off": float(off.max()),
            },
        )


def check_camera(episode: Episode, camera: CameraTrack) -> None:
    """Raises: RejectedInputError (singular_intrinsics, invalid_extrinsics)."""
    where = f"episode {episode.episode_id}, view {camera.view}"
    check_intrinsics(camera, where)
    camera_pose(camera.view, camera.T_base_camera, where=where)
