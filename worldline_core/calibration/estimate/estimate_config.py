"""Configuration of the task that estimates cameras. Without torch."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Self

from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode import NO_EMBODIMENT
from worldline_core.data.guards.reader_process import ReaderLimits
from worldline_core.data.sources.open import SourceConfig

CAMERAS = "cameras.json"
"""The calibration file in the task's artifact; not there where no camera is sure."""
ESTIMATE = "estimate.json"
"""Everything that was estimated, with intervals and reasons."""


class EstimateConfig(StrictModel):
    """One source, and files of robots' kinematic descriptions by their names, as `render_actions` takes them."""

    source: SourceConfig
    description_paths: dict[str, str] = Field(default_factory=dict)
    reader: ReaderLimits = ReaderLimits()

    @classmethod
    def of(cls, curate: CurateConfig, description_paths: Mapping[str, str]) -> Self | None:
        """Settings for recordings whose robot is described and whose source names no calibration file; None for all others."""
        source = curate.sources[0]
        robot = getattr(source, "embodiment", NO_EMBODIMENT)
        if len(curate.sources) > 1 or getattr(source, "calibration", "") is not None or robot == NO_EMBODIMENT:
            return None
        return cls(source=source, description_paths=dict(description_paths), reader=curate.reader)

    def weights_read(self) -> Mapping[str, Path | None]:
        return CurateConfig(sources=(self.source,)).weights_read()
