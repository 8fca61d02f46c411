"""What the report shows."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from worldline_core.config import StrictModel


class ReportConfig(StrictModel):
    """What the report shows."""

    title: str = Field(default="WorldLine: from robot recordings to an action-driven simulator", min_length=1)
    subtitle: str = (
        "What was recorded, kept, trained, predicted and chosen in this run, and how well: measured, with intervals."
    )
    primary_method: str | None = Field(
        default=None,
        description="the method whose numbers head the page; none: the long-trained Stage II, else this run's",
    )
    tile_height: int = Field(
        default=256, ge=32, le=1080, description="height of one video in a side-by-side video, pixels"
    )
    upscale: Literal["lanczos", "nearest"] = "lanczos"
    max_columns: int = Field(
        default=6, ge=2, le=12, description="columns of a side-by-side video, the truth among them"
    )
    contact_sheet_rows: int = Field(default=12, ge=1, le=64)
    overlay_episodes: int = Field(default=4, ge=1, le=32)
    rerun: bool = Field(default=True, description="write a Rerun recording of every episode shown")
    mcap: bool = Field(default=True, description="write MCAP files of every episode shown")
