"""A corpus of corrupted recordings, what is true about each, and how well curation and filters tell it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tools.corrupted import droid_annotation, lerobot_v21, mcap
from tools.corrupted.defects import Label
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_index import read_index, read_quarantine

LAYOUTS = (lerobot_v21, droid_annotation, mcap)


Outcome = tuple[str, str]
"""Stage that left a recording out (curate, filter) or kept, and the reason code ("" for kept)."""


def write_corpus(folder: Path, *, healthy: int, each: int, seed: int) -> tuple[list[Label], CurateConfig]:
    """Write a corpus at folder/corpus: of each layout `healthy` clean recordings and `each` of every kind."""
    root = folder / "corpus"
    root.mkdir(parents=True)
    random = np.random.default_rng(seed)
    labels: list[Label] = []
    sources: list[dict[str, Any]] = []
    for module in LAYOUTS:
        found, source = module.write(root / module.__name__.rsplit(".", 1)[1], healthy, each, random)
        labels += found
        sources.append(source)
    return labels, CurateConfig.model_validate({"sources": sources})


def outcomes(curated: Path, filtered: Path) -> dict[str, Outcome]:
    """By episode id, from the artifacts of curation and of the filters.

    A recording that Stage II alone leaves out counts as kept: the synthetic ones have no calibration that fits.
    """
    found: dict[str, Outcome] = {row.episode_id: ("curate", row.reason) for row in read_quarantine(curated)}
    for row in read_index(filtered):
        found.setdefault(row.episode_id.split("@0")[0], ("kept", ""))
    return found | {row.episode_id: ("filter", row.reason) for row in read_quarantine(filtered)}


def is_right(label: Label, outcome: Outcome | None) -> bool:
    """True if the right stage rejects the recording, with a code that names the defect."""
    stage, reason = outcome or ("lost", "")
    return stage == label.stage and (stage == "kept" or reason in label.reasons)


def confusion(labels: Sequence[Label], found: Mapping[str, Outcome]) -> dict[tuple[str, str], Counter[str]]:
    """(layout, kind) -> how many of its recordings ended as what ("kept", or "stage: reason")."""
    table: dict[tuple[str, str], Counter[str]] = {}
    for label in labels:
        stage, reason = found.get(label.episode_id, ("lost", ""))
        table.setdefault((label.layout, label.kind), Counter())[f"{stage}: {reason}" if reason else stage] += 1
    return table
