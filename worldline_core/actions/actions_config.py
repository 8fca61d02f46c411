"""Configuration of action tracks and previews, and constants of all action maps; free of torch."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from worldline_core.config import StrictModel

SIGMA_PX_REFERENCE = 10.0
REFERENCE_CANVAS = (384, 512)
TEMPORAL_FACTOR = 4


class RenderActionsConfig(StrictModel):
    """Choice of the projected controls, and number of the previews.

    Attributes:
        source: `action` projects the commands (what a simulator is driven by) through kinematics, and refuses an episode
            without commands; `state` the measured joints, or the recorded tool poses where there are any.
        without_mount: what wrist cameras without a known mount follow.
        description_paths: by embodiment, a kinematic description that is the user's own file.
        sigma_px_ref: width of the Gaussian, pixels on the 384 x 512 reference canvas: in the previews, and in the
            action maps of every model that is trained on these tracks. Coarse latent grids need more than the paper's
            10, or a point between two cells vanishes.
    """

    source: Literal["action", "state"] = "action"
    without_mount: Literal["recorded", "first_frame_mount"] = "recorded"
    description_paths: dict[str, str] = Field(default_factory=dict)
    previews: int = Field(3, ge=0)
    sigma_px_ref: float = Field(SIGMA_PX_REFERENCE, gt=0)
    episodes_per_shard: int = Field(256, ge=1)
