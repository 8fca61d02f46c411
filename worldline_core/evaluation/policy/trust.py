"""Trust in the verdicts of a finished evaluation: how likely each one is right, and how new its recording is to the model.

Signals are the judge's doubt (averaged over the seeds of an episode), the disagreement of verdicts on another model's predictions, and the
novelty of controls and setup (body and head camera). A logistic model whose weights are never positive turns them into a probability:
starts are halved, and each half is calibrated with the other one. Novelty is the distance to the nearest training recording, of the
farthest window, in units of what a share ``1 - level`` of these stay within among themselves (Laxhammar and Falkman 2010).

Axis legend: n verdicts, s signals, r recordings, w windows, f features.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.actions.episode_tracks import HEAD_VIEW, ActionTracks, EpisodeTracks
from worldline_core.data.episodes.episode import TRAINING_SPLITS
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation.evaluation_config import TrustConfig
from worldline_core.evaluation.scores import DECISIONS_FILE, SUMMARY_FILE, TRUE_METHOD, area_under_curve, write_table
from worldline_core.store.artifact_files import read_json, read_rows
from worldline_core.store.atomic import write_json_atomic

SIGNALS = ("doubt", "disagreement", "new_controls", "new_setup")
TRUST_COLUMNS = (*SIGNALS, "trust", "do_not_trust")
LEAST_OF_EACH = 5  # right and wrong verdicts that a half needs to calibrate with
LEAST_RECORDINGS, MOST_RECORDINGS = 5, 2000
"""Training recordings of a kind: fewer give no novelty, of more a sample is kept."""
PLACE_M, SPEED_M, OPENING = 0.1, 0.05, 0.5
"""Differences of equal weight: place, way in a latent frame, opening of a gripper (share)."""


@dataclass(frozen=True)
class KnownRecordings:
    """Training recordings by kind (number of arms, or embodiment), each ``(r, w, f)`` with NaN after a recording's end."""

    kinds: Mapping[str, np.ndarray]
    level: float = 0.05

    @classmethod
    def of(cls, recordings: Iterable[tuple[str, Float[np.ndarray, "w f"]]], level: float = 0.05) -> KnownRecordings:
        """Collect recordings, each a kind and its vectors; a share ``level`` of them has a novelty above 1."""
        by_kind: dict[str, list[np.ndarray]] = defaultdict(list)
        for kind, vectors in recordings:
            by_kind[kind].append(vectors)
        kinds: dict[str, np.ndarray] = {}
        for kind, found in by_kind.items():
            if len(found) >= LEAST_RECORDINGS:
                chosen = [found[i] for i in np.random.default_rng(0).permutation(len(found))[:MOST_RECORDINGS]]
                windows = sorted(map(len, chosen))[-LEAST_RECORDINGS]  # later ones are reached by too few to compare
                kinds[kind] = np.full((len(chosen), windows, chosen[0].shape[1]), np.nan)
                for row, vectors in zip(kinds[kind], chosen, strict=True):
                    row[: len(vectors)] = vectors[:windows]
        if not kinds:
            raise DataError(
                "Too few training recordings to measure novelty", expected=f"{LEAST_RECORDINGS} of a kind",
                got={k: len(v) for k, v in by_kind.items()}, next_step="add recordings of the training splits to the episodes",
            )  # fmt: skip
        return cls(kinds, level)

    @cached_property
    def _scales(self) -> dict[str, tuple[np.ndarray, float]]:
        """Median distance of each window to its nearest neighbour, and the limit of the farthest window in these units."""
        found = {}
        for kind, known in self.kinds.items():
            own = np.stack([_nearest(window, window, others=True) for window in known.swapaxes(0, 1)])
            scale = np.array([max(float(np.median(row[row < np.inf])), 1e-6) for row in own])
            farthest = np.where(np.isfinite(own), own / scale[:, None], 0.0).max(axis=0)
            found[kind] = scale, max(float(np.quantile(farthest, 1.0 - self.level)), 1e-6)
        return found

    def novelty(self, kind: str, vectors: Float[np.ndarray, "w f"]) -> float:
        """Infinite for a kind that training does not have."""
        if kind not in self.kinds:
            return float("inf")
        known, (scale, limit) = self.kinds[kind], self._scales[kind]
        return max(_nearest(v[None], known[:, w])[0] / scale[w] for w, v in enumerate(vectors[: len(scale)])) / limit


