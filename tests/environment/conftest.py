"""The shipped simulator and the recordings of one robot that its episodes begin at."""

from __future__ import annotations

from pathlib import Path

import pytest

from worldline_core import WorldLine
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.rollout.recorded_starts import RecordedStarts


@pytest.fixture(scope="session")
def shipped(project_root: Path) -> Path:
    return project_root / "artifacts" / "shipped"


@pytest.fixture(scope="session")
def world(shipped: Path) -> WorldLine:
    return WorldLine.from_pretrained(shipped / "models" / "causal")


@pytest.fixture(scope="session")
def starts(shipped: Path) -> RecordedStarts:
    recordings = shipped / "recordings"
    return RecordedStarts(recordings, embodiment="ur5e_silver", splits=("test",), view_sets=[VIEWS], fps=8.0)
