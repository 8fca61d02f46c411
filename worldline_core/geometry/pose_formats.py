"""Rotations and poses as recordings write them (quaternions, Euler angles) and as matrices. NumPy, float64.

Every name says its order: quaternions `_wxyz` or `_xyzw`; Euler angles (about x, y, z, radians) about *fixed* axes,
R = Rz Ry Rx (URDF's roll pitch yaw), or about *moving* axes, R = Rx Ry Rz. The differentiable quaternion is in `se3`.
"""

from __future__ import annotations

import numpy as np

from worldline_core.errors import CalibrationError

MIN_QUATERNION_NORM = 1e-6
"""A shorter quaternion has no direction; longer ones are normalised."""


def pose_from_rotation(position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Position (..., 3) and rotation (..., 3, 3) -> (..., 4, 4) float64."""
    place = np.asarray(position, dtype=np.float64)
    pose = np.zeros((*place.shape[:-1], 4, 4))
    pose[..., :3, :3] = rotation
    pose[..., :3, 3] = place
    pose[..., 3, 3] = 1.0
    return pose


def rotation_from_quaternion_wxyz(quaternion: np.ndarray) -> np.ndarray:
    """(..., 4) wxyz, any positive length -> (..., 3, 3).

    Raises: CalibrationError for a quaternion of no length, or one that is not finite.
    """
    value = np.asarray(quaternion, dtype=np.float64)
    norm = np.linalg.norm(value, axis=-1, keepdims=True)
    bad = ~(np.isfinite(norm[..., 0]) & (norm[..., 0] > MIN_QUATERNION_NORM))
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise CalibrationError(
            "Quaternion has no direction",
            where=f"entry {', '.join(map(str, first))}" if first else None,
            expected="a unit quaternion",
            got=f"{value[first].tolist()}; {int(bad.sum())} of {bad.size} such",
            next_step="check whether the pose was never written, or the columns are others",
        )
    w, x, y, z = np.moveaxis(value / norm, -1, 0)
    return _stacked(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotation_from_quaternion_xyzw(quaternion: np.ndarray) -> np.ndarray:
    """(..., 4) xyzw, any positive length -> (..., 3, 3).

    Raises: CalibrationError for a quaternion of no length, or one that is not finite.
    """
    return rotation_from_quaternion_wxyz(np.roll(quaternion, 1, axis=-1))


def quaternion_wxyz_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """(..., 3, 3) -> (..., 4) unit wxyz with w >= 0: eigenvector of the largest eigenvalue, stable everywhere."""
    m = np.asarray(rotation, dtype=np.float64)
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    k = np.zeros((*m.shape[:-2], 4, 4))
    k[..., 0, 0] = xx + yy + zz
    k[..., 1, 1], k[..., 2, 2], k[..., 3, 3] = xx - yy - zz, yy - xx - zz, zz - xx - yy
    k[..., 0, 1] = k[..., 1, 0] = m[..., 2, 1] - m[..., 1, 2]
    k[..., 0, 2] = k[..., 2, 0] = m[..., 0, 2] - m[..., 2, 0]
    k[..., 0, 3] = k[..., 3, 0] = m[..., 1, 0] - m[..., 0, 1]
    k[..., 1, 2] = k[..., 2, 1] = m[..., 1, 0] + m[..., 0, 1]
    k[..., 1, 3] = k[..., 3, 1] = m[..., 0, 2] + m[..., 2, 0]
    k[..., 2, 3] = k[..., 3, 2] = m[..., 2, 1] + m[..., 1, 2]
    _, vectors = np.linalg.eigh(k)
    quaternion = vectors[..., -1]
    sign = np.where(quaternion[..., :1] < 0, -1.0, 1.0)
    return quaternion * sign


def quaternion_xyzw_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """(..., 3, 3) -> (..., 4) unit xyzw with w >= 0."""
    return np.roll(quaternion_wxyz_from_rotation(rotation), -1, axis=-1)


def rotation_from_euler_fixed_xyz(angles: np.ndarray) -> np.ndarray:
    """Angles (..., 3) [rad] about fixed x, then y, then z (roll, pitch, yaw): R = Rz Ry Rx."""
    (cr, cp, cy), (sr, sp, sy) = (np.moveaxis(f(np.asarray(angles, np.float64)), -1, 0) for f in (np.cos, np.sin))
    return _stacked(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rotation_from_euler_moving_xyz(angles: np.ndarray) -> np.ndarray:
    """Angles (..., 3) [rad] about moving x, then y, then z: R = Rx Ry Rz."""
    # Turning about moving axes is turning about fixed ones in the opposite order, hence the transpose of the negative.
    return np.swapaxes(rotation_from_euler_fixed_xyz(-np.asarray(angles, np.float64)), -1, -2)


def euler_fixed_xyz_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """(..., 3, 3) -> angles (..., 3) [rad] about fixed axes; pitch in -pi/2..pi/2, and roll 0 where it is +-pi/2."""
    m = np.asarray(rotation, dtype=np.float64)
    across = np.hypot(m[..., 0, 0], m[..., 1, 0])
    pitch = np.arctan2(-m[..., 2, 0], across)
    # With the pitch at a right angle only yaw - roll (or their sum) exists: all of it is called yaw.
    locked = across < 1e-9
    roll = np.where(locked, 0.0, np.arctan2(m[..., 2, 1], m[..., 2, 2]))
    yaw = np.where(locked, np.arctan2(-m[..., 0, 1], m[..., 1, 1]), np.arctan2(m[..., 1, 0], m[..., 0, 0]))
    return np.stack([roll, pitch, yaw], axis=-1)


def euler_moving_xyz_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """(..., 3, 3) -> angles (..., 3) [rad] about moving axes; the second in -pi/2..pi/2."""
    return -euler_fixed_xyz_from_rotation(np.swapaxes(np.asarray(rotation, np.float64), -1, -2))


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


def pose_from_euler_moving_xyz(position: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Position (..., 3) [m] and angles [rad] about moving x, y, z -> (..., 4, 4)."""
    return pose_from_rotation(position, rotation_from_euler_moving_xyz(angles))


def _stacked(rows: list[list[np.ndarray]]) -> np.ndarray:
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def reread_as_wxyz(rotation: np.ndarray) -> np.ndarray:
    """What rotations (..., 3, 3) are whose quaternion was read as xyzw while it was written wxyz."""
    return rotation_from_quaternion_wxyz(quaternion_xyzw_from_rotation(rotation))


def written_as_wxyz(rotation: np.ndarray) -> np.ndarray:
    """What rotations (..., 3, 3) become when they are written wxyz and read as xyzw."""
    return rotation_from_quaternion_xyzw(quaternion_wxyz_from_rotation(rotation))


def reread_as_moving(rotation: np.ndarray) -> np.ndarray:
    """What rotations (..., 3, 3) are whose Euler angles were read about fixed axes while they were about moving ones.

    At pitch = +-90 degrees the angles are not unique and the result is one of several.
    """
    return rotation_from_euler_moving_xyz(euler_fixed_xyz_from_rotation(rotation))


def written_as_moving(rotation: np.ndarray) -> np.ndarray:
    """What rotations (..., 3, 3) become when their angles are written about moving axes and read about fixed ones."""
    return rotation_from_euler_fixed_xyz(euler_moving_xyz_from_rotation(rotation))
