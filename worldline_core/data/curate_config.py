"""What to read, and what every curated episode looks like."""

from __future__ import annotations

from pydantic import Field

from worldline_core.config.base import StrictModel
from worldline_core.data.episode import Split
from worldline_core.data.resize import Fit
from worldline_core.data.sources.open import SourceConfig
from worldline_core.data.video import PixelFormat


class CurateConfig(StrictModel):
    """What to read and what every kept episode will look like."""

    sources: tuple[SourceConfig, ...] = Field(min_length=1)
    image_size: tuple[int, int] | None = Field(
        default=None, description="(height, width) of all images; null keeps each size"
    )
    fit: Fit = Field(default="stretch", description="how images come to that size; letterbox and crop keep the aspect")
    fps: float | None = Field(default=None, gt=0, description="rate of all episodes; null keeps each rate")
    views: tuple[str, ...] | None = Field(default=None, description="views to keep, in this order; null keeps all")
    primary_view: str | None = Field(
        default=None, description="task-facing view for single-view training; null keeps the source's"
    )
    splits: dict[str, Split] = Field(
        default={}, description="scene name pattern -> split, first match wins; else the source's"
    )
    require_calibration: bool = Field(default=False, description="quarantine episodes with an uncalibrated view")
    min_frames: int = Field(default=2, ge=1)
    joint_tolerance_rad: float = Field(default=0.05, ge=0)
    time_tolerance_frames: float = Field(
        default=0.25, gt=0, description="largest distance of a frame from its rate's grid"
    )
    video_crf: int = Field(default=10, ge=0, le=51)
    video_preset: str = "veryfast"
    pixel_format: PixelFormat = Field(
        default="yuv444p",
        description="full colour: at 64x96 yuv420p costs 9 dB at the same file size; few browsers play it",
    )
