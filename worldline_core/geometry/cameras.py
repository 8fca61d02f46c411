"""Pinhole cameras.

Camera frame: OpenCV (x right, y down, z forward), metres. `T_base_camera` maps camera points to base.
Pixels: the *centre* of the top left pixel is (0, 0), so the image covers -0.5 <= u < width - 0.5, likewise v. Under
this convention a resize by s maps u to (u + 0.5) s - 0.5, and K follows it exactly (`image_transforms`): to resize
and then project is to project and then resize. Distorted lenses are undistorted on ingest (`undistortion`).
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from worldline_core.errors import CalibrationError
from worldline_core.geometry.image_transforms import ImageTransform
from worldline_core.geometry.se3 import invert, transform_points

MIN_DEPTH_M = 0.01
"""A point nearer to the camera plane than this counts as behind the camera."""


def project(
    points_base: Float[Tensor, "*#b 3"], K: Float[Tensor, "*#b 3 3"], T_base_camera: Float[Tensor, "*#b 4 4"]
) -> tuple[Float[Tensor, "*#b 2"], Float[Tensor, "*#b"]]:
    """Pixels uv and depth [m] of base points; leading axes broadcast.

    A point on or behind the camera plane has a meaningless uv (finite, never NaN); look at its depth.
    """
    in_camera = transform_points(invert(T_base_camera), points_base)
    depth = in_camera[..., 2]
    divisor = torch.where(depth.abs() < 1e-9, torch.full_like(depth, 1e-9), depth)
    uv = (K[..., :2, :] @ (in_camera / divisor[..., None])[..., None])[..., 0]
    return uv, depth


def unproject(
    uv: Float[Tensor, "*#b 2"],
    depth: Float[Tensor, "*#b"],
    K: Float[Tensor, "*#b 3 3"],
    T_base_camera: Float[Tensor, "*#b 4 4"],
) -> Float[Tensor, "*#b 3"]:
    """Base points at these pixels and depths: the inverse of `project`."""
    homogeneous = torch.cat([uv, torch.ones_like(uv[..., :1])], dim=-1)
    ray = torch.linalg.solve(K, homogeneous[..., None].to(K.dtype))[..., 0]
    return transform_points(T_base_camera, ray * depth[..., None])


def inside_image(uv: Float[Tensor, "*b 2"], image_size: tuple[int, int]) -> Bool[Tensor, "*b"]:
    """Whether uv falls on a pixel of an image of (height, width)."""
    height, width = image_size
    u, v = uv.unbind(-1)
    return (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)


def transform_intrinsics(K: Float[Tensor, "*b 3 3"], transform: ImageTransform) -> Float[Tensor, "*b 3 3"]:
    """K after the image is resized, cropped, padded or letterboxed."""
    return torch.as_tensor(transform.affine, dtype=K.dtype, device=K.device) @ K


def valid_intrinsics(K: Float[Tensor, "*b 3 3"]) -> Bool[Tensor, "*b"]:
    """Finite, invertible, last row 0 0 1, positive focal lengths."""
    last_row = torch.tensor([0.0, 0.0, 1.0], dtype=K.dtype, device=K.device)
    finite = torch.isfinite(K).all(-1).all(-1)
    upper = (K[..., 0, 0] > 1e-6) & (K[..., 1, 1] > 1e-6) & (K[..., 1, 0].abs() < 1e-6)
    return finite & upper & ((K[..., 2, :] - last_row).abs() <= 1e-6).all(-1)


def check_intrinsics(K: Float[Tensor, "*b 3 3"], where: object) -> None:
    """Raises: CalibrationError when a camera matrix is singular or no pinhole camera."""
    good = valid_intrinsics(K)
    if not bool(good.all()):
        bad = K.reshape(-1, 3, 3)[~good.reshape(-1)]
        raise CalibrationError(
            "Camera matrix is singular or not that of a pinhole camera",
            where=where,
            expected="[[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0, all finite",
            got=bad[0].tolist(),
            next_step="check the order of the values (row major) and their units (pixels)",
        )
