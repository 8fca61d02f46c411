"""Thresholds of all detectors."""

from __future__ import annotations

from pydantic import Field

from worldline_core.config.base import StrictModel
from worldline_core.filters.base_motion import BaseMotionConfig
from worldline_core.filters.calibration import CalibrationConfig
from worldline_core.filters.corrupted import CorruptedConfig
from worldline_core.filters.doctor import FilterDoctorConfig
from worldline_core.filters.projection import ProjectionConfig
from worldline_core.filters.reset import ResetConfig
from worldline_core.filters.static import StaticConfig
from worldline_core.filters.time_alignment import TimeAlignmentConfig


class FilterConfig(StrictModel):
    """Thresholds of all detectors."""

    required_views: tuple[str, ...] | None = Field(
        default=None, description="views that Stage II needs; null: head and one wrist view for each arm"
    )
    min_segment_frames: int = Field(default=17, ge=2, description="shorter stretches are dropped")
    static: StaticConfig = StaticConfig()
    reset: ResetConfig = ResetConfig()
    corrupted: CorruptedConfig = CorruptedConfig()
    base_motion: BaseMotionConfig = BaseMotionConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    time_alignment: TimeAlignmentConfig = TimeAlignmentConfig()
    projection: ProjectionConfig = ProjectionConfig()
    doctor: FilterDoctorConfig = FilterDoctorConfig()
