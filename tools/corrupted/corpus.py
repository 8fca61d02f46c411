"""A corpus of corrupted recordings, what is true about each, and how well curation and filters tell it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tools.corrupted import droid_annotation, lerobot_v21, mcap
from tools.corrupted.defects import Label, Source
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_index import read_index, read_quarantine


def write_corpus(folder: Path, *, healthy: int, each: int, seed: int) -> tuple[list[Label], CurateConfig]:
    """Write a corpus at folder/corpus: of each layout `healthy` clean recordings and `each` of every kind."""
    root = folder / "corpus"
    root.mkdir(parents=True)
    random = np.random.default_rng(seed)
    labels, sources = list[Label](), list[Source]()
    for module in (lerobot_v21, droid_annotation, mcap):
        found, source = module.write(root / module.__name__.rsplit(".", 1)[1], healthy, each, random)
        labels += found
        sources.append(source)
    return labels, CurateConfig.model_validate({"sources": sources})


def outcomes(curated: Path, filtered: Path) -> dict[str, str]:
    """Outcome of each episode, from the artifacts of curation and of the filters.

    A recording that Stage II alone leaves out counts as kept: the synthetic ones have no calibration that fits.
    """
    found = {row.episode_id: f"curate: {row.reason}" for row in read_quarantine(curated)}
    for row in read_index(filtered):
        found.setdefault(row.episode_id.split("@0")[0], "kept")
    return found | {row.episode_id: f"filter: {row.reason}" for row in read_quarantine(filtered)}
