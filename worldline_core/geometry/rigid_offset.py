"""A fixed rigid transform as a configuration writes it: translation [m] and quaternion (wxyz)."""

from __future__ import annotations

import math

import numpy as np
from pydantic import model_validator

from worldline_core.config import StrictModel

QUATERNION_TOLERANCE = 1e-3
"""Largest deviation of a quaternion's length from 1 that is taken for rounding and normalised away."""


class RigidOffset(StrictModel):
    """A fixed transform by translation [m] and quaternion (wxyz); a length within 1e-3 of 1 is normalised."""

    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _proper(self) -> RigidOffset:
        if not all(math.isfinite(value) for value in (*self.translation, *self.rotation_wxyz)):
            raise ValueError("translation and rotation_wxyz must be finite numbers")
        norm = float(np.linalg.norm(self.rotation_wxyz))
        if norm == 0.0:
            raise ValueError("rotation_wxyz is the zero quaternion, which is no rotation (no rotation: 1 0 0 0)")
        if abs(norm - 1.0) > QUATERNION_TOLERANCE:
            raise ValueError(f"rotation_wxyz has length {norm:.6f}, expected 1")
        return self

    def matrix(self) -> np.ndarray:
        """(4, 4) float64."""
        w, x, y, z = np.asarray(self.rotation_wxyz, dtype=np.float64) / np.linalg.norm(self.rotation_wxyz)
        T = np.eye(4)
        T[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        T[:3, 3] = self.translation
        return T
