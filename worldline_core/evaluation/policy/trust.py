"""Which verdicts on predicted videos deserve trust, and what is gained where the others are left out.

Signals of a prediction: how doubtful the judge's verdict is (its stated confidence, averaged over the seeds that an episode was
predicted with, so that seeds which disagree make doubt), how far another model's prediction speaks against it, how new the
controls are, and how new the body and its head camera are (:mod:`worldline_core.evaluation.policy.novelty`). A logistic model
turns them into the probability that the verdict is right. Its weights may not be positive: more doubt is never more trust. The starts are halved; verdicts of either half are
calibrated with the other half alone, so every figure is of verdicts that played no part in their own calibration.

Intervals are bootstraps over starts. Axis legend: n verdicts, s signals, k resamples (the first row stands for the sample).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize

from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation.evaluation_config import TrustConfig
from worldline_core.evaluation.policy.agreement import ALL, STATISTICS, policy_agreement

SIGNALS = ("doubt", "disagreement", "new_controls", "new_setup")
TRUST_COLUMNS = (*SIGNALS, "trust", "do_not_trust")
LEAST_OF_EACH = 5
"""Right and wrong verdicts that a half must have to calibrate with."""
COVERAGES = tuple(round(1.0 - 0.05 * step, 2) for step in range(13))
RANKED_COVERAGES = (1.0, 0.9, 0.8, 0.6)
_SHOWN = 12
_LARGEST_NOVELTY = 10.0


@dataclass(frozen=True)
class Calibration:
    """Probability of a right verdict from its signals: weights of the intercept and of each signal."""

    signals: tuple[str, ...]
    weights: Float[np.ndarray, " s+1"]

    def trust(self, rows: Sequence[Mapping[str, Any]]) -> Float[np.ndarray, " n"] | str:
        """The trust in each verdict, or the reason why there is none."""
        values, known = _signals(rows)
        if missing := [name for name in self.signals if name not in known]:
            return f"the calibration reads {', '.join(missing)}, which not all of these verdicts have"
        return probability(self.weights, values[:, [known.index(name) for name in self.signals]])


def calibrated(rows: Sequence[Mapping[str, Any]]) -> Calibration:
    """The calibration from all verdicts of one method, for verdicts whose outcome is not known."""
    values, known = _signals(rows)
    return Calibration(tuple(known), fit_right(values, _right(rows)))


def trust_verdicts(
    rows: Sequence[Mapping[str, Any]],
    config: TrustConfig,
    *,
    policies: bool,
    resamples: int,
    seed: int,
    saved: Mapping[str, Calibration | str] | None = None,
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """How far each verdict is to be trusted, and how right that is.

    Args:
        rows: verdicts of predicted videos with method, episode_id, seed, start, policy, task, outcome, predicted, confidence (of
            the judge in its verdict) and the novelties; None where a signal is not known.
        policies: also how policies rank where the least trusted verdicts are left out.
        saved: of each method a calibration that was made before, or why there is none; nothing is calibrated then, and outcomes
            may be ``unknown``.

    Returns:
        the rows with :data:`TRUST_COLUMNS`, and by method {"available", "reason", "signals", "auroc", "calibration_error",
        "reliability", "coverage", "marked", "policies", "least_trusted"}; where it is not available only the first two.

    Raises:
        ConfigError: verdicts are to be compared with those on a method that is not among the rows.
        DataError: a signal is not a number.
    """
    done: list[dict[str, Any]] = []
    methods: dict[str, Any] = {}
    by_method = {name: [dict(row) for row in rows if row["method"] == name] for name in {row["method"] for row in rows}}
    if unknown := {*config.compare_with, *config.compare_with.values()} - by_method.keys():
        raise ConfigError(
            "Verdicts cannot be compared with those on a method that nobody predicted", where="evaluate_policy.trust.compare_with",
            expected=f"some of {', '.join(sorted(by_method))}", got=", ".join(sorted(unknown)),
        )  # fmt: skip
    for method, of_method in sorted(by_method.items()):
        _add_doubt("doubt", of_method, of_method)
        _add_doubt("disagreement", of_method, by_method.get(config.compare_with.get(method, ""), ()))
        if saved is None:
            found = _calibrated(of_method, _signals(of_method)[0], seed)
        else:
            before = saved[method]
            found = before if isinstance(before, str) else before.trust(of_method)
        for row, value in zip(of_method, [None] * len(of_method) if isinstance(found, str) else found, strict=True):
            row["trust"] = None if value is None else float(value)
            row["do_not_trust"] = ", ".join(reasons(row, config.least_trust))
        known = [row for row in of_method if row["outcome"] in ("success", "failure")]
        if not isinstance(found, str) and not known:
            found = "no outcome is recorded, so how reliable the saved calibration is here cannot be told"
        if isinstance(found, str):
            methods[method] = {"available": False, "reason": found, "marked": _marked(of_method)}
        else:
            methods[method] = _summary(known, policies=policies, resamples=resamples, seed=seed)
        done += of_method
    return done, methods


def _add_doubt(name: str, rows: Sequence[dict[str, Any]], others: Sequence[Mapping[str, Any]]) -> None:
    """One minus the mean confidence of the ``others`` on an episode in its verdict; None where there are none."""
    stated: dict[str, list[tuple[str, float]]] = defaultdict(list)
    for row in others:
        if row["confidence"] is not None:
            stated[row["episode_id"]].append((row["predicted"], row["confidence"]))
    for row in rows:
        agreeing = [c if verdict == row["predicted"] else 1.0 - c for verdict, c in stated[row["episode_id"]]]
        row[name] = 1.0 - float(np.mean(agreeing)) if agreeing else None


def _signals(rows: Sequence[Mapping[str, Any]]) -> tuple[Float[np.ndarray, "n s"], list[str]]:
    """Signals on scales on which the odds of a wrong verdict may be linear, and the names of those that all rows have."""
    known = [name for name in SIGNALS if all(row[name] is not None for row in rows)]
    columns = []
    for name in known:
        values = np.array([row[name] for row in rows], dtype=np.float64)
        if np.isnan(values).any():
            raise DataError(
                "A signal of trust is not a number", where=f"{name} of {rows[int(np.argmax(np.isnan(values)))]['episode_id']}",
                expected="a number, or None where it is not known", got="NaN",
            )  # fmt: skip
        if name in ("doubt", "disagreement"):
            clipped = np.clip(values, 0.0, 1.0)
            columns.append(np.log((clipped + 0.02) / (1.02 - clipped)))
        else:
            columns.append(np.log(np.clip(values, 0.1, _LARGEST_NOVELTY)))
    return np.stack(columns, axis=1) if columns else np.zeros((len(rows), 0)), known


def _right(rows: Sequence[Mapping[str, Any]]) -> Bool[np.ndarray, " n"]:
    return np.array([row["predicted"] == row["outcome"] for row in rows])


def _calibrated(rows: Sequence[Mapping[str, Any]], signals: np.ndarray, seed: int) -> Float[np.ndarray, " n"] | str:
    """Probability of each verdict to be right, or why there is none."""
    if not signals.shape[1]:
        return (
            "no signal is known: the judge states no confidence, and there are no training recordings to compare with"
        )
    right = _right(rows)
    half = halves([row["start"] for row in rows], seed)
    counts = [Counter(right[half == number].tolist()) for number in (0, 1)]
    fewest = min(counts, key=lambda found: min(found[True], found[False]))
    if min(fewest[True], fewest[False]) < LEAST_OF_EACH:
        return (
            f"of the {len({row['start'] for row in rows})} starts, one half has {fewest[True]} right and {fewest[False]} wrong"
            f" verdicts; {LEAST_OF_EACH} of each are needed to calibrate with"
        )
    trust = np.zeros(len(rows))
    for number in (0, 1):
        weights = fit_right(signals[half != number], right[half != number])
        trust[half == number] = probability(weights, signals[half == number])
    return trust


def halves(starts: Sequence[str], seed: int) -> np.ndarray:
    """0 or 1 for each verdict: the half that its start was drawn into."""
    names = sorted(set(starts))
    drawn = np.random.default_rng(seed).permutation(len(names))
    half = {names[start]: place % 2 for place, start in enumerate(drawn)}
    return np.array([half[start] for start in starts])


def fit_right(signals: Float[np.ndarray, "n s"], right: Bool[np.ndarray, " n"]) -> Float[np.ndarray, " s+1"]:
    """Intercept and weights, none of them above zero, of the logistic model of a right verdict (slightly regularised)."""
    design = np.column_stack([np.ones(len(signals)), signals])
    sign = np.where(right, -1.0, 1.0)

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        odds = sign * (design @ weights)
        value = np.logaddexp(0.0, odds).mean() + 1e-3 * float((weights[1:] ** 2).sum())
        slope = design.T @ (sign / (1.0 + np.exp(-np.clip(odds, -60, 60)))) / len(design)
        return float(value), slope + 2e-3 * np.concatenate([[0.0], weights[1:]])

    bounds = [(None, None), *[(None, 0.0)] * signals.shape[1]]
    return minimize(loss, np.zeros(design.shape[1]), jac=True, bounds=bounds, method="L-BFGS-B").x


def probability(weights: np.ndarray, signals: Float[np.ndarray, "n s"]) -> Float[np.ndarray, " n"]:
    """The probability that a verdict with these signals is right."""
    return 1.0 / (1.0 + np.exp(-np.clip(weights[0] + signals @ weights[1:], -60, 60)))


def reasons(row: Mapping[str, Any], least_trust: float) -> list[str]:
    """The reasons why a verdict is marked as not to be trusted; empty where it is not."""
    found = [
        name.replace("_", " ") for name in ("new_controls", "new_setup") if row[name] is not None and row[name] > 1.0
    ]
    return found + (["doubtful verdict"] if row["trust"] is not None and row["trust"] < least_trust else [])


@dataclass(frozen=True)
class _Resamples:
    """Weights ``(k, n)`` of verdicts whose starts are drawn with replacement."""

    weights: np.ndarray

    @classmethod
    def of(cls, starts: Sequence[str], resamples: int, seed: int) -> _Resamples:
        names, index = np.unique(starts, return_inverse=True)
        chance = np.full(len(names), 1.0 / len(names))
        draws = np.random.default_rng(seed).multinomial(len(names), chance, resamples)
        return cls(np.concatenate([np.ones((1, len(index))), draws[:, index]]).astype(np.float32))

    def told(self, values: np.ndarray) -> dict[str, float | None]:
        """A statistic ``(k)`` as its value and 95 % interval."""
        known = values[1:][np.isfinite(values[1:])]
        low, high = np.quantile(known, [0.025, 0.975]) if len(known) else (None, None)
        value = float(values[0]) if np.isfinite(values[0]) else None
        return {
            "value": value,
            "low": None if low is None else float(low),
            "high": None if high is None else float(high),
        }

    def mean(self, values: np.ndarray, chosen: np.ndarray | None = None) -> dict[str, float | None]:
        """Mean of ``values`` ``(n)`` over the chosen verdicts."""
        share = np.ones(len(values)) if chosen is None else chosen.astype(np.float64)
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.told((self.weights @ (values * share)) / (self.weights @ share))

    def auroc(self, score: np.ndarray, wrong: np.ndarray) -> dict[str, float | None]:
        """How often a wrong verdict has a higher score than a right one; ties count half."""
        order = np.argsort(score, kind="stable")
        begins = np.flatnonzero(np.diff(score[order], prepend=-np.inf))
        weights = self.weights[:, order]
        bad = np.add.reduceat(weights * wrong[order], begins, axis=1)
        good = np.add.reduceat(weights * ~wrong[order], begins, axis=1)
        below = np.cumsum(good, axis=1) - good / 2
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.told((bad * below).sum(1) / (bad.sum(1) * good.sum(1)))


def reliability_bins(trust: Float[np.ndarray, " n"], bins: int = 10) -> np.ndarray:
    """Bin of each verdict: as many in each as can be, ordered by trust; equal trust shares a bin."""
    edges = np.unique(np.quantile(trust, np.linspace(0, 1, bins + 1)[1:-1]))
    return np.searchsorted(edges, trust, side="right")


def _summary(rows: list[dict[str, Any]], *, policies: bool, resamples: int, seed: int) -> dict[str, Any]:
    signals, known = _signals(rows)
    trust, right = np.array([row["trust"] for row in rows]), _right(rows)
    over = _Resamples.of([row["start"] for row in rows], resamples, seed)
    weights = fit_right(signals, right)[1:]
    bins = reliability_bins(trust)
    shown = [
        {"trust": float(trust[bins == b].mean()), "count": int((bins == b).sum()), **over.mean(right, bins == b)}
        for b in np.unique(bins)
    ]
    gaps = np.stack([over.weights @ ((bins == b) * (trust - right)) for b in np.unique(bins)])
    coverage = {}
    order = np.argsort(-trust, kind="stable")
    kept_at = {share: np.zeros(len(rows), dtype=bool) for share in COVERAGES}
    for share, kept in kept_at.items():
        kept[order[: round(share * len(rows))]] = True
        coverage[f"{share:.2f}"] = over.mean(~right, kept)
    marked = np.array([bool(row["do_not_trust"]) for row in rows])
    facts: dict[str, Any] = {
        "available": True,
        "verdicts": len(rows),
        "error": over.mean(~right),
        "signals": {
            name: {"auroc": over.auroc(column, ~right), "weight": float(weight)}
            for name, column, weight in zip(known, signals.T, weights, strict=True)
        },
        "auroc": over.auroc(-trust, ~right),
        "calibration_error": over.told(np.abs(gaps).sum(0) / over.weights.sum(1)),
        "reliability": shown,
        "coverage": coverage,
        "marked": _marked(rows) | {"error": over.mean(~right, marked), "error_of_others": over.mean(~right, ~marked)},
        "least_trusted": [
            {name: rows[i][name] for name in ("episode_id", "predicted", "outcome", "trust", "do_not_trust")}
            for i in order[::-1][:_SHOWN]
        ],
    }  # fmt: skip
    if policies:
        choices = {f"{share:.2f}": kept_at[share] for share in RANKED_COVERAGES} | {"not marked": ~marked}
        facts["policies"] = {
            name: _ranking(rows, kept, resamples=resamples, seed=seed) for name, kept in choices.items()
        }
    return facts


def _marked(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """How many verdicts carry the mark, by reason and by policy."""
    reasons = Counter(reason for row in rows for reason in row["do_not_trust"].split(", ") if reason)
    by_policy: dict[str, list[float]] = defaultdict(list)
    for row in rows:
        by_policy[row["policy"]].append(float(bool(row["do_not_trust"])))
    shares = {name: float(np.mean(marks)) for name, marks in sorted(by_policy.items())}
    return {
        "count": sum(bool(row["do_not_trust"]) for row in rows),
        "reasons": dict(sorted(reasons.items())),
        "policies": shares,
    }


def _ranking(rows: Sequence[Mapping[str, Any]], kept: np.ndarray, *, resamples: int, seed: int) -> dict[str, Any]:
    """How policies agree where the other verdicts are left out; the recorded rates are those of all attempts.

    Policies most of whose verdicts are left out are not ranked; ``with_all_verdicts`` is how the others agree where none is
    left out.
    """
    marks: dict[str, list[bool]] = defaultdict(list)
    for row, keep in zip(rows, kept, strict=True):
        marks[row["policy"]].append(bool(keep))
    ranked = {name for name, keeps in marks.items() if np.mean(keeps) >= 0.5}
    if len(ranked) < 3:
        return {"ranked": len(ranked)}
    among = [(row, keep) for row, keep in zip(rows, kept, strict=True) if row["policy"] in ranked]

    def agreement(left: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        found = policy_agreement(left, resamples=resamples, seed=seed)[rows[0]["method"]][ALL]
        return {name: found[name] for name in STATISTICS}

    without = agreement([row if keep else {**row, "predicted": None} for row, keep in among])
    return {"ranked": len(ranked), **without, "with_all_verdicts": agreement([row for row, _ in among])}
