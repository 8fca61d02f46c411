"""Rigid transforms as 4x4 matrices.

`T_a_b` maps points given in frame b to frame a, so `T_a_c = T_a_b @ T_b_c`. Quaternions are wxyz, unit length.
Functions are batched over leading axes, differentiable, and keep dtype and device.

Rot6D: a rotation as its first two columns (Zhou et al., CVPR 2019, "On the Continuity of Rotation Representations").

Layout: `[R00, R10, R20, R01, R11, R21]`, that is column x, then column y.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from worldline_core.errors import CalibrationError
from worldline_core.geometry.transforms import MIN_QUATERNION_NORM

ROTATION_TOLERANCE = 1e-4
"""Largest deviation of R R^T from the identity (and of det R from 1) that still counts as a rotation."""


def transform_from(rotation: Float[Tensor, "*b 3 3"], translation: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4 4"]:
    """The transform with this rotation and translation."""
    top = torch.cat([rotation, translation[..., None]], dim=-1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1.0
    return torch.cat([top, bottom], dim=-2)


def invert(T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """T_b_a from T_a_b, by the transpose of the rotation (T must be rigid)."""
    inverse = T[..., :3, :3].mT
    return transform_from(inverse, -(inverse @ T[..., :3, 3:])[..., 0])


def transform_points(T: Float[Tensor, "*#b 4 4"], points: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*#b 3"]:
    """Points of frame b in frame a; leading axes broadcast."""
    return (T[..., :3, :3] @ points[..., None])[..., 0] + T[..., :3, 3]


def rotation_from_quaternion_wxyz(quaternion: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation matrix of a quaternion (normalised first).

    Raises: CalibrationError for a quaternion of no length, or one that is not finite.
    """
    norm = quaternion.norm(dim=-1, keepdim=True)
    if not bool(((norm > MIN_QUATERNION_NORM) & torch.isfinite(norm)).all()):
        raise CalibrationError(
            "Quaternion has no direction",
            expected="a unit quaternion, wxyz",
            got=f"norms from {float(norm.min()):.3g} to {float(norm.max()):.3g}",
        )
    w, x, y, z = (quaternion / norm).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=-1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=-1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


def rotation_angle(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Angle of a rotation in radians, 0..pi, accurate at both ends."""
    skew = torch.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        dim=-1,
    )
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.atan2(skew.norm(dim=-1), trace - 1)


def is_rigid(T: Float[Tensor, "*b 4 4"], tolerance: float = ROTATION_TOLERANCE) -> Tensor:
    """Bool (*b): finite, orthonormal, right-handed, last row 0 0 0 1."""
    rotation = T[..., :3, :3]
    eye = torch.eye(3, dtype=T.dtype, device=T.device)
    last_row = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=T.dtype, device=T.device)
    finite = torch.isfinite(T).all(-1).all(-1)
    orthonormal = ((rotation @ rotation.mT - eye).abs() <= tolerance).all(-1).all(-1)
    right_handed = (torch.linalg.det(torch.nan_to_num(rotation)) - 1).abs() <= 3 * tolerance
    return finite & orthonormal & right_handed & ((T[..., 3, :] - last_row).abs() <= tolerance).all(-1)


def check_rigid(T: Float[Tensor, "*b 4 4"], where: object) -> None:
    """Raises: CalibrationError when one of the transforms is not rigid."""
    good = is_rigid(T)
    if not bool(good.all()):
        bad = T.reshape(-1, 4, 4)[~good.reshape(-1)]
        raise CalibrationError(
            "Not a rigid transform: the rotation is not orthonormal and right-handed, or not finite",
            where=where,
            expected="R R^T = I, det R = 1, last row 0 0 0 1",
            got=f"{len(bad)} of {good.numel()} bad, the first {bad[0].tolist()}",
            next_step="check whether the matrix is transposed, scaled, or stored in another layout",
        )


def rot6d_from_rotation(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 6"]:
    """First two columns, one after the other."""
    return torch.cat([rotation[..., :, 0], rotation[..., :, 1]], dim=-1)


def rotation_from_rot6d(rot6d: Float[Tensor, "*b 6"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation by Gram-Schmidt: exact for Rot6D of a rotation, the nearest frame built from x first otherwise.

    Raises: CalibrationError when the two vectors span no plane (one is zero, or they are parallel).
    """
    area = torch.linalg.cross(rot6d[..., :3], rot6d[..., 3:]).norm(dim=-1)
    if not bool((area > 1e-9).all()):
        raise CalibrationError(
            "Rot6D spans no frame: a column is zero, not finite, or parallel to the other",
            expected="two columns that are not parallel",
            got=f"{int((~(area > 1e-9)).sum())} of {area.numel()} such",
        )
    x = torch.nn.functional.normalize(rot6d[..., :3], dim=-1)
    y = rot6d[..., 3:] - (x * rot6d[..., 3:]).sum(-1, keepdim=True) * x
    y = torch.nn.functional.normalize(y, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=-1)
