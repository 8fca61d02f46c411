"""Rigid transforms as 4x4 matrices.

`T_a_b` maps points given in frame b to frame a, so `T_a_c = T_a_b @ T_b_c`. NumPy, float64: recordings are read and
measured with these. With gradients: `tensor_transforms`. Rotations in other forms: `rotations`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from worldline_core.errors import CalibrationError
from worldline_core.geometry.rotations import (
    nearest_rotation,
    rotation_angle_deg,
    rotation_deviation,
    rotation_from_euler_fixed_xyz,
    rotation_from_quaternion_wxyz,
    rotation_from_quaternion_xyzw,
)

MAX_ROTATION_DEVIATION = 1e-3
"""A recorded rotation with R R^T further from the identity (largest entry) is refused, not repaired."""
ROTATION_ROUNDING = 1e-6
"""Up to here a deviation is the rounding of float32 storage: left as it is, and not reported."""


def pose_from_rotation(position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Position (..., 3) and rotation (..., 3, 3) -> (..., 4, 4) float64."""
    place = np.asarray(position, dtype=np.float64)
    pose = np.zeros((*place.shape[:-1], 4, 4))
    pose[..., :3, :3] = rotation
    pose[..., :3, 3] = place
    pose[..., 3, 3] = 1.0
    return pose


def pose_from_quaternion_xyzw(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Position (..., 3) [m] and quaternion xyzw -> (..., 4, 4).

    Raises: CalibrationError for a quaternion of no length.
    """
    return pose_from_rotation(position, rotation_from_quaternion_xyzw(quaternion))


def pose_from_quaternion_wxyz(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Position (..., 3) [m] and quaternion wxyz -> (..., 4, 4).

    Raises: CalibrationError for a quaternion of no length.
    """
    return pose_from_rotation(position, rotation_from_quaternion_wxyz(quaternion))


def pose_from_euler_fixed_xyz(position: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Position (..., 3) [m] and roll, pitch, yaw [rad] about fixed axes -> (..., 4, 4)."""
    return pose_from_rotation(position, rotation_from_euler_fixed_xyz(angles))


def rigid_inverse(pose: np.ndarray) -> np.ndarray:
    """T_b_a from T_a_b (..., 4, 4), by the transpose of the rotation."""
    result = np.zeros_like(pose)
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -(rotation @ pose[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def lengths(vectors: np.ndarray) -> np.ndarray:
    """Of vectors (..., k): (...). np.linalg.norm adds along this short axis: up to ten times as long, for the same bits."""
    first, *others = np.moveaxis(vectors * vectors, -1, 0)
    return np.sqrt(sum(others, first))


@dataclass(frozen=True)
class RotationRepair:
    """How many of the poses were given the nearest rotation, and the largest deviation among them."""

    count: int
    largest: float


def repair_rotations(poses: np.ndarray, where: object) -> tuple[np.ndarray, RotationRepair]:
    """Recorded poses (..., 4, 4) made rigid: the nearest rotation for each that is off by 1e-6 .. 1e-3.

    Returns: the poses (the same array when none is off) and how many were changed.

    Raises: CalibrationError when a pose is not finite, mirrored, further off, or its last row is not 0 0 0 1.
    """
    deviation = rotation_deviation(poses[..., :3, :3])
    known = np.isfinite(poses[..., :3, 3]).all(axis=-1) & (np.abs(poses[..., 3, :] - [0, 0, 0, 1]) < 1e-6).all(axis=-1)
    bad = ~(known & (deviation <= MAX_ROTATION_DEVIATION))
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise CalibrationError(
            "Not a rigid transform: the rotation is not orthonormal and right-handed, or not finite",
            where=f"{where}, frame {first[0]}" if first else where,
            expected=f"R R^T = I within {MAX_ROTATION_DEVIATION:g}, det R = 1, last row 0 0 0 1",
            got=f"deviation {deviation[first]:.3g}, {int(bad.sum())} of {bad.size} poses refused; {poses[first].tolist()}",
            next_step="check whether the matrix is transposed, scaled, or stored in another layout",
        )
    off = deviation > ROTATION_ROUNDING
    if not off.any():
        return poses, RotationRepair(0, 0.0)
    repaired = np.array(poses, dtype=np.float64)
    repaired[off, :3, :3] = nearest_rotation(repaired[off, :3, :3])
    return repaired, RotationRepair(int(off.sum()), float(deviation[off].max()))


def mean_pose(poses: np.ndarray) -> np.ndarray:
    """(4, 4) with the median position and the chordal mean rotation of (n, 4, 4)."""
    return pose_from_rotation(np.median(poses[:, :3, 3], axis=0), nearest_rotation(poses[:, :3, :3].mean(axis=0)))


def hand_eye_residual(T_base_tool: np.ndarray, T_base_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far a wrist camera is from being fixed to its tool.

    Returns: mean T_tool_camera (4, 4); deviations (n,) [m] and (n,) [deg] from it.
    """
    T_tool_camera = rigid_inverse(T_base_tool) @ T_base_camera
    mount = mean_pose(T_tool_camera)
    apart = rigid_inverse(mount)[None] @ T_tool_camera
    return mount, np.linalg.norm(T_tool_camera[:, :3, 3] - mount[:3, 3], axis=1), rotation_angle_deg(apart[:, :3, :3])
