"""Thresholds of the calibration doctor."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from worldline_core.config import StrictModel


class Typical(StrictModel):
    """A correlation that healthy recordings reach, and how many independent samples it stands for."""

    value: float = Field(gt=0, lt=1)
    samples: float = Field(gt=0)


class Spread(StrictModel):
    """A correlation that healthy recordings reach, and how much it scatters."""

    value: float = Field(gt=0, lt=1)
    spread: float = Field(gt=0)


class CalibrationDoctorConfig(StrictModel):
    """Lengths in metres, angles in degrees, scores in units of log-likelihood.

    The typical values are medians over the healthy training episodes of the shipped recordings
    (`benchmarks/calibration_doctor.py --typical` prints them); they hold for other recordings as far as these
    resemble them, so the decisions rest on differences between readings.
    """

    search: Literal["always", "when_suspicious"] = Field(
        default="always", description="when_suspicious: try other readings only if the recorded one looks bad"
    )
    min_margin: float = Field(default=2.5, gt=0, description="by which a mistake must beat the recording as written")
    max_gain: float = Field(
        default=20.0, gt=0, description="that one episode can lend to a reading of its whole source"
    )
    min_term: float = Field(
        default=-9.0, lt=0, description="a pose term below this is bad: no healthy recording has one"
    )
    min_flow: float = Field(default=0.6, gt=0, lt=1, description="agreement of arm flow below which it is bad")
    flow_turn_deg: float = Field(
        default=8.0, gt=0, description="spread of the angle between measured and predicted flow"
    )
    max_flow_turn_deg: float = Field(default=25.0, gt=0, description="a larger angle is bad")
    suspicion: float = Field(default=-4.0, lt=0, description="a term below this starts the search")
    complexity: float = Field(default=2.0, ge=0, description="cost of a reading that departs from the contract")
    max_lag_frames: int = Field(default=6, ge=1, le=60)
    samples: float = Field(default=20.0, gt=0, description="independent frames that a hand-eye residual stands for")
    hand_eye_m: float = Field(default=0.002, gt=0, description="unrest of a mounted camera that means nothing")
    hand_eye_deg: float = Field(default=0.7, gt=0)
    max_hand_eye_m: float = Field(default=0.012, gt=0, description="more unrest, whatever the reading, is bad")
    mount_m: float = Field(default=0.01, gt=0, description="spread of cameras around the stated mount")
    mount_deg: float = Field(default=3.0, gt=0)
    kinematics_m: float = Field(default=0.005, gt=0, description="spread of recorded poses around forward kinematics")
    kinematics_deg: float = Field(default=2.0, gt=0)
    principal_point: float = Field(default=0.03, gt=0, description="spread around the image centre, share of the side")
    max_reach_m: float = Field(default=2.5, gt=0, description="of a tool from its base")
    max_camera_m: float = Field(default=5.0, gt=0, description="of a camera from the base")
    max_wrist_camera_m: float = Field(default=0.5, gt=0, description="of a wrist camera from its tool")
    min_image_pairs: int = Field(default=8, ge=2, description="fewer pictures are no evidence")
    arm_flow: Typical = Typical(value=0.92, samples=20)
    arm_change: Typical = Typical(value=0.74, samples=20)
    tool_flow: Typical = Typical(value=0.96, samples=14)
    tool_change: Typical = Typical(value=0.5, samples=14)
    wrist_flow: Typical = Typical(value=0.55, samples=12)
    wrist_energy: Typical = Typical(value=0.8, samples=8)
    fingers: Spread = Spread(value=0.75, spread=0.4)
    finger_links: Spread = Spread(value=0.5, spread=0.3)
