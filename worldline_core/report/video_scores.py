"""Video scores of one or several evaluations by method, and how the methods are shown, coloured and ordered."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from worldline_core.evaluation.scores import TRUE_METHOD
from worldline_core.store.artifact_files import JsonObject, read_json, read_rows

"""Stands for the recorded videos among the methods of an evaluation: what is judged from them is a ceiling."""

KINDS = {
    TRUE_METHOD: ("recorded videos (ceiling)", "c2"),
    "stage2": ("Stage II", "c0"),
    "causal": ("causal", "c1"),
    "stage2_zero": ("Stage II, no actions", "c4"),
    "stage2_shuffled": ("Stage II, shuffled actions", "c3"),
    "causal_zero": ("causal, no actions", "c4"),
    "causal_shuffled": ("causal, shuffled actions", "c3"),
    "stage1": ("Stage I, text, no actions", "c7"),
    "backbone": ("backbone, text, no actions", "c6"),
    "copy": ("copy first frame", "c5"),
    "other": ("", "c6"),
}
"""Label and colour of each kind of method, in the report's order."""
GROUPS = {TRUE_METHOD: "", "shipped": "long-trained", "run": "this run", "baseline": ""}
"""Whose weights a method has, in the report's order."""
STEPS_NAME = re.compile(r"(?:shipped_)?(?P<base>stage2|causal)_(?P<steps>\d+)_steps")
ZERO_WORDS = frozenset({"zero", "zeroed", "none", "noaction", "noactions", "no"})
SHUFFLED_WORDS = frozenset({"shuffled", "shuffle"})

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
class Method:
    """A method as the report shows it: the model and its controls (`kind`) and whose weights they are (`group`)."""

    name: str
    kind: str
    group: str

    @property
    def label(self) -> str:
        found = STEPS_NAME.fullmatch(self.name)
        if found:
            return f"{KINDS[found['base']][0]}, {found['steps']} steps"
        return KINDS[self.kind][0] or self.name.replace("_", " ")

    @property
    def long_label(self) -> str:
        """Label with the group, for tables that mix weights of several origins."""
        return f"{self.label} ({GROUPS[self.group]})" if GROUPS[self.group] else self.label

    @property
    def colour(self) -> str:
        return KINDS[self.kind][1]

    @property
    def rank(self) -> tuple[int, int, str]:
        return [*GROUPS].index(self.group), [*KINDS].index(self.kind), self.name


def method(name: str) -> Method:
    """Reads a method's name: `shipped_stage2_shuffled`, `causal`, `stage2.zero`, `copy_first_frame`, `true`, ..."""
    words = set(re.split(r"[._\-\s]+", name.lower()))
    if name == TRUE_METHOD:
        return Method(name, TRUE_METHOD, TRUE_METHOD)
    if "copy" in words:
        return Method(name, "copy", "baseline")
    # Another number of steps is another method: it must not stand under the label of the usual one.
    if "steps" not in words and (found := words & {"stage1", "backbone"}):
        return Method(name, found.pop(), "baseline")
    base = "causal" if "causal" in words else "stage2" if words & {"stage2", "stageii"} else ""
    control = "_zero" if words & ZERO_WORDS else "_shuffled" if words & SHUFFLED_WORDS else ""
    kind = f"{base}{control}" if base and "steps" not in words else "other"
    return Method(name, kind, "shipped" if "shipped" in words else "run")


def in_order(names: Iterable[str]) -> list[Method]:
    """Methods of several names: recorded videos, long-trained weights, this run's, then baselines without actions."""
    return sorted((method(name) for name in names), key=lambda m: m.rank)


def predicting(names: Iterable[str]) -> list[Method]:
    """Those of several methods that predicted, in the report's order."""
    return [m for m in in_order(names) if m.name != TRUE_METHOD]


@dataclass(frozen=True)
class VideoScores:
    """Summaries and tidy rows of `evaluate_video` artifacts, merged. Rows of the method `true` rate the segmenter."""

    summaries: Sequence[JsonObject]
    rows: Sequence[JsonObject]
    by_frame: Sequence[JsonObject]

    @classmethod
    def read(cls, folders: Iterable[Path]) -> VideoScores:
        """Reads every folder's summary.json, scores.parquet and by_frame.parquet (absent files count as empty)."""
        paths = list(folders)
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
        return in_order({m for s in self.summaries for m in s.get("metrics", {}).get(group, {})})

    def names(self, group: str, method: str) -> set[str]:
        """Names of what was measured of a method: ``psnr``, ``psnr@head``, ..."""
        return {name for s in self.summaries for name in s.get("metrics", {}).get(group, {}).get(method, {})}

    def measured(self, metric: str) -> bool:
        """Whether a metric, or a variant of it, was measured of any method."""
        names = {name for group in self.groups for m in self.methods(group) for name in self.names(group, m.name)}
        return any(name.partition("@")[0].partition("[")[0] == metric for name in names)

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
