"""Which frames of a video a judge sees (appendix "Observation sampling" and "Verification")."""

from __future__ import annotations

import numpy as np

FIRST_PASS_COUNT = 12
FIRST_PASS_HEIGHT_PX = 360
VERIFICATION_POSITIONS = (0.0, 0.65, 0.78, 0.88, 0.95, 1.0)
VERIFICATION_HEIGHT_PX = 480
MOTION_COUNT = 12


def first_pass_indices(num_frames: int, count: int = FIRST_PASS_COUNT) -> tuple[int, ...]:
    """Frames at sqrt(i / (count - 1)): more of them late, where success and failure differ."""
    return frames_at(np.sqrt(np.arange(count) / (count - 1)), num_frames)


def verification_indices(num_frames: int) -> tuple[int, ...]:
    """Six late groups, inspected at higher resolution."""
    return frames_at(VERIFICATION_POSITIONS, num_frames)


def motion_indices(num_frames: int, count: int = MOTION_COUNT) -> tuple[int, ...]:
    """Frames spread evenly over the whole video."""
    return frames_at(np.linspace(0.0, 1.0, count), num_frames)


def frames_at(positions: np.ndarray | tuple[float, ...], num_frames: int) -> tuple[int, ...]:
    """Nearest frames of normalised positions, in order; a frame that two positions share is shown once."""
    return tuple(sorted({round(float(position) * (num_frames - 1)) for position in positions}))
