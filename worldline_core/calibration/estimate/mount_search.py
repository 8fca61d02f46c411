"""Where beside a hand a wrist camera may be mounted, where no description says so: starts for the estimate."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

BEHIND_M, BESIDE_M = (0.06, 0.14), (0.05, 0.1)
"""Places of the camera: behind the tool along the hand's axis, and beside that axis."""
TURNS, ROLLS = 8, 4
LOOKS_AHEAD_M = 0.03
"""It looks at a point this far ahead of the tool."""


def mounts_around(hand: np.ndarray) -> Iterator[np.ndarray]:
    """T_tool_camera (4, 4), axes of OpenCV, of cameras beside a hand of points (p, 3) in the tool's frame, which see the tool.

    The hand points from its middle to the tool, or along the tool's z axis where no point of it is known.
    """
    ahead = -hand.mean(axis=0) if len(hand) else np.array([0.0, 0.0, 1.0])
    ahead /= np.linalg.norm(ahead)
    across = np.cross(ahead, np.eye(3)[np.abs(ahead).argmin()])
    across /= np.linalg.norm(across)
    plane = np.c_[across, np.cross(ahead, across)]
    for behind, beside, turn, roll in product(BEHIND_M, BESIDE_M, range(TURNS), range(ROLLS)):
        outward, down = (
            plane @ (np.cos(angle), np.sin(angle))
            for angle in (2 * np.pi * turn / TURNS, 2 * np.pi * (turn / TURNS + roll / ROLLS))
        )
        eye = beside * outward - behind * ahead
        yield _facing(eye, LOOKS_AHEAD_M * ahead, down)


def _facing(eye: np.ndarray, target: np.ndarray, down: np.ndarray) -> np.ndarray:
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(down, z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.c_[x, np.cross(z, x), z, eye]
    return pose
