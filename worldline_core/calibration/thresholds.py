"""Thresholds of the calibration doctor: what users may change (`CalibrationDoctorConfig`), then what is fixed.

Terms of a score are log-likelihoods: 0 is as a healthy recording typically is, lower is worse.
"""

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
    hand_eye_m: float = Field(default=0.002, gt=0, description="hand-eye residual of a camera that is mounted")
    hand_eye_deg: float = Field(default=0.7, gt=0)
    max_hand_eye_m: float = Field(default=0.012, gt=0, description="a larger residual is bad, whatever the reading")
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


# The decision
PAIRED_MISTAKES = 4
"""Of the mistakes that explain most alone, each two are tried together."""
MIN_TRAVEL_M = 0.02
"""A tool that moves less over the episode leaves no trace of a mistake."""

# Poses: limits of single terms, and the places where cameras and tools can be
WORST_TERM, WORST_HAND_EYE_TERM, WORST_FACING_TERM, WORST_TURN_TERM = -40.0, -60.0, -15.0, -12.0
FOLLOWS_COMMANDS_COST = 2.0
"""Of camera poses that follow the commands rather than the states."""
FACING_DEG, FACING_SPREAD_DEG = 45.0, 10.0
"""Between a wrist camera's axis and the direction to its tool."""

# Pictures
STILL_CHANGE = 4.0
"""Grey levels: compression and sensor noise stay below."""
MIN_STEP_PX = 0.7
"""Predicted motion of a cell that flow is compared with."""
FOLLOWS_CORRELATION = 0.5
"""Above it an angle between measured and predicted flow means something."""
METRES_PER_RADIAN = 0.15
"""A wrist camera that turns by one radian shows about as much change as one that goes this far."""
INVERSE_DEPTHS_PER_M = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)
"""Of the scene before a wrist camera, tried one by one."""
MIN_TEXTURE, MIN_CHANGE = 4.0, 5.0
"""Grey levels: where flow can be measured, and where there is any."""
LARGEST_FLOW_ERROR_PX = 8.0

# Grippers
MIN_OPENING_RANGE = 0.12
"""Over the episode: a smaller one moves no finger visibly, and noise stays below."""
MIN_OPENING_STEP = 0.02
"""Per frame, of a gripper that moves."""
FINGER_REACH_M, FINGER_LENGTH_M = 0.06, 0.12
STOPPED_GAP, STOPPED_STEP = 0.1, 0.01
"""A stopped gripper: opening away from its command by more, and changing by less per frame."""
FULL_CHANGE = 20.0
"""Grey levels from which a cell has its whole weight."""
MIN_FINGER_STEP_PX = 0.15
STOPPED_TERM, LARGEST_DEVIATIONS = -10.0, 4.0

# Numbers estimated for a mistake
INTRINSICS_SNAP, SAME_INTRINSICS_SIZE = 0.02, 0.1
"""Relative distance within which a usual image size is taken; log distance within which the size is as recorded."""
MIN_TOOL_OFFSET_M, MAX_TOOL_OFFSET_M = 0.01, 0.5

# Remarks
COMMANDS_FIT_RATIO, NOTICEABLE_M = 3.0, 0.001
"""Camera poses follow the commands when their residual against the states is larger by this ratio, and noticeable."""
