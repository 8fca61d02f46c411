"""Rules over the whole set, once every episode has been read: duplicates, scenes on both sides of the split, leaks."""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from worldline_core.data.curation.curate_config import CurateConfig, DrawnSplits, LeakageConfig
from worldline_core.data.curation.recorded_episode import is_drawn
from worldline_core.data.episodes.episode import Split
from worldline_core.data.episodes.episode_index import QuarantineRow
from worldline_core.data.episodes.episode_set_writer import Part
from worldline_core.data.episodes.fingerprint import MINHASHES, MOMENTS, Fingerprint
from worldline_core.errors import DataError
from worldline_core.store.atomic import write_json_atomic

logger = logging.getLogger(__name__)

LEARNING = ("train", "validation")
TESTING = ("test", "ood_test")
CURATION_FILE = "curation.json"


type Described = Part | Mapping[str, Any]
"""A waiting episode, by the entries of its part.json."""


def decided_rows(config: CurateConfig, parts: Sequence[Described], output: Path) -> list[QuarantineRow]:
    """`curation_findings`, decided once: a run that is killed while episodes are taken out goes on by the same decision.

    Also writes curation.json: counts by reason, and the scenes that look like one.
    """
    decision = output / "run" / "selection.json"
    if not decision.is_file():
        rows, leaks = curation_findings(config, parts)
        found = {
            "rows": [asdict(row) for row in rows],
            "reasons": dict(Counter(row.reason for row in rows)),
            "scene_leaks": [asdict(leak) for leak in leaks],
            "leakage_action": config.leakage.action,
        }
        write_json_atomic(decision, found)
    found = json.loads(decision.read_text())
    rows = [QuarantineRow(**row) for row in found.pop("rows")]
    write_json_atomic(output / CURATION_FILE, found)
    return rows


def curation_findings(config: CurateConfig, parts: Sequence[Described]) -> tuple[list[QuarantineRow], list[SceneLeak]]:
    """Decide over all episodes at once.

    Args:
        parts: descriptions in the order in which the sources list them: of equal episodes the first is kept.

    Returns:
        Episodes to take out, in listed order, and the pairs of scenes that look like one across the split.

    Raises: DataError when a scene is both learnt from and tested on.
    """
    prints = [Fingerprint.from_json(part["fingerprint"]) for part in parts]
    rows: dict[int, QuarantineRow] = {}
    first: dict[str, int] = {}
    for position, seen in enumerate(prints):
        original = first.setdefault(seen.digest, position)
        if original != position:
            rows[position] = _repetition(
                parts[position], parts[original], "duplicate", "Same frames, states and actions as episode {}"
            )
    left = [position for position in range(len(parts)) if position not in rows]
    searched = [prints[position] for position in left] if config.near_duplicates else []
    for found in find_near_duplicates(searched):
        rows[left[found.position]] = _repetition(
            parts[left[found.position]],
            parts[left[found.original]],
            "near_duplicate",
            "The same recording as episode {}, encoded or cut another way",
            compared_with=parts[left[found.compared_with]]["episode_id"],
            motion_overlap=round(found.motion_overlap, 4),
            frame_distance_bits=round(found.frame_distance, 4),
        )
    kept = [position for position in range(len(parts)) if position not in rows]
    if isinstance(config.splits, DrawnSplits) and config.splits.by == "episode":
        return [rows[position] for position in sorted(rows)], []  # scenes are shared by intention
    check_scenes_disjoint([parts[position] for position in kept])
    views = [
        SceneView(part["episode_id"], part["scene"], part["split"], prints[position].views[part["primary_view"]].first)
        for position in kept
        if (part := parts[position])["primary_view"] in prints[position].views
    ]
    leaks = find_scene_leaks(views, config.leakage)
    if config.leakage.action == "quarantine":
        rows.update(_leaking(parts, kept, leaks))
    return [rows[position] for position in sorted(rows)], leaks


