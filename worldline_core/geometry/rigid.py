"""Rigid transforms and pinhole projection of whole recordings, in NumPy and float64.

What filters and the calibration doctor measure recordings with. The differentiable versions, on any device, are in
`se3` and `cameras`; the conventions are theirs.
"""

from __future__ import annotations

import numpy as np


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
    u, _, vt = np.linalg.svd(poses[:, :3, :3].mean(axis=0))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation, np.median(poses[:, :3, 3], axis=0)
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
