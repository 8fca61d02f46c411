"""Rigid transforms and pinhole projection of whole recordings, in NumPy and float64.

What filters and the calibration doctor measure recordings with. The differentiable versions, on any device, are in
`se3` and `cameras`; the conventions are theirs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from worldline_core.errors import CalibrationError

MAX_ROTATION_DEVIATION = 1e-3
"""A recorded rotation with R R^T further from the identity (largest entry) is refused, not repaired."""
ROTATION_ROUNDING = 1e-6
"""Up to here a deviation is the rounding of float32 storage: left as it is, and not reported."""


@dataclass(frozen=True)
class RotationRepair:
    """How many of the poses were given the nearest rotation, and the largest deviation among them."""

    count: int
    largest: float


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


def rotation_angle_deg(rotation: np.ndarray) -> np.ndarray:
    """(...,) angle of rotations (..., 3, 3)."""
    cosine = (np.trace(rotation, axis1=-2, axis2=-1) - 1) / 2
    sine = 0.5 * np.linalg.norm(
        np.stack(
            [
                rotation[..., 2, 1] - rotation[..., 1, 2],
                rotation[..., 0, 2] - rotation[..., 2, 0],
                rotation[..., 1, 0] - rotation[..., 0, 1],
            ],
            axis=-1,
        ),
        axis=-1,
    )
    return np.degrees(np.arctan2(sine, cosine))


def rigid_inverse(pose: np.ndarray) -> np.ndarray:
    """Inverse of rigid transforms (..., 4, 4)."""
    result = np.zeros_like(pose)
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -(rotation @ pose[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def mean_pose(poses: np.ndarray) -> np.ndarray:
    """(4, 4) with the median position and the chordal mean rotation of (n, 4, 4)."""
    result = np.eye(4)
    result[:3, :3] = nearest_rotation(poses[:, :3, :3].mean(axis=0))
    result[:3, 3] = np.median(poses[:, :3, 3], axis=0)
    return result


def hand_eye_residual(T_base_tool: np.ndarray, T_base_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far a wrist camera is from being fixed to its tool.

    Returns: mean T_tool_camera (4, 4); deviations (n,) [m] and (n,) [deg] from it.
    """
    T_tool_camera = rigid_inverse(T_base_tool) @ T_base_camera
    mount = mean_pose(T_tool_camera)
    apart = rigid_inverse(mount)[None] @ T_tool_camera
    return mount, np.linalg.norm(T_tool_camera[:, :3, 3] - mount[:3, 3], axis=1), rotation_angle_deg(apart[:, :3, :3])


def project_points(points: np.ndarray, K: np.ndarray, T_base_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) and depth (n,) [m] of base points (n, 3); depth <= 0 lies behind the camera."""
    T_camera_base = rigid_inverse(T_base_camera)
    in_camera = (T_camera_base[:, :3, :3] @ points[:, :, None])[:, :, 0] + T_camera_base[:, :3, 3]
    depth = in_camera[:, 2]
    safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    homogeneous = (in_camera / safe[:, None]) @ K.T
    return homogeneous[:, :2], depth


def inside_image(uv: np.ndarray, depth: np.ndarray, width: int, height: int) -> np.ndarray:
    """bool (n,): in front of the camera and on a pixel."""
    u, v = uv[:, 0], uv[:, 1]
    return (depth > 0.01) & (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)
