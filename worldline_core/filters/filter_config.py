"""Thresholds of all detectors, one section each, and where a source needs others. docs/filters.md explains them."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import ConfigDict, Field, JsonValue, model_validator

from worldline_core.config import StrictModel, merged, validate
from worldline_core.errors import ConfigError

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(gt=0, lt=1)]
Share = Annotated[float, Field(gt=0, le=1)]
GreyLevel = Annotated[float, Field(ge=0, le=255)]


class Thresholds(StrictModel):
    """The text below a field is its description, also where a form is built from the model."""

    model_config = ConfigDict(use_attribute_docstrings=True)


class StaticConfig(Thresholds):
    """A stretch is static when all three stay below their thresholds."""

    max_joint_speed_rad_s: Positive = 0.03
    """range of a joint within half a second, as a speed: encoder noise hardly counts"""
    max_gripper_speed_per_s: Positive = 0.05
    max_image_change: Positive = 0.6
    """mean absolute change per frame of the image reduced by four, in grey levels of 255"""
    min_run_s: Positive = 1.5
    """shorter pauses are part of manipulation"""


class ResetConfig(Thresholds):
    """A reset returns most of the way to the first pose within a moment, faster than the episode moves otherwise, and by
    more than one joint."""

    min_jump_rad: Positive = 0.15
    """a shorter return is jitter"""
    home_share: Fraction = 0.2
    """distance to the first pose after the return, relative to before it"""
    max_return_s: Positive = 0.7
    """a slower return is motion like any other"""
    min_relative_step: float = Field(default=1.15, ge=1)
    """speed of a return within one frame, relative to the episode's other steps (90th percentile)"""
    min_relative_speed: float = Field(default=1.7, ge=1)
    """mean speed of a longer return, relative to the same"""


class JointMotionConfig(Thresholds):
    """Joint positions in radians. Arms of this size reach 2 to 4 rad/s (Panda 2.6, UR5e and xArm 3.1, ViperX 3.1)."""

    min_jump_rad: Positive = 0.3
    """smaller steps from frame to frame are not jumps, smaller commands not obeyed do not show that a joint is stuck"""
    min_relative_step: float = Field(default=3.0, gt=1)
    """ratio of a jump to the largest other step of the joint within four frames"""
    max_speed_rad_s: Positive = 7.0
    """no arm moves faster"""


class ExposureConfig(Thresholds):
    """Grey levels range from 0 to 255."""

    min_bright_level: GreyLevel = 34.0
    """95th percentile of the levels; a darker picture shows nothing"""
    max_white_share: Share = 0.45
    """share of pixels at 245 or above; more is overexposed"""
    min_bright_level_wrist: GreyLevel = 12.0
    """the same for a wrist camera, which a grasped object may cover"""
    max_white_share_wrist: Share = 0.8
    """the same for a wrist camera, which may look at a white table alone"""
    max_bad_share: Share = 0.5
    """with more bad frames the view is unusable"""


class BlurConfig(Thresholds):
    """Sharpness is the variance of the Laplacian of the luma (0..255) at the curated size, or at the recorded one where
    curation enlarged the pictures."""

    min_sharpness: NotNegative = 8.0
    """less is out of focus, whatever the rest of the episode is like"""
    min_relative: float = Field(default=0.25, ge=0, lt=1)
    """sharpness relative to image detail, as a ratio to the episode's 75th percentile"""
    min_relative_wrist: float = Field(default=0.1, ge=0, lt=1)
    """the same for a wrist camera, whose images smear when the arm moves fast"""
    min_run_s: NotNegative = 0.25
    """shorter stretches are motion blur"""
    max_bad_share: Share = 0.5
    """with more bad frames the view is unusable"""


class CorruptedConfig(Thresholds):
    """Grey levels range from 0 to 255."""

    min_contrast: Positive = 4.0
    """standard deviation over the image; less is a blank frame"""
    max_roughness: Fraction = 0.5
    """1 - correlation of adjacent pixels; more is noise"""
    max_detail_rise: float = Field(default=1.42, gt=1)
    """factor by which detail rises and falls within one frame; more is misplaced blocks"""
    max_flat_rise: Fraction = 0.15
    """the same for the share of rows at an edge that have one grey level"""
    min_garbled_change: NotNegative = 6.0
    """mean image change when garbage appears and disappears; less is an arm that moves"""
    max_garbled_s: Positive = 1.25
    """what stays longer is a changed scene"""
    max_frozen_change: NotNegative = 0.02
    """mean absolute change below which frames are the same; a camera over a plain table shows 0.05"""
    min_frozen_motion_m: Positive = 0.05
    """a view is frozen when a tool moves this far while the images stay the same"""
    min_frozen_motion_wrist_m: Positive = 0.2
    """the same for a wrist camera, which may pass over a plain table without visible change"""
    min_frozen_frames: int = Field(default=4, ge=2)
    max_bad_share: Share = 0.5
    """with more bad frames the view is unusable"""


