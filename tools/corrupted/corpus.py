"""A corpus of corrupted recordings, what is true about each, and how well curation and filters tell it."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tools.corrupted import agibot_world, droid_annotation, lerobot_v21, mcap, recordings
from tools.corrupted.labels import SECOND, Label
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_index import read_index, read_quarantine
from worldline_core.store.atomic import write_json_atomic

LABELS_FILE = "labels.json"
CONFIG_FILE = "curate.json"
_LAYOUTS = (lerobot_v21, agibot_world, droid_annotation, mcap)


@dataclass(frozen=True)
class Outcome:
    """What became of one recording: where it ended, and the code that says why ("" for kept)."""

    stage: str
    reason: str


def kinds_per_layout() -> int:
    """How many recordings one of every kind is, the project's own recordings left out."""
    return sum(module.KIND_COUNT for module in _LAYOUTS)


def write_corpus(
    folder: Path, *, healthy: int, each: int, seed: int, own_recordings: Path | None = None
) -> tuple[list[Label], CurateConfig]:
    """Write a corpus at folder/corpus: of each layout `healthy` clean recordings and `each` of every kind.

    Args:
        own_recordings: an EpisodeSet whose recordings are spoilt as well, each once; None leaves that layout out.
    """
    root = folder / "corpus"
    root.mkdir(parents=True)
    random = np.random.default_rng(seed)
    labels: list[Label] = []
    sources: list[dict[str, Any]] = []
    for module in _LAYOUTS:
        found, source = module.write(root / module.__name__.rsplit(".", 1)[1], healthy, each, random)
        ending = f"#source.{len(sources)}"
        labels += [replace(label, episode_id=label.episode_id.replace(SECOND, ending)) for label in found]
        sources.append(source)
    if own_recordings is not None:
        found, source = recordings.write(root / "recordings", healthy, each, random, own_recordings)
        labels += found
        sources.append(source)
    config = {"sources": sources}
    write_json_atomic(folder / LABELS_FILE, [asdict(label) for label in labels])
    write_json_atomic(folder / CONFIG_FILE, config)
    return labels, CurateConfig.model_validate(config)


def read_corpus(folder: Path) -> tuple[list[Label], CurateConfig]:
    """A corpus written earlier."""
    listed = json.loads((folder / LABELS_FILE).read_text())
    labels = [Label(**{**row, "reasons": tuple(row["reasons"])}) for row in listed]
    return labels, CurateConfig.model_validate_json((folder / CONFIG_FILE).read_text())


def outcomes(curated: Path, filtered: Path | None) -> dict[str, Outcome]:
    """By episode id, from the artifacts of curation and of the filters."""
    result = {row.episode_id: Outcome("curate", row.reason) for row in read_quarantine(curated)}
    for row in read_index(curated if filtered is None else filtered):
        stage2 = Outcome("stage2", row.stage2_reason or "") if not row.stage2_ok else Outcome("kept", "")
        result.setdefault(row.episode_id.split("@0")[0] if filtered is not None else row.episode_id, stage2)
    for row in read_quarantine(filtered) if filtered is not None else ():
        result[row.episode_id] = Outcome("filter", row.reason)
    return result


def is_right(label: Label, outcome: Outcome | None) -> bool:
    """Whether the outcome tells the truth: the stage that has to find it, by a code that names it.

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


def shares_right(labels: Sequence[Label], found: Mapping[str, Outcome]) -> dict[tuple[str, str], float]:
    """(layout, kind) -> share of its recordings whose outcome is right."""
    right: dict[tuple[str, str], list[bool]] = {}
    for label in labels:
        right.setdefault((label.layout, label.kind), []).append(is_right(label, found.get(label.episode_id)))
    return {key: sum(values) / len(values) for key, values in right.items()}
