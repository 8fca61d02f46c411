"""Video scores of one or several evaluations, and the episodes that they choose for the report's videos.

Episodes are never picked by hand: shown are the best, the median and the worst by a stated score.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from worldline_core.report.methods import Method, in_order
from worldline_core.store.artifact_files import JsonObject, read_json, read_rows

SPLIT_ORDER = ("test", "ood_test", "validation", "train", "bank")
SPLIT_LABELS = {
    "test": "held-out scenes",
    "ood_test": "held-out embodiment",
    "validation": "validation",
    "train": "training scenes",
    "bank": "candidate banks",
}
IOU_METRICS = ("robot_iou_exact", "robot_iou")
"""In order of preference: against the recording's exact masks, or against the segmenter's own masks of the truth."""


@dataclass(frozen=True)
class VideoScores:
    """Summaries and tidy rows of `evaluate_video` artifacts, merged. Rows of the method `true` rate the segmenter."""

    summaries: Sequence[JsonObject]
    rows: Sequence[JsonObject]
    by_frame: Sequence[JsonObject]

    @classmethod
    def read(cls, folders: Mapping[str, Path]) -> VideoScores:
        """Reads every folder's summary.json, scores.parquet and by_frame.parquet (absent files count as empty)."""
        paths = list(folders.values())
        return cls(
            [summary for path in paths if (summary := read_json(path / "summary.json"))],
            [row for path in paths for row in read_rows(path / "scores.parquet")],
            [row for path in paths for row in read_rows(path / "by_frame.parquet")],
        )

    @cached_property
    def groups(self) -> list[str]:
        """Splits that have scores, the held-out ones first."""
        found = {g for s in self.summaries for g in s.get("metrics", {}) if "/" not in g}
        return sorted(found, key=lambda g: (SPLIT_ORDER.index(g) if g in SPLIT_ORDER else 99, g))

    def subgroups(self, split: str) -> list[str]:
        """Groups within a split: embodiments and outcomes."""
        return sorted({g for s in self.summaries for g in s.get("metrics", {}) if g.startswith(f"{split}/")})

    def methods(self, group: str) -> list[Method]:
        """Methods scored in a group, in the report's order."""
        return in_order(sorted({m for s in self.summaries for m in s.get("metrics", {}).get(group, {})}))

    def value(self, group: str, method: str, metric: str) -> JsonObject | None:
        """`{"mean", "low", "high", "count"}` of a metric (`psnr`, `psnr@head`, ...), or None."""
        for summary in self.summaries:
            found = summary.get("metrics", {}).get(group, {}).get(method, {}).get(metric)
            if found is not None:
                return found
        return None

    def difference(self, group: str, first: str, second: str, metric: str) -> JsonObject | None:
        """Paired difference `first - second` over the trajectories that both have, or None."""
        for summary in self.summaries:
            for row in summary.get("differences", {}).get(group, []):
                if row["metric"] != metric:
                    continue
                if (row["first"], row["second"]) == (first, second):
                    return row
                if (row["first"], row["second"]) == (second, first):
                    return {**row, "mean": -row["mean"], "low": -row["high"], "high": -row["low"]}
        return None

    @cached_property
    def unavailable(self) -> dict[str, str]:
        """Metrics that could not be measured, with the reason."""
        return {name: reason for summary in self.summaries for name, reason in summary.get("unavailable", {}).items()}

    @cached_property
    def segmenters(self) -> list[dict[str, Any]]:
        """The segmenters used, each with its own accuracy on true frames."""
        found: dict[str, dict[str, Any]] = {}
        for summary in self.summaries:
            for segmenter in summary.get("segmenters", []):
                found.setdefault(segmenter["name"], segmenter)
        return list(found.values())

    def iou_metric(self, group: str, method: str) -> str | None:
        """The most trustworthy IoU that a method has."""
        return next((metric for metric in IOU_METRICS if self.value(group, method, f"{metric}@head")), None)

    def per_episode(self, method: str, metric: str, view: str, split: str) -> dict[str, float]:
        """Mean over seeds of a metric, by episode."""
        values: dict[str, list[float]] = defaultdict(list)
        for row in self.rows:
            if (row["method"], row["metric"], row["view"], row["split"]) == (method, metric, view, split):
                values[row["episode_id"]].append(row["value"])
        return {name: sum(items) / len(items) for name, items in sorted(values.items())}

    def primary(self, group: str, configured: str | None = None) -> Method | None:
        """The method whose results head the page: the configured one, or the first that a model made."""
        methods = self.methods(group)
        named = next((m for m in methods if m.name == configured), None)
        return named or next((m for m in methods if m.kind == "stage2"), methods[0] if methods else None)


@dataclass(frozen=True)
class ChosenEpisode:
    """An episode and why it is shown."""

    episode_id: str
    reason: str
    score: float | None = None
    split: str = ""


def best_median_worst(values: Mapping[str, float]) -> list[tuple[str, str, float]]:
    """(label, episode, value) of the median, best and worst of a score where higher is better; ties by name."""
    ranked = sorted(values.items(), key=lambda item: (item[1], item[0]))
    if not ranked:
        return []
    places = [("median", (len(ranked) - 1) // 2), ("best", len(ranked) - 1), ("worst", 0)]
    chosen: list[tuple[str, str, float]] = []
    for label, place in places:
        name, value = ranked[place]
        if name not in {episode for _, episode, _ in chosen}:
            chosen.append((label, name, value))
    return chosen


def choose_episodes(scores: VideoScores, primary: str | None, available: Sequence[str]) -> list[ChosenEpisode]:
    """Median, best and worst of the first held-out group, and the median of every further one.

    Args:
        primary: the method whose robot IoU ranks the episodes.
        available: episodes that have predicted videos; without scores the first, middle and last of them are taken.
    """
    known = set(available)
    chosen: list[ChosenEpisode] = []
    for group in scores.groups:
        first = scores.primary(group, primary)
        metric = scores.iou_metric(group, first.name) if first is not None else None
        if first is None or metric is None or group == "train":
            continue
        values = {k: v for k, v in scores.per_episode(first.name, metric, "head", group).items() if k in known}
        ranked = best_median_worst(values)
        where = SPLIT_LABELS.get(group, group)
        for label, episode, value in ranked if not chosen else ranked[:1]:
            reason = f"{label} of {len(values)} on {where}"
            chosen.append(ChosenEpisode(episode, reason, value, group))
    if chosen or not available:
        return chosen
    ordered = sorted(known)
    places = sorted({0, len(ordered) // 2, len(ordered) - 1})
    return [
        ChosenEpisode(ordered[i], f"number {i + 1} of {len(ordered)} by name (no scores were given)") for i in places
    ]
