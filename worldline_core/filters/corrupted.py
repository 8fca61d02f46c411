"""Corrupted images: blank, noise, or frozen while the robot moves."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from worldline_core.config.base import StrictModel
from worldline_core.filters.verdict import Verdict, runs


class CorruptedConfig(StrictModel):
    """Grey levels are of 255."""

    min_contrast: float = Field(
        default=4.0, gt=0, description="standard deviation over the image; less is a blank frame"
    )
    min_neighbour_correlation: float = Field(default=0.5, gt=0, lt=1, description="of adjacent pixels; less is noise")
    max_frozen_change: float = Field(
        default=0.02,
        ge=0,
        description="mean absolute change below which frames are the same; a camera over a plain table shows 0.05",
    )
    min_frozen_motion_m: float = Field(default=0.05, gt=0, description="tool travel during a freeze that makes it one")
    min_frozen_motion_wrist_m: float = Field(
        default=0.2, gt=0, description="the same for a wrist camera, which may pass over a plain table without change"
    )
    min_frozen_frames: int = Field(default=4, ge=2)
    max_bad_share: float = Field(default=0.5, gt=0, le=1, description="more bad frames condemn the episode")


def blank_frames(gray: np.ndarray, min_contrast: float) -> np.ndarray:
    """bool (n,): frames (n, h, w) of nearly one grey level."""
    return gray.reshape(len(gray), -1).astype(np.float32).std(axis=1) < min_contrast


def neighbour_correlation(gray: np.ndarray) -> np.ndarray:
    """(n,) correlation of horizontally and vertically adjacent pixels; near 1 for pictures, near 0 for noise."""
    value = gray.astype(np.float32)
    value = value - value.mean(axis=(1, 2), keepdims=True)
    variance = np.maximum((value**2).mean(axis=(1, 2)), 1e-6)
    across = (value[:, :, 1:] * value[:, :, :-1]).mean(axis=(1, 2))
    down = (value[:, 1:] * value[:, :-1]).mean(axis=(1, 2))
    return np.minimum(across, down) / variance


def frozen_frames(
    change: np.ndarray, travel: np.ndarray, config: CorruptedConfig, *, wrist: bool = False
) -> np.ndarray:
    """bool (n,): runs of unchanged images during which the robot travelled.

    Args:
        change: (n,) mean absolute image change, frame i against i - 1 (0 for frame 0).
        travel: (n,) tool travel [m], frame i against i - 1.
        wrist: whether the view is that of a wrist camera.
    """
    same = change < config.max_frozen_change
    same[0] = False
    needed = config.min_frozen_motion_wrist_m if wrist else config.min_frozen_motion_m
    bad = np.zeros(len(change), dtype=bool)
    for start, stop in runs(same):
        if stop - start >= config.min_frozen_frames and travel[start:stop].sum() >= needed:
            bad[start:stop] = True
    return bad


def detect_corrupted(
    gray: np.ndarray, change: np.ndarray, travel: np.ndarray, config: CorruptedConfig, *, wrist: bool = False
) -> Verdict:
    """Blank, noisy and frozen frames of one view.

    Args:
        gray: uint8 (n, h, w).
        change, travel: see `frozen_frames`; travel is that of what the view must show moving.
    """
    blank = blank_frames(gray, config.min_contrast)
    correlation = neighbour_correlation(gray)
    noise = (correlation < config.min_neighbour_correlation) & ~blank
    frozen = frozen_frames(change, travel, config, wrist=wrist)
    bad = blank | noise | frozen
    return Verdict(
        "corrupted",
        float(bad.mean()) <= config.max_bad_share,
        {
            "bad_share": float(bad.mean()),
            "blank_frames": int(blank.sum()),
            "noise_frames": int(noise.sum()),
            "frozen_frames": int(frozen.sum()),
            "min_neighbour_correlation": float(correlation.min()),
            "threshold_bad_share": config.max_bad_share,
        },
        bad,
    )
