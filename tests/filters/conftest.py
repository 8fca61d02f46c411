"""A healthy shipped recording, which tests spoil."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tools.labelled_clips import Clip
from worldline_core.data.episodes.episode_set import EpisodeSet


@pytest.fixture(scope="session")
def recording(project_root: Path) -> Clip:
    episodes = EpisodeSet.open(project_root / "artifacts" / "shipped" / "recordings")
    i = episodes.position("ur5e_silver-test-s1-00002")
    masks = {view: np.asarray(episodes.robot_masks(i, view)) for view in episodes.rows[i].views}
    return Clip(episodes.episode(i), {view: episodes.frames(i, view) for view in masks}, masks)
