"""Limits of the calibration doctor's decisions. Importing them does not import torch."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from worldline_core.config import StrictModel


class ErrorLimits(StrictModel):
    """Smallest size of a camera error, and its standard deviations from zero, to be reported."""

    deviations: float = Field(gt=0)
    rotation: float = Field(gt=0, description="degrees")
    translation: float = Field(gt=0, description="millimetres")
    focal_length: float = Field(gt=0, description="percent")
    principal_point: float = Field(gt=0, description="percent of the image side")
    lag: float = Field(gt=0, description="frames")


class CalibrationDoctorConfig(StrictModel):
    """Limits of the calibration doctor's decisions."""

    search: Literal["always", "when_suspicious"] = Field(
        default="always", description="when_suspicious: try other readings only if the recorded one looks bad"
    )
    min_margin: float = Field(
        default=2.5, gt=0, description="log-likelihood by which a mistake must beat the recording as written"
    )
    max_hand_eye_m: float = Field(default=0.012, gt=0, description="a larger hand-eye residual is bad in any reading")
    off_alone: ErrorLimits = Field(
        default=ErrorLimits(
            deviations=5.0, rotation=3.5, translation=80.0, focal_length=9.0, principal_point=7.0, lag=0.6
        ),
        description="for one episode",
    )
    off_together: ErrorLimits = Field(
        default=ErrorLimits(
            deviations=3.0, rotation=1.25, translation=25.0, focal_length=2.2, principal_point=2.0, lag=0.3
        ),
        description="for all episodes of a source",
    )
