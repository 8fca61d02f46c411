"""What an episode must satisfy to enter an EpisodeSet; each failure has its reason code and its numbers."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from worldline_core.data.episodes.episode import TRAINING_SPLITS, CameraTrack, Episode
from worldline_core.data.episodes.recorded_poses import camera_pose, check_intrinsics
from worldline_core.data.episodes.source import EVALUATION_LAYOUTS, EVALUATION_ONLY, says_droid
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.errors import ConfigError

if TYPE_CHECKING:
    from worldline_core.geometry.embodiment import Embodiment

MAX_JOINT_RAD = 4 * np.pi
"""No joint of a manipulator turns further; larger numbers are degrees or encoder ticks."""
_GRIPPER_MARGIN = 0.05


def check_split(episode: Episode) -> None:
    """Raises: ConfigError when an episode for evaluation only is given a split that trains or selects a model.

    For evaluation only are episodes of an evaluation-only layout, those declared so, and any whose source or robot is
    called DROID. The layout is noted in the episode, so a set made of such recordings earlier is refused as well.
    """
    layout = episode.conventions.get("layout")
    called = says_droid(episode.source, episode.embodiment)
    kept_out = called or layout in EVALUATION_LAYOUTS or EVALUATION_ONLY in episode.conventions
    if kept_out and episode.split in TRAINING_SPLITS:
        raise ConfigError(
            "Recordings for evaluation only were assigned to training",
            where=f"episode {episode.episode_id}, scene {episode.scene} ({layout})",
            expected="split test or ood_test",
            got=episode.split,
            next_step="change the source's split or curate.splits; what is not DROID must not be called so",
        )


def check_values(episode: Episode) -> None:
    """Raises: RejectedInputError (nan_state) when a state, action, time or pose is not a finite number."""
    tracks = {"state": episode.state, "action": episode.action, "timestamps": episode.timestamps}
    if episode.T_base_ee is not None:
        tracks["T_base_ee"] = episode.T_base_ee
    for name, values in tracks.items():
        bad = ~np.isfinite(values)
        if bad.any():
            frame = int(np.argwhere(bad)[0][0])
            raise RejectedInputError(
                "nan_state",
                f"{name} is not finite",
                where=f"episode {episode.episode_id}, frame {frame}",
                expected="finite numbers",
                got=f"{int(bad.sum())} values that are not",
                evidence={"track": name, "first_frame": frame, "values": int(bad.sum())},
            )


def check_joints(episode: Episode, tolerance_rad: float) -> bool:
    """Compare joints with the embodiment's limits; returns whether its limits are known.

    Raises: RejectedInputError (joint_out_of_range, invalid_gripper, length_mismatch).
    """
    if episode.state_kind != "joints":
        return False
    names = episode.state_names or ()
    joints = [i for i in range(episode.state.shape[1]) if i >= len(names) or not names[i].endswith("gripper")]
    worst = float(np.abs(episode.state[:, joints]).max()) if joints else 0.0
    if worst > MAX_JOINT_RAD:
        raise RejectedInputError(
            "joint_out_of_range",
            "Joint positions are no angles in radians",
            where=f"episode {episode.episode_id}",
            expected=f"at most {MAX_JOINT_RAD:.2f} rad",
            got=worst,
            next_step="declare the unit of the source",
            evidence={"max_abs_rad": worst},
        )
    embodiment = _embodiment(episode.embodiment)
    if embodiment is None:
        return False
    if embodiment.state_size != episode.state.shape[1]:
        raise RejectedInputError(
            "length_mismatch",
            "State has another size than the embodiment",
            where=f"episode {episode.episode_id}, {episode.embodiment}",
            expected=embodiment.state_size,
            got=episode.state.shape[1],
            evidence={"expected": embodiment.state_size, "found": int(episode.state.shape[1])},
        )
    outside = embodiment.outside_limits(episode.state, tolerance_rad)
    if outside.any():
        frame, column = (int(value) for value in np.argwhere(outside)[0])
        raise RejectedInputError(
            "joint_out_of_range",
            "Joint position is beyond its limit",
            where=f"episode {episode.episode_id}, frame {frame}, {embodiment.state_names[column]}",
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
            where=f"episode {episode.episode_id}",
            expected="0..1",
            got=f"{opening.min():.3f}..{opening.max():.3f}",
            evidence={"min": float(opening.min()), "max": float(opening.max())},
        )
    return True


@lru_cache(maxsize=32)
def _embodiment(name: str) -> Embodiment | None:
    """None where it is not known. Read once: parsing takes as long as decoding a hundred frames."""
    from worldline_core.geometry.embodiment import embodiment_names, load_embodiment

    return load_embodiment(name) if name in embodiment_names() else None


def check_times(episode: Episode, tolerance: float) -> None:
    """Raises: RejectedInputError (wrong_fps) when frame times leave the grid of the stated rate.

    Args:
        tolerance: largest distance of a frame from its place on the grid, in frames.
    """
    grid = np.arange(episode.num_frames) / episode.fps
    off = np.abs(episode.timestamps - episode.timestamps[0] - grid) * episode.fps
    if off.max() > tolerance:
        steps = np.diff(episode.timestamps)
        raise RejectedInputError(
            "wrong_fps",
            "Frame times do not follow the stated rate",
            where=f"episode {episode.episode_id}",
            expected=f"{episode.fps} fps within {tolerance} frames",
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


def stride_to(episode: Episode, fps: float | None) -> int:
    """The stride that brings an episode to the wanted rate.

    Raises: RejectedInputError (wrong_fps) when the recorded rate is no whole multiple of it.
    """
    if fps is None:
        return 1
    ratio = episode.fps / fps
    step = round(ratio)
    if step < 1 or abs(ratio - step) > 1e-2:
        raise RejectedInputError(
            "wrong_fps",
            "Recorded rate is no whole multiple of the wanted one",
            where=f"episode {episode.episode_id}",
            expected=f"a multiple of {fps} fps",
            got=f"{episode.fps} fps",
            next_step="set curate.fps to a divisor of the recorded rate, or to null to keep it",
            evidence={"wanted_fps": float(fps), "recorded_fps": float(episode.fps)},
        )
    return step