def _nearest(rows: np.ndarray, known: np.ndarray, *, others: bool = False) -> np.ndarray:
    """Distance of each row to the nearest known one (``others``: than itself); infinite where either is NaN."""
    apart = np.nan_to_num(cdist(rows, known), nan=np.inf, posinf=np.inf)
    if others:
        np.fill_diagonal(apart, np.inf)
    return apart.min(axis=1)


def control_vectors(tracks: EpisodeTracks) -> tuple[str, Float[np.ndarray, "w f"]]:
    """Number of arms, and vectors of the controls in windows of two latent frames: tool places relative to the first, tool speeds, and
    gripper openings.

    Raises: DataError for fewer frames than a window has.
    """
    place = np.asarray(tracks.T_base_tool, dtype=np.float64)[::TEMPORAL_FACTOR, :, :3, 3]
    opening = np.asarray(tracks.gripper[:, 0], dtype=np.float64)[::TEMPORAL_FACTOR] / OPENING
    if len(place) < 2:
        raise DataError(
            "Too few frames to compare controls", expected=f"more than {TEMPORAL_FACTOR}", got=tracks.num_frames
        )
    away, way = (place - place[:1]) / PLACE_M, np.diff(place, axis=0, prepend=place[:1]) / SPEED_M
    rows = np.concatenate([away.reshape(len(place), -1), opening, way.reshape(len(place), -1)], axis=1)
    return str(place.shape[1]), np.concatenate([rows[:-1], rows[1:]], axis=1)


def setup_vectors(tracks: EpisodeTracks) -> tuple[str, Float[np.ndarray, "1 f"]]:
    """Embodiment, and a vector of the head camera's first pose [m, columns of its rotation] and of its K."""
    head = tracks.views.index(HEAD_VIEW)
    pose, K = tracks.T_base_camera[0, head].astype(np.float64), tracks.K[head].astype(np.float64)
    height, width = tracks.image_size
    lens = np.array([K[0, 0] / width, K[1, 1] / height, K[0, 2] / width, K[1, 2] / height])
    return tracks.embodiment, np.concatenate([pose[:3, 3] / PLACE_M, pose[:3, :3].ravel(), lens / PLACE_M])[None]


def assess_trust(
    folder: Path, config: TrustConfig, episodes: EpisodeSet, tracks: ActionTracks, *, resamples: int, seed: int
) -> None:
    """Add TRUST_COLUMNS to the decisions of a finished evaluation (None on recorded videos), and ``trust`` to its summary.
    Novelty is measured against the training splits of ``episodes``.
    """
    training = [
        tracks.tracks(row.episode_id)
        for row in episodes.rows
        if row.split in TRAINING_SPLITS and row.episode_id in tracks
    ]
    controls = KnownRecordings.of(map(control_vectors, training), config.novelty_level)
    setups = KnownRecordings.of(map(setup_vectors, filter(_has_head_camera, training)), config.novelty_level)
    rows = read_rows(folder / DECISIONS_FILE)
    predicted = [row for row in rows if row["method"] != TRUE_METHOD]
    novelties: dict[str, dict[str, float | None]] = defaultdict(lambda: {"new_controls": None, "new_setup": None})
    for name in {row["episode_id"] for row in predicted if row["episode_id"] in tracks}:
        found = tracks.tracks(name)
        novelties[name]["new_controls"] = controls.novelty(*control_vectors(found))
        if _has_head_camera(found):
            novelties[name]["new_setup"] = setups.novelty(*setup_vectors(found))
    predicted = [{**row, **novelties[row["episode_id"]]} for row in predicted]
    trusted, methods = trust_verdicts(predicted, config, resamples=resamples, seed=seed)
    trusted += [{**dict.fromkeys(TRUST_COLUMNS), **row} for row in rows if row["method"] == TRUE_METHOD]
    trusted.sort(key=lambda row: (row["method"], row["episode_id"], row["seed"]))
    write_table(folder / DECISIONS_FILE, trusted, tuple(trusted[0]))
    facts = {"settings": config.model_dump(mode="json"), "training_recordings": len(training), "methods": methods}
    write_json_atomic(folder / SUMMARY_FILE, read_json(folder / SUMMARY_FILE) | {"trust": facts})


