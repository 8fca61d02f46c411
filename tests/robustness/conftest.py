from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tools.corrupted import lerobot_v21
from tools.corrupted.one_of_each import write_one_of_each
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.video.encoder import encode_video


@pytest.fixture(scope="session")
def layouts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """A small recording of every layout, by its name: the entry of `curate.sources` that reads it."""
    pytest.importorskip("h5py", reason="the extra `hdf5` is not installed")
    return write_one_of_each(tmp_path_factory.mktemp("layouts"))


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Nine frames of 32 x 48."""
    ramp = np.arange(9)[:, None, None, None] * 20 + np.zeros((9, 32, 48, 3))
    path = tmp_path / "video.mp4"
    encode_video(path, ramp.astype(np.uint8), 8.0, preset="ultrafast")
    return path


@pytest.fixture
def dataset(tmp_path: Path) -> Callable[[int], tuple[Path, CurateConfig]]:
    """A healthy LeRobot v2.1 dataset of some episodes, and the configuration that reads it."""

    def make(episodes: int) -> tuple[Path, CurateConfig]:
        root = tmp_path / "corpus" / "set"
        _, source = lerobot_v21.write(root, episodes, 0, np.random.default_rng(episodes))
        return root, CurateConfig.model_validate({"sources": [source]})

    return make
