"""Scores: one tidy table, one value per row, and a summary with seeded bootstrap intervals and paired differences.

A row's ``value`` is already the mean over time of one trajectory, view and seed. Summaries weight trajectory-view pairs
equally. Trajectories are what is resampled: their views, seeds and frames are not independent of each other.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float
from numpy.typing import ArrayLike

from worldline_core.errors import DataError
from worldline_core.store.artifact_files import digest_value
from worldline_core.store.atomic import atomic_path, write_json_atomic

SCORES_FILE = "scores.parquet"
SUMMARY_FILE = "summary.json"
DECISIONS_FILE = "decisions.parquet"
"""Verdicts of evaluate_policy."""
TRUE_METHOD = "true"
"""The method whose videos are the recordings themselves."""
_TYPES = {
    **dict.fromkeys(("seed", "run", "budget", "frame", "count", "answers", "malformed_answers"), pa.int32()),
    **dict.fromkeys(
        ("value", "mean", "confidence", "doubt", "disagreement", "new_controls", "new_setup", "trust"), pa.float64()
    ),
    "undecided": pa.bool_(),
}
"""Columns of the tables that evaluations write; all others are strings."""


@dataclass(frozen=True)
class Interval:
    """A mean with the bounds of its bootstrap interval; ``count`` trajectories went into it."""

    mean: float
    low: float
    high: float
    count: int


def bootstrap_mean(
    values: Sequence[float] | np.ndarray,
    *,
    weights: Sequence[float] | np.ndarray | None = None,
    resamples: int = 2000,
    seed: int = 0,
) -> Interval:
    """Mean and 95 % percentile interval of the mean, resampling ``values`` (n,) with replacement.

    ``weights`` (n,) count how many trajectory-view pairs a value stands for, so that the mean equals the mean over
    pairs. One value alone has an interval of width zero.

    Raises: DataError: for no values, or values that are not finite.
    """
    sample = np.asarray(values, dtype=np.float64)
    weight = np.ones_like(sample) if weights is None else np.asarray(weights, dtype=np.float64)
    if sample.ndim != 1 or sample.size == 0 or not np.isfinite(sample).all() or weight.shape != sample.shape:
        raise DataError(
            "A bootstrap needs finite values, one per trajectory",
            expected="a non-empty, finite vector (and weights of the same length)",
            got=f"shape {sample.shape}, weights {weight.shape}, {int((~np.isfinite(sample)).sum())} not finite",
        )
    times = _times_drawn(sample.size, resamples, seed)
    # Not BLAS, whose last digits depend on the number of threads.
    means = np.einsum("rc,c->r", times, sample * weight) / np.einsum("rc,c->r", times, weight)
    low, high = np.quantile(means, [0.025, 0.975])
    return Interval(float((sample * weight).sum() / weight.sum()), float(low), float(high), int(sample.size))


@lru_cache(maxsize=4)
def _times_drawn(count: int, resamples: int, seed: int) -> Float[np.ndarray, "resamples count"]:
    """Count each value in each resample. Cached, because metrics with equally many trajectories draw the same resamples."""
    chosen = np.random.default_rng(seed).integers(0, count, size=(resamples, count))
    flat = np.bincount((chosen + count * np.arange(resamples)[:, None]).ravel(), minlength=resamples * count)
    times = flat.reshape(resamples, count).astype(np.float64)
    times.flags.writeable = False
    return times


def crossed_bootstrap(by_seed: Sequence[Mapping[str, float]], *, resamples: int = 2000, seed: int = 0) -> Interval:
    """Mean over trainings of several seeds, each measured on the same trajectories, and its percentile interval of 95 %.

    Seeds and trajectories (those that all seeds have) are both resampled: an interval over trajectories alone says nothing
    about another training, and the other way round.
    """
    common = sorted(set.intersection(*(set(values) for values in by_seed)))
    sample = np.array([[values[name] for name in common] for values in by_seed], dtype=np.float64)
    generator = np.random.default_rng(seed)
    seeds = generator.integers(0, sample.shape[0], size=(resamples, sample.shape[0]))
    trajectories = generator.integers(0, sample.shape[1], size=(resamples, sample.shape[1]))
    means = [sample[np.ix_(rows, columns)].mean() for rows, columns in zip(seeds, trajectories, strict=True)]
    low, high = np.quantile(means, [0.025, 0.975])
    return Interval(float(sample.mean()), float(low), float(high), len(common))


def paired_difference(
    first: Mapping[str, float], second: Mapping[str, float], *, resamples: int = 2000, seed: int = 0
) -> Interval | None:
    """``first - second`` over the trajectories that both have (keys are trajectory names); None without any.

    Resampling the differences keeps the pairing: what is hard for both methods cancels.
    """
    common = sorted(first.keys() & second.keys())
    if not common:
        return None
    return bootstrap_mean([first[name] - second[name] for name in common], resamples=resamples, seed=seed)


@dataclass(frozen=True, order=True)
class Score:
    """One measured value of one predicted (or recorded) trajectory."""

    method: str
    episode_id: str
    embodiment: str
    split: str
    view: str
    seed: int
    metric: str
    value: float
    scene: str = ""
    task_family: str = ""
    outcome: str = ""

    @property
    def groups(self) -> tuple[str, ...]:
        """The groups that it is reported in: its split, and within it its embodiment and outcome."""
        outcome = [f"{self.split}/{self.outcome}"] if self.outcome in ("success", "failure") else []
        return self.split, f"{self.split}/{self.embodiment}", *outcome


def write_scores(folder: Path, scores: Iterable[Score]) -> None:
    """Write ``scores.parquet``, sorted, so that equal scores give equal bytes."""
    rows = [asdict(score) for score in sorted(scores)]
    write_table(folder / SCORES_FILE, rows, [field.name for field in fields(Score)])


def table_schema(columns: Sequence[str]) -> pa.Schema:
    """Columns of a table that evaluations write."""
    return pa.schema([(name, _TYPES.get(name, pa.string())) for name in columns])


def write_table(path: Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> None:
    """Write rows as Parquet, whole or not at all."""
    with atomic_path(path) as temporary:
        pq.write_table(pa.Table.from_pylist([dict(row) for row in rows], schema=table_schema(columns)), temporary)


def part_file(folder: Path, *of: str | int) -> Path:
    """Path in `folder` of one part of an evaluation (a method, an episode, a seed), whatever characters its names have."""
    return folder / f"{digest_value(of)[:32]}.json"


def kept_part(path: Path, make: Callable[[], Any]) -> Any:
    """Returns what `make` returns, as JSON: written to `path` the first time and read from there, so killed steps continue."""
    if not path.exists():
        write_json_atomic(path, make())
    return json.loads(path.read_text())


def area_under_curve(scores: ArrayLike, successes: ArrayLike) -> float:
    """Area under the ROC curve: share of the pairs of a success and a failure in which the success scores higher, ties half.

    NaN when all are successes or none is.
    """
    won = np.asarray(successes, dtype=bool)
    wins = int(won.sum())
    pairs = wins * (len(won) - wins)
    _, place, equal = np.unique(np.asarray(scores), return_inverse=True, return_counts=True)
    ranks = (np.cumsum(equal) - (equal - 1) / 2)[place]
    return float((ranks[won].sum() - wins * (wins + 1) / 2) / pairs) if pairs else np.nan


def summarise(scores: Sequence[Score], *, resamples: int, seed: int, by_view: bool = False) -> dict[str, Any]:
    """Means with 95 % intervals over trajectories, and paired differences between methods.

    A mean is over the views that a method predicted (``metric@view`` says of how many trajectories each one was); a
    difference is over the views that both methods predicted of a trajectory.

    Args:
        by_view: also give every metric per view, as ``metric@view``.

    Returns:
        {"metrics": {group: {method: {metric: interval}}},
        "differences": {group: [{"first", "second", "metric", mean, low, high, count}]}}
    """
    values: dict[tuple[str, str], dict[str, dict[str, list[Score]]]] = defaultdict(
        lambda: defaultdict(lambda: defaultdict(list))
    )
    for score in sorted(scores):
        names = [score.metric] + ([f"{score.metric}@{score.view}"] if by_view and score.view else [])
        for group in score.groups:
            for name in names:
                values[group, name][score.method][score.episode_id].append(score)

    options = {"resamples": resamples, "seed": seed}
    metrics: dict[str, dict[str, dict[str, Any]]] = defaultdict(lambda: defaultdict(dict))
    differences: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for (group, metric), by_method in values.items():
        for method, by_episode in by_method.items():
            weights = [len(items) for items in by_episode.values()]
            interval = bootstrap_mean(list(map(_mean, by_episode.values())), weights=weights, **options)
            metrics[group][method][metric] = asdict(interval)
        for first, second in combinations(sorted(by_method), 2):
            found = paired_difference(*_in_common_views(by_method[first], by_method[second]), **options)
            if found is not None:
                differences[group].append({"first": first, "second": second, "metric": metric, **asdict(found)})
    return {"metrics": metrics, "differences": differences}


def _in_common_views(
    first: Mapping[str, Sequence[Score]], second: Mapping[str, Sequence[Score]]
) -> tuple[dict[str, float], dict[str, float]]:
    """Means of the trajectories that both methods have, over the views that both have of each."""
    means: tuple[dict[str, float], dict[str, float]] = ({}, {})
    for name in first.keys() & second.keys():
        views = {score.view for score in first[name]} & {score.view for score in second[name]}
        if views:
            for mean, scores in zip(means, (first[name], second[name]), strict=True):
                mean[name] = _mean([score for score in scores if score.view in views])
    return means


def _mean(scores: Sequence[Score]) -> float:
    return sum(score.value for score in scores) / len(scores)