def drawn_episodes(splits: DrawnSplits, parts: Sequence[Described]) -> dict[str, Split]:
    """Splits by episode: shares of the set, spread evenly over its tasks and, within each, over outcomes.

    A share that is asked for is at least one episode. Neither the label of an outcome nor the order of ``parts`` matters,
    only who shares it.

    Raises: DataError when nothing is left to train on.
    """
    strata: dict[tuple[str, str], dict[str, list[str]]] = {}
    for part in parts:
        if is_drawn(part["scene"], part["split"], part["conventions"], splits):
            task = strata.setdefault((part["task_family"], part["instruction"]), {})
            task.setdefault(part["outcome"], []).append(part["episode_id"])

    def number(name: str) -> bytes:
        return sha256(f"{splits.seed}:{name}".encode()).digest()

    groups = [
        sorted((sorted(ids, key=number) for ids in task.values()), key=lambda g: number(g[0]))
        for _, task in sorted(strata.items())
    ]
    order = [name for task in groups for group in task for name in group]
    drawn: dict[str, Split] = {}
    drawn.update({name: "train" for name in order})  # noqa: C420  # whose values would be str
    counts: dict[Split, int] = {name: max(1, round(len(order) * share)) for name, share in _shares(splits) if order}
    if order and sum(counts.values()) >= len(order):
        raise DataError(
            "Too few episodes for the splits", where="curate.splits", expected=f"more than {sum(counts.values())}",
            got=len(order), next_step="record more, or set a share to 0",
        )  # fmt: skip
    for split, count in counts.items():
        left = [name for name in order if drawn[name] == "train"]
        drawn.update({left[(2 * k + 1) * len(left) // (2 * count)]: split for k in range(count)})
    return drawn


def check_held_out(config: CurateConfig, splits: Sequence[str], scenes: int) -> None:
    """Say, before anything is trained, that a set holds nothing out.

    Raises: DataError when a draw was asked for that holds something out.
    """
    if set(splits) != {"train"}:
        return
    if isinstance(config.splits, DrawnSplits) and any(_shares(config.splits)):
        raise DataError(
            "The draw holds nothing out",
            where="curate.splits",
            expected=", ".join(f"{name} {share}" for name, share in _shares(config.splits)),
            got=f"{len(splits)} of {len(splits)} episodes in train, of {scenes} scene{'s' * (scenes != 1)}",
            next_step="draw by: episode, or give scenes their splits by patterns",
        )
    logger.warning("All episodes are in split train: nothing is held out (curate.splits: {by: episode} draws some)")


def _shares(splits: DrawnSplits) -> list[tuple[Split, float]]:
    shares: list[tuple[Split, float]] = [("test", splits.test), ("validation", splits.validation)]
    return [(name, share) for name, share in shares if share > 0]


def check_scenes_disjoint(parts: Sequence[Described]) -> None:
    """Raises: DataError when a scene that is trained or validated on is also tested on."""
    scenes: dict[str, set[str]] = {}
    for part in parts:
        scenes.setdefault(part["split"], set()).add(part["scene"])
    for learning in LEARNING:
        for testing in TESTING:
            shared = sorted(scenes.get(learning, set()) & scenes.get(testing, set()))
            if shared:
                raise DataError(
                    f"Scenes are both in {learning} and in {testing}",
                    where="curate.splits",
                    expected="disjoint scenes",
                    got=", ".join(shared[:10]) + (" ..." if len(shared) > 10 else ""),
                    next_step="give each scene one split",
                )


def _row(part: Described, reason: str, detail: str, evidence: Mapping[str, Any]) -> QuarantineRow:
    return QuarantineRow(part["episode_id"], part["source"], reason, detail, json.dumps(dict(evidence), sort_keys=True))


def _repetition(part: Described, original: Described, reason: str, detail: str, **evidence: Any) -> QuarantineRow:
    """Names both splits where a copy is in another split than its original."""
    name = original["episode_id"]
    crossing = {"split": part["split"], "split_of_original": original["split"]}
    evidence |= {"duplicate_of": name} | (crossing if part["split"] != original["split"] else {})
    return _row(part, reason, detail.format(name), evidence)


def _leaking(parts: Sequence[Described], kept: Sequence[int], leaks: Sequence[SceneLeak]) -> dict[int, QuarantineRow]:
    """Training and validation episodes of scenes that are tested on under another name; test episodes stay."""
    by_scene: dict[str, SceneLeak] = {}
    for leak in sorted(leaks, key=lambda leak: (leak.distance, leak.testing_scene)):
        by_scene.setdefault(leak.learning_scene, leak)
    rows: dict[int, QuarantineRow] = {}
    for position in kept:
        part = parts[position]
        leak = by_scene.get(part["scene"])
        if leak is not None and part["split"] in LEARNING:
            detail = f"Scene {leak.learning_scene} looks like scene {leak.testing_scene}, which is tested on"
            rows[position] = _row(part, "scene_leak", detail, asdict(leak))
    return rows


@dataclass(frozen=True)
class SceneView:
    """An episode as the search sees it. `first` is (4,) uint64, 256 bits of the primary view's first image."""

    episode_id: str
    scene: str
    split: str
    first: np.ndarray


@dataclass(frozen=True)
class SceneLeak:
    """A pair of scenes that look like one; the episodes are those that look most alike."""

    learning_scene: str
    testing_scene: str
    learning_episode: str
    testing_episode: str
    distance: int


def find_scene_leaks(seen: Sequence[SceneView], config: LeakageConfig) -> list[SceneLeak]:
    """Pairs of differently named scenes across the split whose first images differ in at most `max_distance` bits.

    Every tested episode is compared with every learnt one: 200,000 with 10,000 take some 20 seconds.
    """
    learning = [view for view in seen if view.split in LEARNING]
    if config.action == "off" or not learning:
        return []
    learnt = np.stack([view.first for view in learning], axis=1)
    best: dict[tuple[str, str], SceneLeak] = {}
    for tested in (view for view in seen if view.split in TESTING):
        distances = np.bitwise_count(learnt ^ tested.first[:, None]).sum(axis=0, dtype=np.uint16)
        for index in np.flatnonzero(distances <= config.max_distance).tolist():
            other = learning[index]
            if other.scene == tested.scene:
                continue
            leak = SceneLeak(other.scene, tested.scene, other.episode_id, tested.episode_id, int(distances[index]))
            known = best.setdefault((other.scene, tested.scene), leak)
            best[other.scene, tested.scene] = min(known, leak, key=lambda leak: (leak.distance, leak.learning_episode))
    return sorted(best.values(), key=lambda leak: (leak.testing_scene, leak.learning_scene))


_BAND = 3
MIN_MOTION_OVERLAP = 0.5
"""Least share of common state cells (estimated Jaccard index)."""
_MAX_FRAME_DISTANCE = 12.0
"""Most differing bits of 64 of a moment's hash, mean."""


@dataclass(frozen=True)
class NearDuplicate:
    """Episode `position` repeats `original`, the first of its group.

    The numbers are those of the comparison with `compared_with` by which the episode (or the copies of it that were
    found before) came into the group; `frame_distance` is in bits of 64.
    """

    position: int
    original: int
    compared_with: int
    motion_overlap: float
    frame_distance: float


def find_near_duplicates(prints: Sequence[Fingerprint]) -> list[NearDuplicate]:
    """Episodes that repeat an earlier one, ordered by position; those whose robot hardly moves are not compared.

    Args:
        prints: in listed order: of each group of equal recordings the first is the original.
    """
    moved = [position for position, seen in enumerate(prints) if seen.motion is not None]
    if len(moved) < 2:
        return []
    layouts = {layout: number for number, layout in enumerate(sorted({seen.layout for seen in prints}))}
    layout = np.array([layouts[prints[position].layout] for position in moved])
    motion = np.array([prints[position].motion for position in moved], np.int64)
    views = sorted({view for seen in prints for view in seen.views})
    frames = np.zeros((len(moved), len(views), MOMENTS), np.uint64)
    present = np.zeros((len(moved), len(views)), bool)
    for number, position in enumerate(moved):
        for column, view in enumerate(views):
            if view in prints[position].views:
                frames[number, column] = prints[position].views[view].frames
                present[number, column] = True
    group = np.arange(len(moved))
    found: dict[int, NearDuplicate] = {}
    for start in range(0, MINHASHES, _BAND):
        for members in _equal_rows(np.column_stack([layout, motion[:, start : start + _BAND]])):
            for place, first in enumerate(members[:-1].tolist()):
                others = members[place + 1 :]
                others = others[group[others] != group[first]]
                overlap = (motion[others] == motion[first]).mean(axis=1)
                others, overlap = others[overlap >= MIN_MOTION_OVERLAP], overlap[overlap >= MIN_MOTION_OVERLAP]
                shared = present[others] & present[first]
                distance = _frame_distance(frames[first], frames[others], shared)
                alike = shared.any(axis=1) & (distance <= _MAX_FRAME_DISTANCE)
                for other, share, bits in zip(others[alike].tolist(), overlap[alike], distance[alike], strict=True):
                    heads = {int(group[first]): first, int(group[other]): other}
                    low, high = min(heads), max(heads)
                    if low != high:
                        # Every episode but the first of its group heads a group until here: each gets one record.
                        compared = moved[heads[low]]
                        found[high] = NearDuplicate(moved[high], -1, compared, float(share), float(bits))
                        group[group == high] = low
    return [replace(seen, original=moved[group[number]]) for number, seen in sorted(found.items())]


def _frame_distance(first: np.ndarray, others: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """(n,) mean differing bits over shared views, of hashes (v, m) and (n, v, m).

    Each moment counts against the best of three neighbouring ones of `first`, because trimming shifts moments.
    """
    moments = (np.clip(np.arange(MOMENTS) + shift, 0, MOMENTS - 1) for shift in (-1, 0, 1))
    bits = [np.bitwise_count(first[:, chosen] ^ others).astype(np.float64) for chosen in moments]
    by_view = np.stack(bits).min(axis=0).mean(axis=2)
    return np.where(shared, by_view, 0.0).sum(axis=1) / np.maximum(shared.sum(axis=1), 1)


def _equal_rows(keys: np.ndarray) -> Iterator[np.ndarray]:
    """Groups of the indices of equal rows, in ascending order."""
    _, row, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    repeated = np.flatnonzero(counts[row] > 1)
    order = repeated[np.argsort(row[repeated], kind="stable")]
    yield from np.split(order, np.flatnonzero(np.diff(row[order])) + 1)
