"""Calibration: K is sane, camera poses are rigid, wrist cameras are fixed to their arm, fixed cameras stay fixed."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from worldline_core.config.base import StrictModel
from worldline_core.filters.verdict import Verdict
from worldline_core.geometry.rigid import hand_eye_residual, rotation_angle_deg


class CalibrationConfig(StrictModel):
    """Lengths in metres, angles in degrees."""

    min_field_of_view_deg: float = Field(default=15.0, gt=0)
    max_field_of_view_deg: float = Field(default=150.0, lt=180)
    max_principal_point_offset: float = Field(
        default=0.25, gt=0, description="from the image centre, share of the image side"
    )
    max_rotation_residual: float = Field(default=1e-3, gt=0, description="largest entry of R R^T - I")
    max_hand_eye_m: float = Field(
        default=0.012, gt=0, description="deviation of a wrist camera from its mount (95th percentile)"
    )
    max_hand_eye_deg: float = Field(default=6.0, gt=0)
    max_mount_offset_m: float = Field(default=0.08, gt=0, description="from the mount that the embodiment states")
    max_mount_offset_deg: float = Field(default=20.0, gt=0)


def fields_of_view_deg(K: np.ndarray, width: int, height: int) -> tuple[float, float]:
    """Horizontal and vertical field of view."""
    return (
        float(np.degrees(2 * np.arctan2(width, 2 * K[0, 0]))),
        float(np.degrees(2 * np.arctan2(height, 2 * K[1, 1]))),
    )


def detect_camera(
    K: np.ndarray, T_base_camera: np.ndarray, width: int, height: int, config: CalibrationConfig
) -> Verdict:
    """Whether K and the poses (n, 4, 4) can be those of a camera with this image size."""
    numbers: dict[str, float | int | str | None] = {}
    sane = bool(np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0 and abs(np.linalg.det(K)) > 1e-9)
    if sane:
        for name, angle in zip(("horizontal", "vertical"), fields_of_view_deg(K, width, height), strict=True):
            numbers[f"{name}_fov_deg"] = angle
            sane &= config.min_field_of_view_deg <= angle <= config.max_field_of_view_deg
        offset = max(abs(K[0, 2] - (width - 1) / 2) / width, abs(K[1, 2] - (height - 1) / 2) / height)
        numbers["principal_point_offset"] = float(offset)
        sane &= offset <= config.max_principal_point_offset
    rotation = T_base_camera[:, :3, :3]
    finite = bool(np.isfinite(T_base_camera).all())
    residual = float(np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max()) if finite else None
    proper = finite and bool((np.linalg.det(rotation) > 0).all())
    numbers |= {"rotation_residual": residual, "threshold_rotation_residual": config.max_rotation_residual}
    rigid = proper and residual is not None and residual <= config.max_rotation_residual
    return Verdict("calibration", sane and rigid, numbers)


def detect_hand_eye(
    T_base_tool: np.ndarray, T_base_camera: np.ndarray, T_tool_mount: np.ndarray | None, config: CalibrationConfig
) -> Verdict:
    """Whether a wrist camera is rigidly fixed to its tool, and where the embodiment says.

    Args:
        T_base_tool, T_base_camera: (n, 4, 4).
        T_tool_mount: (4, 4) the embodiment's mount relative to the tool, or None.
    """
    mount, metres, degrees = hand_eye_residual(T_base_tool, T_base_camera)
    metres_95, degrees_95 = float(np.percentile(metres, 95)), float(np.percentile(degrees, 95))
    passed = metres_95 <= config.max_hand_eye_m and degrees_95 <= config.max_hand_eye_deg
    numbers: dict[str, float | int | str | None] = {
        "hand_eye_m": metres_95,
        "hand_eye_deg": degrees_95,
        "threshold_m": config.max_hand_eye_m,
        "threshold_deg": config.max_hand_eye_deg,
    }
    if T_tool_mount is not None:
        offset_m = float(np.linalg.norm(mount[:3, 3] - T_tool_mount[:3, 3]))
        offset_deg = float(rotation_angle_deg(mount[:3, :3].T @ T_tool_mount[:3, :3]))
        numbers |= {"mount_offset_m": offset_m, "mount_offset_deg": offset_deg}
        passed &= offset_m <= config.max_mount_offset_m and offset_deg <= config.max_mount_offset_deg
    return Verdict("calibration", passed, numbers)


def detect_fixed_camera(T_base_camera: np.ndarray, config: CalibrationConfig) -> Verdict:
    """Whether a camera that should stand still in the base frame does."""
    _, metres, degrees = hand_eye_residual(np.eye(4)[None].repeat(len(T_base_camera), axis=0), T_base_camera)
    metres_95, degrees_95 = float(np.percentile(metres, 95)), float(np.percentile(degrees, 95))
    return Verdict(
        "calibration",
        metres_95 <= config.max_hand_eye_m and degrees_95 <= config.max_hand_eye_deg,
        {"moved_m": metres_95, "turned_deg": degrees_95},
    )
