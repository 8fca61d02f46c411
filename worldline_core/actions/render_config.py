"""What `render_actions` projects, and how much it draws."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from worldline_core.actions.action_maps import SIGMA_PX_REFERENCE
from worldline_core.config import StrictModel


class RenderActionsConfig(StrictModel):
    """What is projected, and how much is drawn.

    Attributes:
        source: `action` projects the commands (what a simulator is driven by), `state` the measured joints.
        without_mount: what wrist cameras without a known mount follow.
        description_paths: by embodiment, a kinematic description that is the user's own file.
        preview_height: of one view in the previews, pixels; small frames are enlarged by a whole factor up to it.
        sigma_px_ref: of the heat in the previews, pixels on the 384 x 512 reference canvas.
    """

    source: Literal["action", "state"] = "action"
    without_mount: Literal["recorded", "first_frame_mount"] = "recorded"
    description_paths: dict[str, str] = Field(default_factory=dict)
    previews: int = Field(3, ge=0)
    preview_height: int = Field(256, ge=32)
    preview_rows: int = Field(4, ge=1)
    sigma_px_ref: float = Field(SIGMA_PX_REFERENCE, gt=0)
    episodes_per_shard: int = Field(256, ge=1)
