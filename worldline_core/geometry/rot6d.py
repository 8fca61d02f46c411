"""Rot6D: a rotation as its first two columns (Zhou et al., CVPR 2019, "On the Continuity of Rotation Representations").

Layout: `[R00, R10, R20, R01, R11, R21]`, that is column x, then column y.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from worldline_core.errors import CalibrationError


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
