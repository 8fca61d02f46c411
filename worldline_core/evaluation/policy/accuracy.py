"""Accuracy of verdicts: pooled per seed, averaged over seeds; by split and task family; with intervals."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

from worldline_core.evaluation.statistics import bootstrap_mean, paired_difference

ALL = "all"


def summarise_decisions(rows: Sequence[Mapping[str, Any]], *, resamples: int, seed: int) -> dict[str, Any]:
    """Accuracy of every method and group, and differences between methods.

    Args:
        rows: verdicts with method, episode_id, seed, split, task_family, outcome, predicted, answers, malformed_answers.

    Returns:
        {"trajectories", "methods": {method: {group: {"accuracy": interval, "seeds": {...}, "confusion": {...}}}},
         "differences": [...]}; groups are "all", each split, each family, and split/family.
    """
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = defaultdict(list)
    for row in rows:
        names = (ALL, row["split"], row["task_family"], f"{row['split']}/{row['task_family']}")
        for name in dict.fromkeys(names):
            groups[row["method"], name].append(row)
    methods: dict[str, dict[str, Any]] = defaultdict(dict)
    by_trajectory: dict[str, dict[str, float]] = {}
    for (method, group), members in sorted(groups.items()):
        per_trajectory, per_seed = _means(members, "episode_id"), _means(members, "seed")
        if group == ALL:
            by_trajectory[method] = per_trajectory
        interval = bootstrap_mean(list(per_trajectory.values()), resamples=resamples, seed=seed)
        confusion = {"true_success": 0, "false_success": 0, "true_failure": 0, "false_failure": 0}
        for row in members:
            right = "true" if row["predicted"] == row["outcome"] else "false"
            confusion[f"{right}_{row['predicted']}"] += 1
        methods[method][group] = {
            "accuracy": interval.as_json(),
            "seeds": {str(name): value for name, value in per_seed.items()},
            "confusion": confusion,
            "malformed_answers": sum(row["malformed_answers"] for row in members),
            "answers": sum(row["answers"] for row in members),
        }
    names = sorted(by_trajectory)
    differences = []
    for index, first in enumerate(names):
        for second in names[index + 1 :]:
            interval = paired_difference(by_trajectory[first], by_trajectory[second], resamples=resamples, seed=seed)
            if interval is not None:
                differences.append({"first": first, "second": second, "metric": "accuracy", **interval.as_json()})
    return {
        "trajectories": len({row["episode_id"] for row in rows}),
        "methods": dict(methods),
        "differences": differences,
    }


def _means(rows: Sequence[Mapping[str, Any]], key: str) -> dict[Any, float]:
    values: dict[Any, list[float]] = defaultdict(list)
    for row in rows:
        values[row[key]].append(float(row["predicted"] == row["outcome"]))
    return {name: sum(items) / len(items) for name, items in sorted(values.items())}
