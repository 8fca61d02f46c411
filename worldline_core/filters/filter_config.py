"""Thresholds of all detectors, one section each, and where a source needs others. docs/filters.md explains them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Self

from pydantic import Field, JsonValue, model_validator

from worldline_core.calibration.diagnosis import CalibrationDoctorConfig
from worldline_core.config import StrictModel, validate
from worldline_core.errors import ConfigError


class StaticConfig(StrictModel):
    """A stretch is static when all three stay below their thresholds."""

    max_joint_speed_rad_s: float = Field(
        default=0.03, gt=0, description="range of a joint within half a second, as a speed: encoder noise hardly counts"
    )
    max_gripper_speed_per_s: float = Field(default=0.05, gt=0)
    max_image_change: float = Field(
        default=0.6,
        gt=0,
        description="mean absolute change per frame of the image reduced by four, in grey levels of 255",
    )
    min_run_s: float = Field(default=1.5, gt=0, description="shorter pauses are part of manipulation")


class ResetConfig(StrictModel):
    """A reset returns most of the way to the first pose within a moment, faster than the episode moves otherwise."""

    min_jump_rad: float = Field(default=0.15, gt=0, description="a shorter return is jitter")
    home_share: float = Field(
        default=0.2, gt=0, lt=1, description="distance to the first pose after the return, relative to before it"
    )
    max_return_s: float = Field(default=0.7, gt=0, description="a slower return is motion like any other")
    min_relative_step: float = Field(
        default=1.15,
        ge=1,
        description="speed of a return within one frame, relative to the episode's other steps (90th percentile)",
    )
    min_relative_speed: float = Field(
        default=1.7, ge=1, description="mean speed of a longer return, relative to the same"
    )


class JointMotionConfig(StrictModel):
    """Joint positions in radians. Arms of this size reach 2 to 4 rad/s (Panda 2.6, UR5e and xArm 3.1, ViperX 3.1)."""

    min_jump_rad: float = Field(default=0.3, gt=0, description="smaller steps from frame to frame are not jumps")
    min_relative_step: float = Field(
        default=3.0, gt=1, description="ratio of a jump to the largest other step of the joint within four frames"
    )
    max_speed_rad_s: float = Field(default=7.0, gt=0, description="no arm moves faster")


class ExposureConfig(StrictModel):
    """Grey levels range from 0 to 255."""

    min_bright_level: float = Field(
        default=34.0, ge=0, le=255, description="95th percentile of the levels; a darker picture shows nothing"
    )
    max_white_share: float = Field(
        default=0.45, gt=0, le=1, description="share of pixels at 245 or above; more is overexposed"
    )
    min_bright_level_wrist: float = Field(
        default=12.0, ge=0, le=255, description="the same for a wrist camera, which a grasped object may cover"
    )
    max_white_share_wrist: float = Field(
        default=0.8, gt=0, le=1, description="the same for a wrist camera, which may look at a white table alone"
    )
    max_bad_share: float = Field(default=0.5, gt=0, le=1, description="with more bad frames the view is unusable")


class BlurConfig(StrictModel):
    """Sharpness is the variance of the Laplacian of the luma (0..255) at the image's own size."""

    min_sharpness: float = Field(
        default=8.0, ge=0, description="less is out of focus, whatever the rest of the episode is like"
    )
    min_relative: float = Field(
        default=0.25,
        ge=0,
        lt=1,
        description="sharpness relative to image detail, as a ratio to the episode's 75th percentile",
    )
    min_relative_wrist: float = Field(
        default=0.1, ge=0, lt=1, description="the same for a wrist camera, whose images smear when the arm moves fast"
    )
    min_run_s: float = Field(default=0.25, ge=0, description="shorter stretches are motion blur")
    max_bad_share: float = Field(default=0.5, gt=0, le=1, description="with more bad frames the view is unusable")


