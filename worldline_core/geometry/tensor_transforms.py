"""Rigid transforms and camera matrices as tensors: differentiable, batched over leading axes, of any dtype and device.

`T_a_b` maps points given in frame b to frame a. The NumPy functions that recordings are read with: `transforms`, `cameras`;
they stay free of torch, so that a process that only reads and writes episodes need not import it.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

RIGID_TOLERANCE = 1e-4
"""`is_rigid`: largest deviation of R R^T from the identity that still counts as a rotation."""


def invert(T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """`transforms.rigid_inverse` of tensors."""
    rotation = T[..., :3, :3].mT
    top = torch.cat([rotation, -(rotation @ T[..., :3, 3:])], dim=-1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1.0
    return torch.cat([top, bottom], dim=-2)


def transform_points(T: Float[Tensor, "*#b 4 4"], points: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*#b 3"]:
    """Points of frame b in frame a; leading axes broadcast."""
    return (T[..., :3, :3] @ points[..., None])[..., 0] + T[..., :3, 3]


def is_rigid(T: Float[Tensor, "*b 4 4"]) -> Bool[Tensor, "*b"]:
    """True for transforms that are finite, orthonormal and right-handed, with last row 0 0 0 1."""
    rotation = T[..., :3, :3]
    eye = torch.eye(3, dtype=T.dtype, device=T.device)
    last_row = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=T.dtype, device=T.device)
    finite = torch.isfinite(T).all(-1).all(-1)
    orthonormal = ((rotation @ rotation.mT - eye).abs() <= RIGID_TOLERANCE).all(-1).all(-1)
    right_handed = (torch.linalg.det(torch.nan_to_num(rotation)) - 1).abs() <= 3 * RIGID_TOLERANCE
    return finite & orthonormal & right_handed & ((T[..., 3, :] - last_row).abs() <= RIGID_TOLERANCE).all(-1)


def rot6d_from_rotation(rotation: Float[Tensor, "*b 3 columns"]) -> Float[Tensor, "*b 6"]:
    """Rot6D (see `transforms`): the first two columns, one after the other."""
    return rotation[..., :2].mT.flatten(-2)


def valid_intrinsics(K: Float[Tensor, "*b 3 3"]) -> Bool[Tensor, "*b"]:
    """Finite, invertible, last row 0 0 1, positive focal lengths."""
    last_row = torch.tensor([0.0, 0.0, 1.0], dtype=K.dtype, device=K.device)
    finite = torch.isfinite(K).all(-1).all(-1)
    upper = (K[..., 0, 0] > 1e-6) & (K[..., 1, 1] > 1e-6) & (K[..., 1, 0].abs() < 1e-6)
    return finite & upper & ((K[..., 2, :] - last_row).abs() <= 1e-6).all(-1)
