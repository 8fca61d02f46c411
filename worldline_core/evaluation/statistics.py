"""Intervals over trajectories: seeded bootstrap and paired differences.

A trajectory is the unit of resampling: its views, seeds and frames are not independent of each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from worldline_core.errors import DataError


@dataclass(frozen=True)
class Interval:
    """A mean with the bounds of its bootstrap interval; ``count`` trajectories went into it."""

    mean: float
    low: float
    high: float
    count: int

    def as_json(self) -> dict[str, float | int]:
        return {"mean": self.mean, "low": self.low, "high": self.high, "count": self.count}


def bootstrap_mean(
    values: Sequence[float] | np.ndarray,
    *,
    weights: Sequence[float] | np.ndarray | None = None,
    confidence: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Interval:
    """Mean and percentile interval of the mean, resampling ``values`` (n,) with replacement.

    ``weights`` (n,) count how many trajectory-view pairs a value stands for, so that the mean equals the mean over
    pairs. One value alone has an interval of width zero.

    Raises:
        DataError: for no values, or values that are not finite.
    """
    sample = np.asarray(values, dtype=np.float64)
    weight = np.ones_like(sample) if weights is None else np.asarray(weights, dtype=np.float64)
    if sample.ndim != 1 or sample.size == 0 or not np.isfinite(sample).all() or weight.shape != sample.shape:
        raise DataError(
            "A bootstrap needs finite values, one a trajectory",
            expected="a non-empty, finite vector (and weights of the same length)",
            got=f"shape {sample.shape}, weights {weight.shape}, {int((~np.isfinite(sample)).sum())} not finite",
        )
    generator = np.random.default_rng(seed)
    chosen = generator.integers(0, sample.size, size=(resamples, sample.size))
    means = (sample * weight)[chosen].sum(axis=1) / weight[chosen].sum(axis=1)
    tail = (1.0 - confidence) / 2.0
    low, high = np.quantile(means, [tail, 1.0 - tail])
    return Interval(float((sample * weight).sum() / weight.sum()), float(low), float(high), int(sample.size))


def paired_difference(
    first: Mapping[str, float],
    second: Mapping[str, float],
    *,
    confidence: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Interval | None:
    """``first - second`` over the trajectories that both have (keys are trajectory names); None without any.

    Resampling the differences keeps the pairing: what is hard for both methods cancels.
    """
    common = sorted(first.keys() & second.keys())
    if not common:
        return None
    differences = [first[name] - second[name] for name in common]
    return bootstrap_mean(differences, confidence=confidence, resamples=resamples, seed=seed)
