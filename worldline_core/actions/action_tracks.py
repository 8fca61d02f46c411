"""Action rendering: from an episode's controls to its action tracks, the projected end-effectors (paper, "Action rendering").

Nothing here looks at a future observation. Tool poses are forward kinematics of the *controls*. The head camera keeps
the pose of the first frame. A wrist camera follows from the controls and its mount (`wrist_camera` of the embodiment);
where a source publishes no mount, either the mount is solved once at the first frame or the recorded extrinsics
are used, and the tracks say so (`camera_motion`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from worldline_core.actions.episode_tracks import HEAD_VIEW, EpisodeTracks
from worldline_core.actions.robot_masks import robot_capsules, tool_capsules
from worldline_core.actions.tool_projection import Projection, TrackCounts, count_samples, project_tools
from worldline_core.data.episodes.episode import VIEWS, Episode
from worldline_core.errors import CalibrationError, DataError
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import invert, is_rigid

Controls = Literal["action", "state"]
Fallback = Literal["recorded", "first_frame_mount"]


def compute_tracks(
    episode: Episode,
    kinematics: ArmKinematics | None,
    *,
    controls: Controls = "action",
    without_mount: Fallback = "recorded",
) -> tuple[EpisodeTracks, TrackCounts]:
    """Tracks of every frame, view and arm of an episode, and counts of what was masked or clipped.

    An unusable camera (a singular K, a pose that is not rigid) masks the samples of its view and is counted; controls
    that are not finite refuse the episode, whether they are joints or recorded tool poses.

    Args:
        kinematics: of the episode's embodiment; not needed where the source records tool poses.
        controls: whether commands or measured joints are projected.
        without_mount: what a moving wrist camera without a known mount follows.

    Raises:
        CalibrationError: the episode has no camera at all.
        DataError: its joints do not fit the embodiment or are not finite; its recorded tool poses are not rigid or
            lack openings; its cameras differ in image size.
    """
    where = f"episode {episode.episode_id}"
    image_size = _image_size(episode, where)
    outside_limits = 0
    wrist_cameras: dict[str, Tensor] = {}
    if episode.T_base_ee is not None:
        T_base_tool = _recorded_tools(episode.T_base_ee, where)
        gripper = _recorded_gripper(episode.gripper, T_base_tool.shape[:2], where)
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
        outside_limits = int(kinematics.embodiment.outside_limits(values).sum())
        kind = controls
        arms = tuple(arm.name for arm in kinematics.embodiment.arms)
    else:
        raise DataError(
            "Joints without kinematics",
            where=f"{where}, embodiment {episode.embodiment}",
            expected="an embodiment file, or recorded tool poses",
            got="neither",
        )
    cameras, motion = _camera_poses(episode, T_base_tool, arms, wrist_cameras, without_mount)
    K = torch.stack([_intrinsics(episode, view) for view in VIEWS])
    seen = project_tools(T_base_tool, gripper, K, cameras, image_size)
    tracks = tracks_of_projection(
        episode, seen, T_base_tool, cameras, K, capsules, radii,
        views=VIEWS, arms=arms, image_size=image_size, controls=kind, camera_motion=motion,
    )  # fmt: skip
    present = [number for number, view in enumerate(VIEWS) if view in episode.cameras]
    return tracks, count_samples(seen.cause[:, present], gripper, arms, outside_limits)


def tracks_of_projection(
    episode: Episode,
    seen: Projection,
    T_base_tool: Tensor,
    T_base_camera: Tensor,
    K: Tensor,
    capsules: Tensor,
    capsule_radii: Tensor,
    *,
    views: Sequence[str],
    arms: Sequence[str],
    image_size: tuple[int, int],
    controls: str,
    camera_motion: Sequence[str],
) -> EpisodeTracks:
    """What was projected, in the types that tracks are stored in (float32, uv float64); unknown poses become zeros."""
    return EpisodeTracks(
        episode_id=episode.episode_id,
        embodiment=episode.embodiment,
        views=tuple(views),
        arms=tuple(arms),
        image_size=image_size,
        controls=controls,
        camera_motion=tuple(camera_motion),
        uv=seen.uv.numpy(),
        valid=seen.valid.numpy(),
        depth=seen.depth.float().numpy(),
        rot6d=seen.rot6d.float().numpy(),
        gripper=seen.gripper.float().numpy(),
        T_base_tool=_stored(T_base_tool),
        T_base_camera=_stored(T_base_camera),
        K=_stored(K),
        capsules=_stored(capsules),
        capsule_radii=_stored(capsule_radii),
    )


def _stored(value: Tensor) -> np.ndarray:
    return torch.nan_to_num(value).float().numpy()


def _image_size(episode: Episode, where: str) -> tuple[int, int]:
    sizes = {(camera.height, camera.width) for camera in episode.cameras.values()}
    if not sizes:
        raise CalibrationError(
            "Episode has no calibrated camera", where=where, expected="K and T_base_camera per view", got="none"
        )
    if len(sizes) > 1:
        raise DataError(
            "Views differ in image size", where=where, expected="one size in an EpisodeSet", got=sorted(sizes)
        )
    return sizes.pop()


def _recorded_tools(recorded: np.ndarray, where: str) -> Tensor:
    poses = torch.from_numpy(np.asarray(recorded, dtype=np.float64))
    bad = torch.nonzero(~is_rigid(poses))
    if len(bad):
        frame, arm = bad[0].tolist()
        raise DataError(
            "Recorded tool poses are not finite, or not rigid transforms",
            where=f"{where}, frame {frame}, arm {arm}",
            expected="R R^T = I, det R = 1, last row 0 0 0 1",
            got=f"{len(bad)} bad, the first {poses[frame, arm].tolist()}",
        )
    return poses


def _recorded_gripper(recorded: np.ndarray | None, shape: tuple[int, ...], where: str) -> Tensor:
    opening = None if recorded is None else np.asarray(recorded, dtype=np.float64)
    if opening is None or opening.shape != shape:
        raise DataError(
            "Tool poses without gripper openings",
            where=where,
            expected=f"gripper {tuple(shape)} (frames, arms), 0 closed .. 1 open",
            got=None if opening is None else opening.shape,
        )
    if not np.isfinite(opening).all():
        frame, arm = np.argwhere(~np.isfinite(opening))[0]
        raise DataError(
            "Gripper openings are not finite",
            where=f"{where}, frame {frame}, arm {arm}",
            expected="0 closed .. 1 open",
            got=float(opening[frame, arm]),
        )
    return torch.from_numpy(opening)


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