class CorruptedConfig(StrictModel):
    """Grey levels range from 0 to 255."""

    min_contrast: float = Field(
        default=4.0, gt=0, description="standard deviation over the image; less is a blank frame"
    )
    max_roughness: float = Field(
        default=0.5, gt=0, lt=1, description="1 - correlation of adjacent pixels; more is noise"
    )
    max_detail_rise: float = Field(
        default=1.42,
        gt=1,
        description="factor by which detail rises and falls within one frame; more is misplaced blocks",
    )
    max_flat_rise: float = Field(
        default=0.15, gt=0, lt=1, description="the same for the share of rows at an edge that have one grey level"
    )
    min_garbled_change: float = Field(
        default=6.0,
        ge=0,
        description="mean image change when garbage appears and disappears; less is an arm that moves",
    )
    max_garbled_s: float = Field(default=1.25, gt=0, description="what stays longer is a changed scene")
    max_frozen_change: float = Field(
        default=0.02,
        ge=0,
        description="mean absolute change below which frames are the same; a camera over a plain table shows 0.05",
    )
    min_frozen_motion_m: float = Field(
        default=0.05, gt=0, description="a view is frozen when a tool moves this far while the images stay the same"
    )
    min_frozen_motion_wrist_m: float = Field(
        default=0.2,
        gt=0,
        description="the same for a wrist camera, which may pass over a plain table without visible change",
    )
    min_frozen_frames: int = Field(default=4, ge=2)
    max_bad_share: float = Field(default=0.5, gt=0, le=1, description="with more bad frames the view is unusable")


class BaseMotionConfig(StrictModel):
    """Measured on images 96 pixels wide, in cells of 8 x 8 pixels."""

    lag_s: float = Field(default=0.5, gt=0, description="time between the two compared frames")
    min_level_change: float = Field(default=6.0, gt=0, lt=255, description="grey levels; smaller is noise")
    min_changed_area: float = Field(
        default=0.64, gt=0, le=1, description="share of cells that change within the lag in base motion"
    )
    min_run_s: float = Field(default=1.0, gt=0, description="shorter stretches are a passer-by or a quick arm")
    max_moving_share: float = Field(
        default=0.8, gt=0, le=1, description="a larger share of frames with base motion drops the episode"
    )


class TimeAlignmentConfig(StrictModel):
    """Lags in seconds; positive means that the images come after the states."""

    max_lag_s: float = Field(default=0.19, gt=0, description="a larger lag excludes the episode from Stage II")
    search_s: float = Field(default=0.8, gt=0)
    min_correlation: float = Field(
        default=0.75, gt=0, lt=1, description="at the best lag; a lower one is no evidence of a lag"
    )
    min_gain: float = Field(default=0.12, ge=0, description="of the correlation at the best lag over that at lag 0")
    max_pose_lag_s: float = Field(
        default=0.1, gt=0, description="a larger shift between camera poses and states excludes it as well"
    )
    min_pose_gain_m: float = Field(
        default=0.004, ge=0, description="a smaller gain of the hand-eye residual is no evidence of a shift"
    )
    max_rigid_residual_m: float = Field(
        default=0.012, gt=0, description="largest hand-eye residual at the best shift for which it is trusted"
    )


class CalibrationConfig(StrictModel):
    """Lengths in metres, angles in degrees."""

    min_field_of_view_deg: float = Field(default=15.0, gt=0)
    max_field_of_view_deg: float = Field(default=150.0, lt=180)
    max_principal_point_offset: float = Field(
        default=0.25, gt=0, description="from the image centre, share of the image side"
    )
    max_rotation_residual: float = Field(default=1e-3, gt=0, description="largest entry of R R^T - I")
    max_hand_eye_m: float = Field(
        default=0.012, gt=0, description="deviation of a wrist camera from its mount (95th percentile)"
    )
    max_hand_eye_deg: float = Field(default=6.0, gt=0)
    max_mount_offset_m: float = Field(default=0.08, gt=0, description="from the mount that the embodiment states")
    max_mount_offset_deg: float = Field(default=20.0, gt=0)


class ProjectionConfig(StrictModel):
    """Lengths are fractions of the image width, so that they hold at any resolution."""

    min_inside_share: float = Field(
        default=0.5, gt=0, le=1, description="share of frames in which at least one tool is inside the task-facing view"
    )
    radius: float = Field(default=0.07, gt=0, description="disc around the tool in which change is looked for")
    min_step: float = Field(default=0.012, gt=0, description="projected motion per frame that must be visible")
    min_moving_frames: int = Field(default=5, ge=1, description="with fewer the contrast is not judged")
    min_contrast: float = Field(
        default=1.6, gt=0, description="median ratio of the change near the tool to that of the whole image"
    )


class FilterDoctorConfig(CalibrationDoctorConfig):
    """The doctor's thresholds, with a cheaper search: other conventions are tried only where the recorded ones look
    wrong, and of a long recording only a part is used."""

    search: Literal["always", "when_suspicious"] = "when_suspicious"
    rate_hz: float = Field(
        default=8.0,
        gt=0,
        description="frames per second that are compared: at 30 Hz an arm moves less than a pixel of a small image per "
        "frame, and a lag of a tenth of a second is more frames than are tried",
    )
    max_frames: int = Field(
        default=40, ge=17, description="at that rate; of a longer recording the part with most motion"
    )


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