class BaseMotionConfig(Thresholds):
    """Measured on images 96 pixels wide, in cells of 8 x 8 pixels."""

    lag_s: Positive = 0.5
    """time between the two compared frames"""
    min_level_change: float = Field(default=6.0, gt=0, lt=255)
    """grey levels; smaller is noise"""
    min_changed_area: Share = 0.64
    """share of cells that change within the lag in base motion"""
    min_run_s: Positive = 1.0
    """shorter stretches are a passer-by or a quick arm"""
    max_moving_share: Share = 0.8
    """a larger share of frames with base motion drops the episode"""


class TimeAlignmentConfig(Thresholds):
    """Lags in seconds; positive means that the images come after the states."""

    max_lag_s: Positive = 0.19
    """a larger lag excludes the episode from Stage II"""
    search_s: Positive = 0.8
    min_correlation: Fraction = 0.75
    """at the best lag; a lower one is no evidence of a lag"""
    min_gain: NotNegative = 0.12
    """of the correlation at the best lag over that at lag 0"""
    max_pose_lag_s: Positive = 0.1
    """a larger shift between camera poses and states excludes it as well"""
    min_pose_gain_m: NotNegative = 0.004
    """a smaller gain of the hand-eye residual is no evidence of a shift"""
    max_rigid_residual_m: Positive = 0.012
    """largest hand-eye residual at the best shift for which it is trusted"""


class CalibrationConfig(Thresholds):
    """Lengths in metres, angles in degrees."""

    min_field_of_view_deg: Positive = 15.0
    max_field_of_view_deg: float = Field(default=150.0, lt=180)
    max_principal_point_offset: Positive = 0.25
    """from the image centre, share of the image side"""
    max_rotation_residual: Positive = 1e-3
    """largest entry of R R^T - I"""
    max_hand_eye_m: Positive = 0.012
    """deviation of a wrist camera from its mount (95th percentile)"""
    max_hand_eye_deg: Positive = 6.0
    max_mount_offset_m: Positive = 0.08
    """from the mount that the embodiment states"""
    max_mount_offset_deg: Positive = 20.0


class ProjectionConfig(Thresholds):
    """Lengths are fractions of the image width, so that they hold at any resolution."""

    min_inside_share: Share = 0.5
    """share of frames in which at least one tool is inside the task-facing view"""
    radius: Positive = 0.07
    """disc around the tool in which change is looked for"""
    min_step: Positive = 0.012
    """projected motion per frame that must be visible"""
    min_moving_frames: int = Field(default=5, ge=1)
    """with fewer neither contrast nor rank is judged"""
    min_contrast: Positive = 1.6
    """median ratio of the change near the tool to that of the whole image"""
    min_rank: Share = 0.62
    """median rank of the change near the tool in that of the whole image (0.5 by chance): instead of the contrast, which
    cannot be large where much of the image moves"""


class FilterDoctorConfig(Thresholds):
    """The part of a recording that the calibration doctor looks at."""

    rate_hz: Positive = 8.0
    """frames per second that are compared: at 30 Hz an arm moves less than a pixel of a small image per frame, and a
    lag of a tenth of a second is more frames than are tried"""
    max_frames: int = Field(default=40, ge=17)
    """at that rate; of a longer recording the part with most motion"""


class FilterConfig(Thresholds):
    """Thresholds of all detectors.

    `sources` holds what differs for the episodes of one source, in the same form:
    `{agibot_world: {static: {min_run_s: 2}}}`. Everything that is not named there stays as it is for all.
    """

    required_views: tuple[str, ...] = ()
    """views without which an episode is not for Stage II"""
    min_segment_frames: int = Field(default=17, ge=2)
    """shorter stretches are dropped"""
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
        values = merged(self.model_dump(mode="json", exclude={"sources"}), overrides)
        return validate(FilterConfig, values, where=f"filter.sources.{name}")
