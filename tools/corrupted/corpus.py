"""A corpus of corrupted recordings, what is true about each, and how well curation and filters tell it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tools.corrupted import droid_annotation, lerobot_v21, mcap
from tools.corrupted.defects import SECOND, Label
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_index import read_index, read_quarantine

LAYOUTS = (lerobot_v21, droid_annotation, mcap)


@dataclass(frozen=True)
class Outcome:
    """Outcome of one recording: its stage, and the reason code ("" for kept)."""

    stage: str
    reason: str


def write_corpus(folder: Path, *, healthy: int, each: int, seed: int) -> tuple[list[Label], CurateConfig]:
    """Write a corpus at folder/corpus: of each layout `healthy` clean recordings and `each` of every kind."""
    root = folder / "corpus"
    root.mkdir(parents=True)
    random = np.random.default_rng(seed)
    labels: list[Label] = []
    sources: list[dict[str, Any]] = []
    for module in LAYOUTS:
        found, source = module.write(root / module.__name__.rsplit(".", 1)[1], healthy, each, random)
        ending = f"#source.{len(sources)}"
        labels += [replace(label, episode_id=label.episode_id.replace(SECOND, ending)) for label in found]
        sources.append(source)
    return labels, CurateConfig.model_validate({"sources": sources})


def outcomes(curated: Path, filtered: Path) -> dict[str, Outcome]:
    """By episode id, from the artifacts of curation and of the filters."""
    result = {row.episode_id: Outcome("curate", row.reason) for row in read_quarantine(curated)}
    for row in read_index(filtered):
        stage2 = Outcome("stage2", row.stage2_reason or "") if not row.stage2_ok else Outcome("kept", "")
        result.setdefault(row.episode_id.split("@0")[0], stage2)
    return result | {row.episode_id: Outcome("filter", row.reason) for row in read_quarantine(filtered)}


def is_right(label: Label, outcome: Outcome | None) -> bool:
    """True if the right stage rejects the recording, with a code that names the defect.

    A clean recording that Stage II alone leaves out is kept: the synthetic ones have no calibration that fits.
    """
    if outcome is None:
        return False
    if label.stage == "kept":
        return outcome.stage in ("kept", "stage2")
    return outcome.stage == label.stage and outcome.reason in label.reasons


def confusion(labels: Sequence[Label], found: Mapping[str, Outcome]) -> dict[tuple[str, str], Counter[str]]:
    """(layout, kind) -> how many of its recordings ended as what ("kept", or "stage: reason")."""
    table: dict[tuple[str, str], Counter[str]] = {}
    for label in labels:
        outcome = found.get(label.episode_id)
        shown = "lost" if outcome is None else outcome.stage + (f": {outcome.reason}" if outcome.reason else "")
        if outcome is not None and outcome.stage == "stage2" and label.stage == "kept":
            shown = "kept"
        table.setdefault((label.layout, label.kind), Counter())[shown] += 1
    return table
