"""Agreement of a simulator with the world on policies: success rates of every policy, recorded and predicted.

Pearson's r and Spearman's rho of the two rates over policies; the mean maximum rank violation (MMRV, SIMPLER, Li et al. 2024): over
policies, the mean of the largest gap in recorded success to a policy that the simulator ranks the other way round; and the mean absolute
error of the rates. A policy is a source of the episodes. Policies that tried the same starts (one bank each) are compared on these.

Axis legend: p policies, n starts, r resamples.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.stats import rankdata

from worldline_core.errors import DataError

STATISTICS = ("pearson", "spearman", "mmrv", "rate_error")
ALL = "all"


def pearson(a: Float[np.ndarray, "*r p"], b: Float[np.ndarray, "*r p"]) -> Float[np.ndarray, "*r"]:
    """Correlation along the last axis; NaN where one side is constant."""
    a, b = a - a.mean(-1, keepdims=True), b - b.mean(-1, keepdims=True)
    norm = np.sqrt((a**2).sum(-1) * (b**2).sum(-1))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(norm > 1e-12, (a * b).sum(-1) / norm, np.nan)


def spearman(a: Float[np.ndarray, "*r p"], b: Float[np.ndarray, "*r p"]) -> Float[np.ndarray, "*r"]:
    """Correlation of the ranks along the last axis; equal values share their mean rank."""
    return pearson(rankdata(a, axis=-1), rankdata(b, axis=-1))


def mmrv(recorded: Float[np.ndarray, "*r p"], predicted: Float[np.ndarray, "*r p"]) -> Float[np.ndarray, "*r"]:
    """``mean_i max_j |R_i - R_j| [(S_i > S_j) != (R_i > R_j)]``, R recorded and S predicted rates."""

    def over(rates: np.ndarray) -> np.ndarray:
        return rates[..., :, None] > rates[..., None, :]

    gap = np.abs(recorded[..., :, None] - recorded[..., None, :])
    return (gap * (over(predicted) != over(recorded))).max(-1).mean(-1)


def _statistics(recorded: np.ndarray, predicted: np.ndarray) -> dict[str, np.ndarray]:
    return {
        "pearson": pearson(recorded, predicted),
        "spearman": spearman(recorded, predicted),
        "mmrv": mmrv(recorded, predicted),
        "rate_error": np.abs(recorded - predicted).mean(-1),
    }


def require_policies(policies: set[str]) -> None:
    """Raises: DataError for fewer than three policies."""
    if len(policies) < 3:
        raise DataError(
            "Policies cannot be ranked", expected="episodes of at least three sources, a policy each", got=sorted(policies),
            next_step="name each policy's recordings as a source of their own, or set evaluate_policy.compare_policies: false",
        )  # fmt: skip


def policy_agreement(rows: Sequence[Mapping[str, Any]], *, resamples: int, seed: int) -> dict[str, Any]:
    """Recorded and predicted success rates of every policy and how they agree, by method and task.

    Args:
        rows: verdicts with method, policy, start, task, episode_id, outcome and predicted; several of one episode (seeds of a prediction)
            are averaged.

    Returns:
        {method: {task: {"policies": {name: {"recorded", "predicted", "attempts"}}, statistic: {"value",
        "over_starts_and_policies": [low, high]}}}}; tasks are "all" and each.

    Raises:
        DataError: fewer than three policies.
    """
    require_policies({row["policy"] for row in rows})
    found: dict[str, dict[str, Any]] = defaultdict(dict)
    for method in sorted({row["method"] for row in rows}):
        of_method = [row for row in rows if row["method"] == method]
        for task in (ALL, *sorted({row["task"] for row in of_method})):
            chosen = [row for row in of_method if task in (ALL, row["task"])]
            if len({row["policy"] for row in chosen}) > 2:
                found[method][task] = _agreement(chosen, resamples=resamples, seed=seed)
    return dict(found)


def _agreement(rows: Sequence[Mapping[str, Any]], *, resamples: int, seed: int) -> dict[str, Any]:
    cells: dict[tuple[str, str], list[tuple[bool, bool]]] = defaultdict(list)
    for row in rows:
        cells[row["policy"], row["start"]].append((row["outcome"] == "success", row["predicted"] == "success"))
    policies, starts = (sorted({key[side] for key in cells}) for side in (0, 1))
    # Recorded and predicted; NaN where a policy did not try a start.
    success = np.full((2, len(policies), len(starts)), np.nan)
    for (policy, start), ends in cells.items():
        success[:, policies.index(policy), starts.index(start)] = np.mean(ends, axis=0)
    tried = np.isfinite(success[0])
    rates = np.nan_to_num(success).sum(-1) / tried.sum(-1)
    values = _statistics(*rates)
    random = np.random.default_rng(seed)
    over_starts = _resampled_rates(success, tried, resamples, random)
    drawn = random.integers(0, len(policies), (resamples, len(policies)))
    over_both = np.stack([np.take_along_axis(side, drawn, axis=1) for side in over_starts])
    intervals = _statistics(*over_both)
    facts = {
        name: {"recorded": float(r), "predicted": float(s), "attempts": int(n)}
        for name, r, s, n in zip(policies, *rates, tried.sum(-1), strict=True)
    }
    return {"policies": facts} | {
        name: {
            "value": float(values[name]) if np.isfinite(values[name]) else None,
            "over_starts_and_policies": _bounds(intervals[name]),
        }
        for name in STATISTICS
    }


def _resampled_rates(
    success: Float[np.ndarray, "2 p n"], tried: np.ndarray, resamples: int, random: np.random.Generator
) -> Float[np.ndarray, "2 r p"]:
    """Rates over starts drawn with replacement: the same starts for all policies where all tried them, else each its own."""
    if tried.all():
        index = random.integers(0, tried.shape[1], (resamples, tried.shape[1]))
        counts = np.stack([np.bincount(row, minlength=tried.shape[1]) for row in index]) / tried.shape[1]
        return np.stack([counts @ side.T for side in success])
    rates = np.empty((2, resamples, len(tried)))
    for policy, own in enumerate(tried):
        index = random.integers(0, own.sum(), (resamples, own.sum()))
        rates[:, :, policy] = success[:, policy, own][:, index].mean(-1)
    return rates


def _bounds(values: np.ndarray) -> list[float] | None:
    """95 % percentile interval of the resamples in which the statistic is defined; None without any."""
    known = values[np.isfinite(values)]
    return [float(bound) for bound in np.quantile(known, [0.025, 0.975])] if len(known) else None
