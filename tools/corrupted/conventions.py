"""Healthy episodes as a source with other conventions would hand them over: the reverse of repairing them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from worldline_core.data.episodes.conventions import (
    RecordedConventions,
    along_tool_z,
    check_applicable,
    exchange_arms,
    frames_with_all,
    invert_gripper,
    pose_columns,
    rotated,
    scale_joints,
    scaled,
    shift,
    source_offset,
    turned,
)
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.geometry.cameras import OPENGL_AXES
from worldline_core.geometry.transforms import (
    euler_fixed_xyz_from_rotation,
    quaternion_wxyz_from_rotation,
    rigid_inverse,
    rotation_from_euler_fixed_xyz,
    rotation_from_quaternion_xyzw,
)


def corrupt(episode: Episode, conventions: RecordedConventions) -> Episode:
    """The reverse of `apply_conventions`: a healthy episode as a source with these conventions would hand it over, read as
    the contract.

    `apply_conventions(corrupt(e, c), c)` is e, up to rounding and to the frames that a lag loses at the ends;
    `corrupted_image_frames` says which images go with it.

    Raises: RejectedInputError as `apply_conventions`.
    """
    check_applicable(episode, conventions.departures)
    if conventions.gripper == "inverted":
        episode = invert_gripper(episode)
    if conventions.arms == "exchanged":
        episode = exchange_arms(episode)
    scale = 1e3 if conventions.pose_unit == "mm" else 1.0
    if {"pose_unit", "quaternion", "euler"} & set(conventions.departures):
        episode = pose_columns(episode, scale, lambda xyzw: _written(xyzw, conventions))
    offset = source_offset(episode)
    poses = episode.T_base_ee
    if poses is not None:
        poses = along_tool_z(poses, -offset - conventions.tool_offset_z_m)
        if conventions.euler == "moving_xyz":
            poses = rotated(poses, written_as_moving(poses[..., :3, :3]))
        if conventions.quaternion == "wxyz":
            poses = rotated(poses, written_as_wxyz(poses[..., :3, :3]))
        episode = replace(episode, T_base_ee=along_tool_z(scaled(poses, scale), offset))
    if conventions.angle_unit == "deg":
        episode = scale_joints(episode, 180 / np.pi)
    episode = replace(episode, cameras={v: _corrupt_camera(c, conventions) for v, c in episode.cameras.items()})
    return shift(episode, _backwards(conventions))


def corrupted_image_frames(num_frames: int, conventions: RecordedConventions, view: str) -> slice:
    """Images of a healthy episode's view that belong to the frames of `corrupt(episode, conventions)`, in order."""
    first, last = frames_with_all(num_frames, _backwards(conventions))
    return slice(first - conventions.image_lag(view), last - conventions.image_lag(view))


def _backwards(conventions: RecordedConventions) -> RecordedConventions:
    return RecordedConventions(
        camera_lag_frames=-conventions.camera_lag_frames, image_lag_frames=-conventions.image_lag_frames
    )


def _written(xyzw: np.ndarray, conventions: RecordedConventions) -> np.ndarray:
    if conventions.euler == "moving_xyz":
        xyzw = turned(xyzw, written_as_moving)
    return np.roll(xyzw, 1, axis=-1) if conventions.quaternion == "wxyz" else xyzw


def _corrupt_camera(camera: CameraTrack, conventions: RecordedConventions) -> CameraTrack:
    if conventions.views is not None and camera.view not in conventions.views:
        return camera
    K = camera.K
    if conventions.intrinsics_size is not None:
        height, width = conventions.intrinsics_size
        K = camera.resized(width, height).K
    poses = camera.T_base_camera
    poses = poses @ OPENGL_AXES if conventions.camera_axes == "opengl" else poses
    poses = rigid_inverse(poses) if conventions.extrinsics == "base_to_camera" else poses
    return replace(camera, K=K, T_base_camera=scaled(poses, 1e3 if conventions.extrinsics_unit == "mm" else 1.0))


def written_as_wxyz(rotation: np.ndarray) -> np.ndarray:
    """Rotations (..., 3, 3) after they are written wxyz and read as xyzw."""
    return rotation_from_quaternion_xyzw(quaternion_wxyz_from_rotation(rotation))


def written_as_moving(rotation: np.ndarray) -> np.ndarray:
    """Rotations (..., 3, 3) after their angles are written about moving axes and read about fixed ones."""
    moving = -euler_fixed_xyz_from_rotation(np.swapaxes(rotation, -1, -2))
    return rotation_from_euler_fixed_xyz(moving)
