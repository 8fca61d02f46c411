"""The shipped simulator and the recordings of one robot that its episodes begin at."""

import pytest

from tests.rollout.conftest import shipped, small_world  # noqa: F401
from worldline_core import WorldLine
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.rollout.recorded_starts import RecordedStarts


@pytest.fixture(scope="session")
def world(shipped):  # noqa: F811
    return WorldLine.from_pretrained(shipped / "models" / "causal")


@pytest.fixture(scope="session")
def starts(shipped):  # noqa: F811
    recordings = shipped / "recordings"
    return RecordedStarts(recordings, embodiment="ur5e_silver", splits=("test",), view_sets=[VIEWS], fps=8.0)
