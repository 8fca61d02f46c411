"""Exposure: pictures in which nothing can be seen because there was too little or too much light.

Blur: pictures without the finest detail, because the camera hunted for focus, shook, or never was in focus.

The variance of the Laplacian (Pech-Pacheco et al. 2000) depends on what is seen. Held against the contrast of adjacent
pixels of the small picture, which blur of a few pixels leaves as it is, what is seen falls out, and so does gain.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.filters.signals import PictureStatistics
from worldline_core.filters.verdict import Curve, Verdict, long_runs


class ExposureConfig(StrictModel):
    """Grey levels are of 255, full range."""

    min_bright_level: float = Field(
        default=34.0, ge=0, le=255, description="95th percentile of the levels; a darker picture shows nothing"
    )
    max_white_share: float = Field(
        default=0.45, gt=0, le=1, description="share of pixels at 245 or above; more is overexposed"
    )
    min_bright_level_wrist: float = Field(
        default=12.0, ge=0, le=255, description="the same for a wrist camera, which a grasped thing may cover"
    )
    max_white_share_wrist: float = Field(
        default=0.8, gt=0, le=1, description="the same for a wrist camera, which may look at a white table alone"
    )
    max_bad_share: float = Field(default=0.5, gt=0, le=1, description="more bad frames condemn the episode")


def detect_dark(pictures: PictureStatistics, config: ExposureConfig, *, wrist: bool = False) -> Verdict:
    """Black pictures, and those too dark to see anything in."""
    least = config.min_bright_level_wrist if wrist else config.min_bright_level
    bad = pictures.bright_level < least
    return Verdict(
        "too_dark",
        float(bad.mean()) <= config.max_bad_share,
        {
            "bad_share": float(bad.mean()),
            "lowest_bright_level": float(pictures.bright_level.min()),
            "threshold_bright_level": least,
        },
        bad,
        {"bright_level": Curve(pictures.bright_level, least)},
    )


def detect_overexposed(pictures: PictureStatistics, config: ExposureConfig, *, wrist: bool = False) -> Verdict:
    """Pictures with much of the sensor saturated."""
    most = config.max_white_share_wrist if wrist else config.max_white_share
    bad = pictures.white_share > most
    return Verdict(
        "overexposed",
        float(bad.mean()) <= config.max_bad_share,
        {
            "bad_share": float(bad.mean()),
            "largest_white_share": float(pictures.white_share.max()),
            "threshold_white_share": most,
        },
        bad,
        {"white_share": Curve(pictures.white_share, most)},
    )


class BlurConfig(StrictModel):
    """Sharpness is the variance of the Laplacian of the luma (0..255) at the image's own size."""

    min_sharpness: float = Field(
        default=8.0, ge=0, description="less is out of focus, whatever the rest of the episode"
    )
    min_relative: float = Field(
        default=0.25, ge=0, lt=1, description="sharpness for the detail seen, of the episode's own (75th percentile)"
    )
    min_relative_wrist: float = Field(
        default=0.1, ge=0, lt=1, description="the same for a wrist camera, whose pictures smear when the arm is quick"
    )
    min_run_s: float = Field(default=0.25, ge=0, description="shorter stretches are part of motion")
    max_bad_share: float = Field(default=0.5, gt=0, le=1, description="more bad frames condemn the episode")


def relative_sharpness(sharpness: np.ndarray, detail: np.ndarray) -> np.ndarray:
    """(n,) sharpness for the detail seen, 1 at the episode's 75th percentile.

    Args:
        sharpness: (n,) measured every few frames and held in between.
        detail: (n,) of every frame.
    """
    measured = np.flatnonzero(np.diff(sharpness, prepend=-1.0) != 0)
    ratio = sharpness[measured] / np.maximum(detail[measured], 1e-3)
    usual = max(float(np.quantile(ratio, 0.75)), 1e-9)
    held = np.searchsorted(measured, np.arange(len(sharpness)), side="right") - 1
    return ratio[held] / usual


def detect_blur(
    sharpness: np.ndarray,
    pictures: PictureStatistics,
    unusable: np.ndarray,
    fps: float,
    config: BlurConfig,
    *,
    wrist: bool = False,
) -> Verdict:
    """Blurred stretches of one view.

    Args:
        sharpness: (n,).
        unusable: bool (n,) frames that other detectors dropped: the sharpness of noise or of darkness says nothing.
    """
    least = config.min_relative_wrist if wrist else config.min_relative
    relative = np.ones(len(sharpness))
    seen = ~unusable
    if seen.any():
        relative[seen] = relative_sharpness(sharpness[seen], pictures.detail[seen])
    blurred = ((relative < least) | (sharpness < config.min_sharpness)) & seen
    bad = long_runs(blurred, max(1.0, config.min_run_s * fps))
    return Verdict(
        "blur",
        float(bad.mean()) <= config.max_bad_share,
        {
            "bad_share": float(bad.mean()),
            "median_sharpness": float(np.median(sharpness)),
            "lowest_relative_sharpness": float(relative.min()),
            "threshold_sharpness": config.min_sharpness,
            "threshold_relative": least,
        },
        bad,
        {"relative_sharpness": Curve(relative, least)},
    )
