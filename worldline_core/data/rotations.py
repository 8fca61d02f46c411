"""Pose formats of foreign recordings as 4x4 matrices (float64, NumPy only)."""

from __future__ import annotations

import numpy as np

from worldline_core.data.rejection import RejectedInputError


def _assemble(position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    pose = np.zeros((*position.shape[:-1], 4, 4))
    pose[..., :3, :3] = rotation
    pose[..., :3, 3] = position
    pose[..., 3, 3] = 1.0
    return pose


def rotation_from_quaternion_wxyz(quaternion: np.ndarray) -> np.ndarray:
    """(..., 4) wxyz, any positive length -> (..., 3, 3).

    Raises: RejectedInputError for a quaternion of no length.
    """
    value = np.asarray(quaternion, dtype=np.float64)
    norm = np.linalg.norm(value, axis=-1, keepdims=True)
    if not np.all(norm > 1e-6):
        raise RejectedInputError(
            "nan_state", "Quaternion has no direction", expected="a unit quaternion", got=float(norm.min())
        )
    w, x, y, z = np.moveaxis(value / norm, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_wxyz(rotation: np.ndarray) -> np.ndarray:
    """(..., 3, 3) -> (..., 4) unit wxyz with w >= 0 (eigenvector of the largest eigenvalue; stable everywhere)."""
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


def pose_from_quaternion_xyzw(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Position (..., 3) [m] and quaternion xyzw -> (..., 4, 4)."""
    return _assemble(np.asarray(position, np.float64), rotation_from_quaternion_wxyz(np.roll(quaternion, 1, axis=-1)))


def pose_from_quaternion_wxyz(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Position (..., 3) [m] and quaternion wxyz -> (..., 4, 4)."""
    return _assemble(np.asarray(position, np.float64), rotation_from_quaternion_wxyz(quaternion))


def pose_from_roll_pitch_yaw(position: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Position [m] and roll, pitch, yaw [rad] about fixed axes (R = Rz Ry Rx) -> (..., 4, 4)."""
    (cr, cp, cy), (sr, sp, sy) = (np.moveaxis(f(np.asarray(angles, np.float64)), -1, 0) for f in (np.cos, np.sin))
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    rotation = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return _assemble(np.asarray(position, np.float64), rotation)
