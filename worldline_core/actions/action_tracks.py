"""From an episode to its action tracks: controls, kinematics and calibration in, projected end-effectors out.

Nothing here looks at a future observation. Tool poses are forward kinematics of the *controls*. The head camera keeps
the pose of the first frame. A wrist camera follows from the controls and its mount (`wrist_camera` of the embodiment);
where a source publishes no mount, either the mount is solved once at the first frame or the recorded extrinsics
are used, and the tracks say so (`camera_motion`).
"""

from __future__ import annotations

from collections import Counter
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from worldline_core.actions.episode_tracks import (
    CAUSES,
    HEAD_VIEW,
    EpisodeTracks,
    TrackBatch,
    WristProjection,
    collate_tracks,
    project_tools,
)
from worldline_core.actions.robot_masks import robot_capsules, tool_capsules
from worldline_core.actions.tracks import ActionTracks
from worldline_core.data.episode import VIEWS, Episode
from worldline_core.errors import CalibrationError, DataError
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.se3 import invert

__all__ = ["ActionTracks", "EpisodeTracks", "TrackBatch", "WristProjection", "collate_tracks", "compute_tracks"]

Controls = Literal["action", "state"]
Fallback = Literal["recorded", "first_frame_mount"]


def compute_tracks(
    episode: Episode,
    kinematics: ArmKinematics | None,
    *,
    controls: Controls = "action",
    without_mount: Fallback = "recorded",
) -> tuple[EpisodeTracks, dict[str, int]]:
    """Tracks of every frame, view and arm of an episode, and counts of what was masked or clipped.

    Args:
        kinematics: of the episode's embodiment; not needed where the source records tool poses.
        controls: whether commands or measured joints are projected.
        without_mount: what a moving wrist camera without a known mount follows.

    Returns:
        Tracks, and counts: samples, valid, behind_camera, outside_image, invalid_calibration, gripper_clipped,
        outside_joint_limits.

    Raises:
        CalibrationError: the episode has no camera at all.
        DataError: its joints do not fit the embodiment, are not finite, or its cameras differ in image size.
    """
    where = f"episode {episode.episode_id}"
    image_size = _image_size(episode, where)
    counts: Counter[str] = Counter()
    wrist_cameras: dict[str, Tensor] = {}
    if episode.T_base_ee is not None:
        T_base_tool = torch.from_numpy(np.asarray(episode.T_base_ee, dtype=np.float64))
        gripper = _recorded_gripper(episode, where)
        capsules, radii = tool_capsules(T_base_tool)
        kind = "ee_pose"
        arms = ("left", "right") if T_base_tool.shape[1] == 2 else tuple(f"arm{i}" for i in range(T_base_tool.shape[1]))
    elif kinematics is not None:
        values = np.asarray(episode.action if controls == "action" else episode.state, dtype=np.float64)
        kinematics.embodiment.check_state(values, where)
        links = kinematics.link_poses(values)
        T_base_tool, gripper = kinematics.tools_of(links), kinematics.gripper(values)
        capsules, radii = robot_capsules(kinematics, links)
        wrist_cameras = kinematics.wrist_cameras_of(links)
        counts["outside_joint_limits"] = int(kinematics.embodiment.outside_limits(values).sum())
        kind = controls
        arms = tuple(arm.name for arm in kinematics.embodiment.arms)
    else:
        raise DataError(
            "Joints without kinematics",
            where=f"{where}, embodiment {episode.embodiment}",
            expected="an embodiment file, or recorded tool poses",
            got="neither",
        )
    counts["gripper_clipped"] = int(((gripper < 0) | (gripper > 1)).sum())
    cameras, motion = _camera_poses(episode, T_base_tool, arms, wrist_cameras, without_mount)
    K = torch.stack([_intrinsics(episode, view) for view in VIEWS])
    seen = project_tools(T_base_tool, gripper, K, cameras, image_size)
    present = torch.tensor([view in episode.cameras for view in VIEWS])
    for number, cause in enumerate(CAUSES):
        counts[cause] = int((seen.cause[:, present] == number).sum())
    counts["samples"] = int(seen.cause[:, present].numel())
    tracks = EpisodeTracks(
        episode_id=episode.episode_id,
        embodiment=episode.embodiment,
        views=VIEWS,
        arms=arms,
        image_size=image_size,
        controls=kind,
        camera_motion=motion,
        valid=seen.valid.numpy(),
        **{name: getattr(seen, name).float().numpy() for name in ("uv", "depth", "rot6d", "gripper")},
        **{
            name: torch.nan_to_num(value).float().numpy()
            for name, value in (
                ("T_base_tool", T_base_tool),
                ("T_base_camera", cameras),
                ("K", K),
                ("capsules", capsules),
                ("capsule_radii", radii),
            )
        },
    )
    return tracks, dict(counts)


def _image_size(episode: Episode, where: str) -> tuple[int, int]:
    sizes = {(camera.height, camera.width) for camera in episode.cameras.values()}
    if not sizes:
        raise CalibrationError(
            "Episode has no calibrated camera", where=where, expected="K and T_base_camera a view", got="none"
        )
    if len(sizes) > 1:
        raise DataError(
            "Views differ in image size", where=where, expected="one size in an EpisodeSet", got=sorted(sizes)
        )
    return sizes.pop()


def _recorded_gripper(episode: Episode, where: str) -> Tensor:
    if episode.gripper is None:
        raise DataError(
            "Tool poses without gripper openings", where=where, expected="gripper (N, A), 0 closed .. 1 open"
        )
    return torch.from_numpy(np.asarray(episode.gripper, dtype=np.float64))


def _intrinsics(episode: Episode, view: str) -> Tensor:
    """K of a view; zeros (which no camera has, so that nothing is valid) where the episode lacks it."""
    camera = episode.cameras.get(view)
    return (
        torch.zeros(3, 3, dtype=torch.float64) if camera is None else torch.from_numpy(np.asarray(camera.K, np.float64))
    )


def _camera_poses(
    episode: Episode, T_base_tool: Tensor, arms: tuple[str, ...], from_kinematics: dict[str, Tensor], fallback: Fallback
) -> tuple[Tensor, tuple[str, ...]]:
    """T_base_camera (n, v, 4, 4) and where each view's poses come from."""
    num_frames = len(T_base_tool)
    poses, motion = [], []
    for view in VIEWS:
        camera = episode.cameras.get(view)
        if camera is None:
            poses.append(torch.eye(4, dtype=torch.float64).expand(num_frames, 4, 4))
            motion.append("absent")
            continue
        recorded = torch.from_numpy(np.asarray(camera.T_base_camera, dtype=np.float64))
        arm = view.removesuffix("_wrist")
        if view == HEAD_VIEW or (not camera.moving and view not in from_kinematics):
            poses.append(recorded[:1].expand(num_frames, 4, 4))
            motion.append("static")
        elif view in from_kinematics:
            poses.append(from_kinematics[view])
            motion.append("kinematics")
        elif fallback == "first_frame_mount" and arm in arms:
            tools = T_base_tool[:, arms.index(arm)]
            poses.append(tools @ (invert(tools[0]) @ recorded[0]))
            motion.append("first_frame_mount")
        else:
            poses.append(recorded)
            motion.append("recorded")
    return torch.stack(poses, dim=1), tuple(motion)
