"""Ways to damage an HDF5 file, and the check that a damaged recording costs itself alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_set import EpisodeSet

Damage = Callable[[Path], object]


def edit(change: Callable[[Any], object]) -> Damage:
    def apply(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            change(file)

    return apply


def replaced(key: str, make: Callable[[np.ndarray], Any]) -> Damage:
    def change(file: Any) -> None:
        values = make(file[key][()])
        del file[key]
        file[key] = values

    return edit(change)


def without(key: str) -> Damage:
    return edit(lambda file: file.__delitem__(key))


def with_nan(values: np.ndarray) -> np.ndarray:
    values = values.astype(float)
    values[2] = np.nan
    return values


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def kept_beside(source: dict[str, Any], output: Path, reason: str) -> str:
    """Curate a damaged recording and its sound neighbour; returns the neighbour's id."""
    counts = curate(CurateConfig.model_validate({"sources": [source]}), {}, output)
    assert (counts["found"], counts["kept"], counts["reasons"]) == (2, 1, {reason: 1})
    return EpisodeSet.open(output).rows[0].episode_id
