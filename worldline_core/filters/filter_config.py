"""Thresholds of all detectors, and where a source needs others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

from pydantic import Field, JsonValue, model_validator

from worldline_core.config import StrictModel, validate
from worldline_core.errors import ConfigError
from worldline_core.filters.alignment import ProjectionConfig, TimeAlignmentConfig
from worldline_core.filters.base_motion import BaseMotionConfig
from worldline_core.filters.calibration import CalibrationConfig, FilterDoctorConfig
from worldline_core.filters.corrupted import CorruptedConfig
from worldline_core.filters.exposure import BlurConfig, ExposureConfig
from worldline_core.filters.motion import JointMotionConfig, ResetConfig, StaticConfig


class FilterConfig(StrictModel):
    """Thresholds of all detectors.

    `sources` holds what differs for the episodes of one source, in the same form:
    `{agibot_world: {static: {min_run_s: 2}}}`. Everything that is not named there stays as it is for all.
    """

    required_views: tuple[str, ...] | None = Field(
        default=None, description="views that Stage II needs; null: head and one wrist view for each arm"
    )
    min_segment_frames: int = Field(default=17, ge=2, description="shorter stretches are dropped")
    static: StaticConfig = StaticConfig()
    reset: ResetConfig = ResetConfig()
    corrupted: CorruptedConfig = CorruptedConfig()
    exposure: ExposureConfig = ExposureConfig()
    blur: BlurConfig = BlurConfig()
    base_motion: BaseMotionConfig = BaseMotionConfig()
    joint_motion: JointMotionConfig = JointMotionConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    time_alignment: TimeAlignmentConfig = TimeAlignmentConfig()
    projection: ProjectionConfig = ProjectionConfig()
    doctor: FilterDoctorConfig = FilterDoctorConfig()
    sources: dict[str, dict[str, JsonValue]] = Field(
        default_factory=dict, description="by the name of a source: thresholds that differ for its episodes"
    )

    @model_validator(mode="after")
    def _sources_are_valid(self) -> Self:
        for name in self.sources:
            self.for_source(name)
        return self

    def for_source(self, name: str) -> FilterConfig:
        """The thresholds for the episodes of a source; the same for all where `sources` does not name it.

        Raises: ConfigError when an override names an unknown key or has a value that does not fit.
        """
        overrides = self.sources.get(name)
        if overrides is None:
            return self
        if "sources" in overrides:
            raise ConfigError("Sources cannot be nested", where=f"filter.sources.{name}", got="sources")
        values = _merged(self.model_dump(mode="json", exclude={"sources"}), overrides)
        return validate(FilterConfig, values, where=f"filter.sources.{name}")


def _merged(values: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of nested `values` with the leaves of `overrides` in it; unknown keys stay, to be refused by name."""
    result = dict(values)
    for key, value in overrides.items():
        inner = result.get(key)
        if isinstance(inner, Mapping) and isinstance(value, Mapping):
            value = _merged(inner, value)
        result[key] = value
    return result