def _has_head_camera(tracks: EpisodeTracks) -> bool:
    return tracks.camera_motion[tracks.views.index(HEAD_VIEW)] != "absent"


def trust_verdicts(
    rows: Sequence[Mapping[str, Any]], config: TrustConfig, *, resamples: int, seed: int
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Verdicts with their signals, trust and marks, and by method how reliable trust is, or the ``reason`` why there is none.

    Args:
        rows: verdicts on predicted videos with their novelties, and confidence None where the judge stated none.

    Raises ConfigError where ``compare_with`` names a method without verdicts.
    """
    by_method: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in sorted(rows, key=lambda row: row["method"]):
        by_method[row["method"]].append(dict(row))
    if unknown := {*config.compare_with, *config.compare_with.values()} - by_method.keys():
        raise ConfigError(
            "A method has no verdicts to compare with", where="evaluate_policy.trust.compare_with",
            expected=f"some of {', '.join(by_method)}", got=", ".join(sorted(unknown)),
        )  # fmt: skip
    methods: dict[str, Any] = {}
    for method, own in by_method.items():
        _add_doubt("doubt", own, own)
        _add_doubt("disagreement", own, by_method.get(config.compare_with.get(method, ""), ()))
        trust = _cross_calibrated(own, seed)
        for row, value in zip(own, [None] * len(own) if isinstance(trust, str) else trust.tolist(), strict=True):
            row["trust"] = value
            marks = [name.replace("_", " ") for name in ("new_controls", "new_setup") if (row[name] or 0.0) > 1.0]
            marks += ["doubtful verdict"] if value is not None and value < config.least_trust else []
            row["do_not_trust"] = ", ".join(marks)
        found = {"reason": trust} if isinstance(trust, str) else _reliability(own, resamples, seed)
        marked = sum(bool(row["do_not_trust"]) for row in own)
        methods[method] = {"available": "reason" not in found, "marked": marked, **found}
    return [row for own in by_method.values() for row in own], methods


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
    """Signals on scales of the log odds, and the names of those that all rows have."""
    known = [name for name in SIGNALS if all(row[name] is not None for row in rows)]
    columns = np.array([[row[name] for name in known] for row in rows], dtype=np.float64)
    if np.isnan(columns).any():
        place, column = np.argwhere(np.isnan(columns))[0]
        raise DataError("A signal of trust is NaN", where=f"{known[column]} of {rows[place]['episode_id']}")
    for column, name in zip(columns.T, known, strict=False):
        if name in ("doubt", "disagreement"):
            doubt = np.clip(column, 0.0, 1.0)
            column[:] = np.log((doubt + 0.02) / (1.02 - doubt))
        else:
            column[:] = np.log(np.clip(column, 0.1, 10.0))
    return columns, known


def halves(starts: Sequence[str], seed: int) -> np.ndarray:
    """0 or 1 for each verdict, the half of its start."""
    names, index = np.unique(starts, return_inverse=True)
    half = np.empty(len(names), dtype=int)
    half[np.random.default_rng(seed).permutation(len(names))] = np.arange(len(names)) % 2
    return half[index]


def _cross_calibrated(rows: Sequence[Mapping[str, Any]], seed: int) -> Float[np.ndarray, " n"] | str:
    """Probability of each verdict to be right by the calibration of the other half, or the reason why there is none."""
    signals, known = _signals(rows)
    if not known:
        return "no signal is known: the judge states no confidence, and no training recording is to compare with"
    right = np.array([row["predicted"] == row["outcome"] for row in rows])
    half = halves([row["start"] for row in rows], seed)
    counts = [(int(right[half == h].sum()), int((~right[half == h]).sum())) for h in (0, 1)]
    fewest = min(counts, key=min)
    if min(fewest) < LEAST_OF_EACH:
        return f"one half of the starts has {fewest[0]} right and {fewest[1]} wrong verdicts; {LEAST_OF_EACH} of each are needed"
    trust = np.zeros(len(rows))
    for h in (0, 1):
        trust[half == h] = probability(fit_right(signals[half != h], right[half != h]), signals[half == h])
    return trust


def fit_right(signals: Float[np.ndarray, "n s"], right: Bool[np.ndarray, " n"]) -> Float[np.ndarray, " s+1"]:
    """Intercept and weights <= 0 of the logistic model of a right verdict (slightly regularised)."""
    design = np.column_stack([np.ones(len(signals)), signals])
    sign = np.where(right, -1.0, 1.0)

    def loss(weights: np.ndarray) -> float:
        return float(np.logaddexp(0.0, sign * (design @ weights)).mean() + 1e-3 * (weights[1:] ** 2).sum())

    bounds = [(None, None), *[(None, 0.0)] * signals.shape[1]]
    return minimize(loss, np.zeros(design.shape[1]), bounds=bounds, method="L-BFGS-B").x


def probability(weights: np.ndarray, signals: Float[np.ndarray, "n s"]) -> Float[np.ndarray, " n"]:
    """Probability of a right verdict."""
    return 1.0 / (1.0 + np.exp(-np.clip(weights[0] + signals @ weights[1:], -60, 60)))


def _reliability(rows: Sequence[Mapping[str, Any]], resamples: int, seed: int) -> dict[str, Any]:
    """Calibration of trust and its detection of errors, with 95 % bootstrap intervals over starts."""
    right = np.array([row["predicted"] == row["outcome"] for row in rows])
    marked = np.array([bool(row["do_not_trust"]) for row in rows])
    trust = np.array([row["trust"] for row in rows])
    starts, start = np.unique([row["start"] for row in rows], return_inverse=True)
    counts = np.random.default_rng(seed).multinomial(len(starts), np.full(len(starts), 1.0 / len(starts)), resamples)
    everything = np.arange(len(rows))
    drawn = [np.repeat(everything, count[start]) for count in counts]

    def interval(statistic: Callable[[np.ndarray], float]) -> dict[str, float | None]:
        value, *others = (float(statistic(numbers)) for numbers in (everything, *drawn))
        defined = [other for other in others if np.isfinite(other)]
        low, high = np.quantile(defined, [0.025, 0.975]).tolist() if defined else (None, None)
        return {"value": value if np.isfinite(value) else None, "low": low, "high": high}

    def share(values: np.ndarray, chosen: np.ndarray) -> dict[str, float | None]:
        return interval(lambda i: values[i][chosen[i]].mean() if chosen[i].any() else np.nan)

    bins = np.searchsorted(np.unique(np.quantile(trust, np.linspace(0, 1, 11)[1:-1])), trust, side="right")
    return {
        "verdicts": len(rows),
        "error": share(~right, everything >= 0),
        "error_of_marked": share(~right, marked),
        "error_of_others": share(~right, ~marked),
        "auroc": interval(lambda i: area_under_curve(trust[i], right[i])),
        "calibration_error": interval(lambda i: float(np.abs(np.bincount(bins[i], (trust - right)[i])).sum() / len(i))),
        "reliability": [
            {"trust": float(trust[bins == b].mean()), "count": int((bins == b).sum()), **share(right, bins == b)}
            for b in np.unique(bins)
        ],
    }
