"""Exposure: pictures in which nothing can be seen because there was too little or too much light."""

from __future__ import annotations

from pydantic import Field

from worldline_core.config.base import StrictModel
from worldline_core.filters.picture_statistics import PictureStatistics
from worldline_core.filters.verdict import Curve, Verdict


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
