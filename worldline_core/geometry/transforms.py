"""Rigid transforms as 4x4 matrices, and rotations in other forms. NumPy, float64: recordings are read with these.

`T_a_b` maps points given in frame b to frame a, so `T_a_c = T_a_b @ T_b_c`. Every name of a rotation gives its order:
quaternions `_wxyz` or `_xyzw`; Euler angles (about x, y, z, radians) about *fixed* axes, R = Rz Ry Rx (URDF's roll pitch
yaw), or about *moving* axes, R = Rx Ry Rz. Rot6D is a rotation as its first two columns (Zhou et al., CVPR 2019, "On the
Continuity of Rotation Representations"), column x, then column y: `[R00, R10, R20, R01, R11, R21]`. With gradients:
`tensor_transforms`.

The formulas are written out because scipy's `Rotation` rounds the last bit differently, which would change the digest
of every track and curated pose, and refuses the mirrored matrices that some recordings hold.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from worldline_core.errors import CalibrationError

MIN_QUATERNION_NORM = 1e-6
"""A shorter quaternion has no direction; longer ones are normalised."""


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
    return _matrix(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotation_from_quaternion_xyzw(quaternion: np.ndarray) -> np.ndarray:
    """(..., 4) xyzw, any positive length -> (..., 3, 3); raises as `rotation_from_quaternion_wxyz`."""
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
    quaternion = np.linalg.eigh(k).eigenvectors[..., -1]
    return quaternion * np.where(quaternion[..., :1] < 0, -1.0, 1.0)


def quaternion_xyzw_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """(..., 3, 3) -> (..., 4) unit xyzw with w >= 0."""
    return np.roll(quaternion_wxyz_from_rotation(rotation), -1, axis=-1)


def rotation_from_euler_fixed_xyz(angles: np.ndarray) -> np.ndarray:
    """Angles (..., 3) [rad] about fixed x, then y, then z (roll, pitch, yaw) -> (..., 3, 3): R = Rz Ry Rx."""
    (cr, cp, cy), (sr, sp, sy) = (np.moveaxis(f(np.asarray(angles, np.float64)), -1, 0) for f in (np.cos, np.sin))
    return _matrix(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rotation_from_euler_moving_xyz(angles: np.ndarray) -> np.ndarray:
    """Angles (..., 3) [rad] about moving x, then y, then z -> (..., 3, 3): R = Rx Ry Rz."""
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


def rotation_about_axis(axis: np.ndarray, angle: float) -> np.ndarray:
    """(3, 3) rotation by an angle [rad] about an axis (3,) of any length (Rodrigues); the identity for a zero axis."""
    length = float(np.linalg.norm(axis))
    if length < 1e-15:
        return np.eye(3)
    x, y, z = axis / length
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * skew + (1 - math.cos(angle)) * (skew @ skew)


def rotation_from_rot6d(rot6d: np.ndarray) -> np.ndarray:
    """(..., 6) -> (..., 3, 3) by Gram-Schmidt: exact for Rot6D of a rotation, else the frame whose x is the first
    column's direction.

    Raises: CalibrationError when the two columns span no plane (one is zero or not finite, or they are parallel).
    """
    value = np.asarray(rot6d, dtype=np.float64)
    x, y = value[..., :3], value[..., 3:]
    bad = ~(np.linalg.norm(np.cross(x, y), axis=-1) > 1e-9)
    if bad.any():
        raise CalibrationError(
            "Rot6D spans no frame: a column is zero, not finite, or parallel to the other",
            expected="two columns that are not parallel",
            got=f"{int(bad.sum())} of {bad.size} such",
        )
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    y = y - (x * y).sum(axis=-1, keepdims=True) * x
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], axis=-1)


def rotation_angle(rotation: np.ndarray) -> np.ndarray:
    """(...,) angles [rad], 0..pi, of rotations (..., 3, 3); accurate at both ends."""
    cosine = (np.trace(rotation, axis1=-2, axis2=-1) - 1) / 2
    x = rotation[..., 2, 1] - rotation[..., 1, 2]
    y = rotation[..., 0, 2] - rotation[..., 2, 0]
    z = rotation[..., 1, 0] - rotation[..., 0, 1]
    return np.arctan2(0.5 * np.sqrt(x * x + y * y + z * z), cosine)


def rotation_angle_deg(rotation: np.ndarray) -> np.ndarray:
    """(...,) angles [deg], 0..180, of rotations (..., 3, 3)."""
    return np.degrees(rotation_angle(rotation))


def rotation_deviation(rotation: np.ndarray) -> np.ndarray:
    """(...,) largest entry of |R R^T - I| of matrices (..., 3, 3); infinite for a mirrored or not finite one."""
    known = np.nan_to_num(rotation)
    deviation = np.abs(known @ np.swapaxes(known, -1, -2) - np.eye(3)).max(axis=(-2, -1))
    usable = np.isfinite(rotation).all(axis=(-2, -1)) & (np.linalg.det(known) > 0)
    return np.where(usable, deviation, np.inf)


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotations nearest to matrices (..., 3, 3) in the Frobenius norm (orthogonal Procrustes, by SVD)."""
    u, _, vt = np.linalg.svd(matrix)
    u[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt


def reread_as_wxyz(rotation: np.ndarray) -> np.ndarray:
    """The true rotations (..., 3, 3) where a quaternion was written wxyz and read as xyzw."""
    return rotation_from_quaternion_wxyz(quaternion_xyzw_from_rotation(rotation))


def reread_as_moving(rotation: np.ndarray) -> np.ndarray:
    """The true rotations (..., 3, 3) where Euler angles about moving axes were read as angles about fixed ones.

    At pitch = +-90 degrees the angles are not unique and the result is one of several.
    """
    return rotation_from_euler_moving_xyz(euler_fixed_xyz_from_rotation(rotation))


def _matrix(rows: list[list[np.ndarray]]) -> np.ndarray:
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


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
    """Position (..., 3) [m] and quaternion xyzw -> (..., 4, 4); raises as `rotation_from_quaternion_wxyz`."""
    return pose_from_rotation(position, rotation_from_quaternion_xyzw(quaternion))


def pose_from_quaternion_wxyz(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Position (..., 3) [m] and quaternion wxyz -> (..., 4, 4); raises as `rotation_from_quaternion_wxyz`."""
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
    """Lengths (...) of vectors (..., k): np.linalg.norm takes up to ten times as long for the same bits."""
    squares = vectors * vectors
    return np.sqrt(sum((squares[..., k] for k in range(1, squares.shape[-1])), squares[..., 0]))


@dataclass(frozen=True)
class RotationRepair:
    """Number of poses that were given the nearest rotation, and the largest deviation among them."""

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
    """Deviation of a wrist camera from a fixed mount on its tool.

    Returns: mean T_tool_camera (4, 4); deviations (n,) [m] and (n,) [deg] from it.
    """
    T_tool_camera = rigid_inverse(T_base_tool) @ T_base_camera
    mount = mean_pose(T_tool_camera)
    apart = rigid_inverse(mount)[None] @ T_tool_camera
    return mount, lengths(T_tool_camera[:, :3, 3] - mount[:3, 3]), rotation_angle_deg(apart[:, :3, :3])
