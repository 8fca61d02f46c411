"""Trust in verdicts on predicted videos: how likely each one is right, and how new its recording is to the model.

Signals of a verdict are the judge's doubt (averaged over the seeds of an episode), the disagreement of verdicts on another model's
predictions, and the novelty of the controls and of the setup (body and head camera). A logistic model whose weights are never
positive turns them into a probability. Starts are halved and each half is calibrated with the other one. ``trust.safetensors`` keeps
the calibration for evaluations whose outcomes are unknown.

Novelty is the distance to the nearest training recording, of the farthest window, in units of what a share ``1 - level`` of the
training recordings stay within among themselves (conformal anomaly detection, Laxhammar and Falkman 2010).

Axis legend: n verdicts, s signals, r recordings, w windows, f features, a arms.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from pydantic import ConfigDict, Field, ValidationError
from safetensors import SafetensorError, safe_open
from scipy.optimize import minimize
from scipy.spatial.distance import cdist
from scipy.stats import rankdata

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.actions.episode_tracks import HEAD_VIEW, ActionTracks, EpisodeTracks
from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode import TRAINING_SPLITS
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.evaluation.evaluation_config import TrustConfig
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.store.artifact_files import digest_folder, is_artifact, read_manifest
from worldline_core.store.atomic import write_arrays_atomic

TRUST_FILE = "trust.safetensors"
SIGNALS = ("doubt", "disagreement", "new_controls", "new_setup")
TRUST_COLUMNS = (*SIGNALS, "trust", "do_not_trust")
LEAST_OF_EACH = 5
"""Right and wrong verdicts that a half needs to calibrate with."""
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
        """Collect recordings, each a kind and its vectors; a share ``level`` of them has a novelty above 1.

        Raises: DataError when no kind has five recordings.
        """
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
                "Too few training recordings to measure novelty", got={k: len(v) for k, v in by_kind.items()},
                expected=f"{LEAST_RECORDINGS} with as many arms, and {LEAST_RECORDINGS} of one embodiment with a head camera",
                next_step="add recordings of the training splits to the episodes, or leave evaluate_policy.trust out",
            )  # fmt: skip
        return cls(kinds, level)

    @cached_property
    def _scales(self) -> dict[str, tuple[np.ndarray, float]]:
        """Median distance of each window to its nearest neighbour, and the limit of the farthest window in these units."""
        found = {}
        for kind, known in self.kinds.items():
            own = np.stack([_nearest(window, window, others=True) for window in known.swapaxes(0, 1)])
            there = np.isfinite(own)
            scale = np.array([max(float(np.median(row[row < np.inf])), 1e-6) for row in own])
            farthest = np.where(there, own / scale[:, None], 0.0).max(axis=0)
            found[kind] = scale, max(float(np.quantile(farthest, 1.0 - self.level)), 1e-6)
        return found

    def novelty(self, kind: str, vectors: Float[np.ndarray, "w f"]) -> float:
        """Novelty of a recording; infinite for a kind that training does not have."""
        if kind not in self.kinds:
            return float("inf")
        scale, limit = self._scales[kind]
        known = self.kinds[kind]
        return max(_nearest(v[None], known[:, w])[0] / scale[w] for w, v in enumerate(vectors[: len(scale)])) / limit


def _nearest(rows: np.ndarray, known: np.ndarray, *, others: bool = False) -> np.ndarray:
    """Distance of each row to the nearest known one (``others``: than itself); infinite where either is NaN."""
    apart = np.nan_to_num(cdist(rows, known), nan=np.inf, posinf=np.inf)
    if others:
        np.fill_diagonal(apart, np.inf)
    return apart.min(axis=1)


def control_vectors(
    T_base_tool: Float[np.ndarray, "n a 4 4"], gripper: Float[np.ndarray, "n a"]
) -> tuple[str, Float[np.ndarray, "w f"]]:
    """Number of arms, and vectors of the controls in windows of two latent frames: where the tools are from where they began, how
    fast they move, and how far the grippers are open.

    Raises: DataError for fewer frames than a window has.
    """
    place = np.asarray(T_base_tool, dtype=np.float64)[::TEMPORAL_FACTOR, :, :3, 3]
    opening = np.asarray(gripper, dtype=np.float64)[::TEMPORAL_FACTOR] / OPENING
    if len(place) < 2:
        raise DataError(
            "Too few frames to compare their controls", expected=f"more than {TEMPORAL_FACTOR}", got=len(T_base_tool)
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


class JudgedBy(StrictModel):
    """A judge, and the views, the segmenter and the weights (a digest) that it sees by."""

    judge: str
    views: tuple[str, ...]
    segmenter: str
    segmenter_weights: str | None


class PredictedBy(StrictModel):
    """A checkpoint (its digest) and how it was sampled; ``steps`` None is the sampler's usual number."""

    checkpoint: str | None
    sampler: str
    steps: int | None
    shift: float = 1.0
    actions: str = "true"
    stride: int = 1


class TrustCalibration(StrictModel):
    """Logistic model of a right verdict on one model's videos: weights of the intercept and of each signal."""

    predicted_by: PredictedBy
    signals: tuple[str, ...]
    weights: tuple[float, ...]

    def trust(self, rows: Sequence[Mapping[str, Any]]) -> Float[np.ndarray, " n"] | str:
        """The trust in each verdict, or the reason why there is none."""
        values, known = _signals(rows)
        if missing := [name for name in self.signals if name not in known]:
            return f"the calibration reads {', '.join(missing)}, which not all of these verdicts have"
        return probability(np.array(self.weights), values[:, [known.index(name) for name in self.signals]])


class TrustModel(StrictModel):
    """The training recordings that novelty is measured against, and calibrations by method where they were made before.

    Calibrations hold for the judge, the embodiments and the models that they were made with.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)

    judged_by: JudgedBy
    embodiments: tuple[str, ...] = ()
    least_trust: float
    novelty_level: float
    training_recordings: int
    methods: dict[str, TrustCalibration] = Field(default={})
    controls: KnownRecordings = Field(exclude=True)
    setups: KnownRecordings = Field(exclude=True)

    @classmethod
    def of_training(
        cls, episodes: EpisodeSet, tracks: ActionTracks, judged_by: JudgedBy, config: TrustConfig
    ) -> TrustModel:
        """The recordings of the training splits that have action tracks, not yet calibrated.

        Raises: DataError for too few.
        """
        rows = [row for row in episodes.rows if row.split in TRAINING_SPLITS and row.episode_id in tracks]
        known = [tracks.tracks(row.episode_id) for row in rows]
        controls = (control_vectors(t.T_base_tool, t.gripper[:, 0]) for t in known)
        level = config.novelty_level
        return cls(
            judged_by=judged_by, least_trust=config.least_trust, novelty_level=level, training_recordings=len(known),
            controls=KnownRecordings.of(controls, level),
            setups=KnownRecordings.of(map(setup_vectors, filter(_has_head_camera, known)), level),
        )  # fmt: skip

    @classmethod
    def read(cls, path: Path) -> TrustModel:
        """Read ``trust.safetensors``, or that of an evaluate_policy artifact.

        Raises: ArtifactError when it is missing or damaged.
        """
        file = path / TRUST_FILE if path.is_dir() else path
        if not file.is_file():
            raise ArtifactError(
                "There is no saved calibration of trust", where=file,
                next_step="run evaluate_policy with trust on recordings with known outcomes, and name its folder",
            )  # fmt: skip
        try:
            with safe_open(file, framework="np") as opened:
                header = json.loads((opened.metadata() or {})["trust"])
                arrays = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
            known: dict[str, Any] = {
                part: KnownRecordings(
                    {n.removeprefix(f"{part}/"): a for n, a in arrays.items() if n.startswith(f"{part}/")},
                    header["novelty_level"],
                )
                for part in ("controls", "setups")
            }
            model = cls.model_validate({**header, **known})
        except (SafetensorError, ValidationError, ValueError, KeyError, TypeError) as error:
            raise ArtifactError("Not a saved calibration of trust", where=file, got=error) from error
        sized = all(len(made.weights) == 1 + len(made.signals) for made in model.methods.values())
        if not sized or any(
            array.ndim != 3 or (np.isfinite(array).all(-1).sum(0) < LEAST_RECORDINGS).any() for array in arrays.values()
        ):
            raise ArtifactError("A saved calibration of trust is damaged", where=file)
        return model

    def write(self, folder: Path) -> None:
        """Write ``trust.safetensors``."""
        known = {"controls": self.controls, "setups": self.setups}
        arrays = {f"{part}/{kind}": array for part, found in known.items() for kind, array in found.kinds.items()}
        write_arrays_atomic(folder / TRUST_FILE, arrays, {"trust": self.model_dump_json()})

    def require(self, judged_by: JudgedBy, embodiments: Iterable[str]) -> None:
        """Raises: ConfigError when verdicts are of another judge, or on robots that the calibration was not made with."""
        unknown = sorted(set(embodiments) - set(self.embodiments))
        if judged_by != self.judged_by or unknown:
            raise ConfigError(
                "A saved calibration of trust is not of these verdicts", where="trust",
                expected=f"{self.judged_by}; robots {', '.join(self.embodiments)}",
                got=f"{judged_by}; " + (f"other robots: {', '.join(unknown)}" if unknown else "the same robots"),
                next_step="calibrate with this judge where outcomes of these robots are known",
            )  # fmt: skip

    def calibration_of(self, predicted_by: PredictedBy | None) -> TrustCalibration | str:
        """The calibration for such videos, or the reason why there is none."""
        fitting = (made for made in self.methods.values() if predicted_by and made.predicted_by == predicted_by)
        known = "; ".join(f"{name}: {made.predicted_by}" for name, made in self.methods.items()) or "none"
        asked = predicted_by or "videos of an unknown model"
        return next(fitting, f"the saved calibration is of other videos than these ({asked}); it has {known}")

    def novelties(self, tracks: ActionTracks, episode_id: str) -> dict[str, float | None]:
        """``new_controls`` and ``new_setup`` of an episode; None without its tracks, or without its head camera."""
        if episode_id not in tracks:
            return {"new_controls": None, "new_setup": None}
        found = tracks.tracks(episode_id)
        setup = self.setups.novelty(*setup_vectors(found)) if _has_head_camera(found) else None
        controls = self.controls.novelty(*control_vectors(found.T_base_tool, found.gripper[:, 0]))
        return {"new_controls": controls, "new_setup": setup}


def _has_head_camera(tracks: EpisodeTracks) -> bool:
    return tracks.camera_motion[tracks.views.index(HEAD_VIEW)] != "absent"


def content_digest(folder: Path) -> str:
    """Digest of a folder of weights, as in manifests of what was made with it."""
    return str(read_manifest(folder)["digest"]) if is_artifact(folder) else digest_folder(folder, everything=True)


def predicted_by(rollouts: Path) -> PredictedBy | None:
    """The model and sampler of a finished RolloutSet; None for imported videos."""
    manifest: dict[str, Any] = read_manifest(rollouts)
    config = manifest.get("config", {})
    if "sampler" not in config:
        return None
    found = {**config, **config["sampler"], "sampler": config["sampler"]["kind"]}
    used = {name: found[name] for name in PredictedBy.model_fields if name in found}
    return PredictedBy(checkpoint=manifest.get("inputs", {}).get("checkpoint", {}).get("digest"), **used)


def assess_trust(
    verdicts: Sequence[Mapping[str, Any]],
    config: TrustConfig,
    model: TrustModel,
    tracks: ActionTracks,
    rollouts: Mapping[str, RolloutSet],
    output: Path,
    *,
    resamples: int,
    seed: int,
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The verdicts of a finished evaluation with :data:`TRUST_COLUMNS` (None on recorded videos), and how reliable trust is.

    Calibrates and writes ``trust.safetensors``, unless ``config.calibration`` names an earlier one.
    """
    predicted = [row for row in verdicts if row["method"] in rollouts]
    news = {name: model.novelties(tracks, name) for name in {row["episode_id"] for row in predicted}}
    made_by = {method: predicted_by(rollout.root) for method, rollout in rollouts.items()}
    saved = None if config.calibration is None else {name: model.calibration_of(by) for name, by in made_by.items()}
    rows = [{**row, **news[row["episode_id"]]} for row in predicted]
    rows, methods = trust_verdicts(rows, config, saved=saved, resamples=resamples, seed=seed)
    if saved is None:
        calibrations = {
            name: calibrated([row for row in rows if row["method"] == name], by)
            for name, by in made_by.items()
            if by is not None and methods.get(name, {}).get("available")
        }
        robots = tuple(sorted({row["embodiment"] for row in predicted}))
        model.model_copy(update={"methods": calibrations, "embodiments": robots}).write(output)
    rows += [{**dict.fromkeys(TRUST_COLUMNS), **row} for row in verdicts if row["method"] not in rollouts]
    facts = {"settings": config.model_dump(mode="json"), "training_recordings": model.training_recordings}
    return rows, {**facts, "methods": methods}


def trust_verdicts(
    rows: Sequence[Mapping[str, Any]],
    config: TrustConfig,
    *,
    saved: Mapping[str, TrustCalibration | str] | None = None,
    resamples: int,
    seed: int,
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Verdicts with their signals, trust and marks, and by method how reliable trust is, or the ``reason`` why there is none.

    Args:
        rows: verdicts on predicted videos with method, episode_id, start, outcome, predicted, confidence (None where the judge stated
            none) and novelties.
        saved: calibration of each method, or the reason why there is none (outcomes may be ``unknown``); None calibrates here.

    Raises:
        ConfigError: ``compare_with`` names a method without verdicts.
        DataError: a signal is NaN.
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
        made = None if saved is None else saved[method]
        trust = _cross_calibrated(own, seed) if made is None else made if isinstance(made, str) else made.trust(own)
        for row, value in zip(own, [None] * len(own) if isinstance(trust, str) else trust.tolist(), strict=True):
            row["trust"] = value
            row["do_not_trust"] = ", ".join(reasons(row, config.least_trust))
        known = [row for row in own if row["outcome"] in ("success", "failure")]
        if not isinstance(trust, str) and not known:
            trust = "no outcome is recorded, so the reliability of the saved calibration is unknown here"
        found = {"reason": trust} if isinstance(trust, str) else _reliability(known, resamples, seed)
        marked = sum(bool(row["do_not_trust"]) for row in own)
        methods[method] = {"available": "reason" not in found, "marked": marked, **found}
    return [row for own in by_method.values() for row in own], methods


def calibrated(rows: Sequence[Mapping[str, Any]], predicted_by: PredictedBy) -> TrustCalibration:
    """The calibration by all verdicts of a method with known outcomes."""
    signals, known = _signals(rows)
    weights = fit_right(signals, _right(rows))
    return TrustCalibration(predicted_by=predicted_by, signals=tuple(known), weights=tuple(weights))


def reasons(row: Mapping[str, Any], least_trust: float) -> list[str]:
    """The reasons not to rely on a verdict; empty for one that may be trusted."""
    new = [name.replace("_", " ") for name in ("new_controls", "new_setup") if (row[name] or 0.0) > 1.0]
    return new + (["doubtful verdict"] if row["trust"] is not None and row["trust"] < least_trust else [])


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
    """Signals on scales on which the log odds may be linear, and the names of those that all rows have."""
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


def _right(rows: Sequence[Mapping[str, Any]]) -> Bool[np.ndarray, " n"]:
    return np.array([row["predicted"] == row["outcome"] for row in rows])


def halves(starts: Sequence[str], seed: int) -> np.ndarray:
    """0 or 1 for each verdict: the half that its start was drawn into."""
    names, index = np.unique(starts, return_inverse=True)
    half = np.empty(len(names), dtype=int)
    half[np.random.default_rng(seed).permutation(len(names))] = np.arange(len(names)) % 2
    return half[index]


def _cross_calibrated(rows: Sequence[Mapping[str, Any]], seed: int) -> Float[np.ndarray, " n"] | str:
    """Probability of each verdict to be right by the calibration of the other half, or the reason why there is none."""
    signals, known = _signals(rows)
    if not known:
        return (
            "no signal is known: the judge states no confidence, and there are no training recordings to compare with"
        )
    right, half = _right(rows), halves([row["start"] for row in rows], seed)
    counts = [(int(right[half == h].sum()), int((~right[half == h]).sum())) for h in (0, 1)]
    fewest = min(counts, key=min)
    if min(fewest) < LEAST_OF_EACH:
        return (
            f"of the {len({row['start'] for row in rows})} starts, one half has {fewest[0]} right and {fewest[1]} wrong"
            f" verdicts; {LEAST_OF_EACH} of each are needed to calibrate with"
        )
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
    """The probability that a verdict with these signals is right."""
    return 1.0 / (1.0 + np.exp(-np.clip(weights[0] + signals @ weights[1:], -60, 60)))


def _reliability(rows: Sequence[Mapping[str, Any]], resamples: int, seed: int) -> dict[str, Any]:
    """Calibration of trust and its detection of errors, with 95 % bootstrap intervals over starts."""
    right, marked = _right(rows), np.array([bool(row["do_not_trust"]) for row in rows])
    trust = np.array([row["trust"] for row in rows])
    starts, start = np.unique([row["start"] for row in rows], return_inverse=True)
    chance = np.full(len(starts), 1.0 / len(starts))
    counts = np.random.default_rng(seed).multinomial(len(starts), chance, resamples)
    everything = np.arange(len(rows))
    drawn = [np.repeat(everything, count[start]) for count in counts]

    def interval(statistic: Callable[[np.ndarray], float]) -> dict[str, float | None]:
        """Value and interval of a statistic of the numbers of verdicts; None where it is not defined."""
        value, *others = (float(statistic(numbers)) for numbers in (everything, *drawn))
        defined = [other for other in others if np.isfinite(other)]
        low, high = np.quantile(defined, [0.025, 0.975]).tolist() if defined else (None, None)
        return {"value": value if np.isfinite(value) else None, "low": low, "high": high}

    def share(values: np.ndarray, chosen: np.ndarray) -> dict[str, float | None]:
        return interval(lambda i: values[i][chosen[i]].mean() if chosen[i].any() else np.nan)

    def auroc(i: np.ndarray) -> float:
        """Chance that a wrong verdict has less trust than a right one; ties count half (Mann and Whitney's U)."""
        wrong = int((~right[i]).sum())
        pairs = wrong * (len(i) - wrong)
        return (rankdata(-trust[i])[~right[i]].sum() - wrong * (wrong + 1) / 2) / pairs if pairs else np.nan

    # Ten bins of about equal size; equal trust shares one.
    bins = np.searchsorted(np.unique(np.quantile(trust, np.linspace(0, 1, 11)[1:-1])), trust, side="right")
    return {
        "verdicts": len(rows),
        "error": share(~right, everything >= 0),
        "error_of_marked": share(~right, marked),
        "error_of_others": share(~right, ~marked),
        "auroc": interval(auroc),
        "calibration_error": interval(lambda i: float(np.abs(np.bincount(bins[i], (trust - right)[i])).sum() / len(i))),
        "reliability": [
            {"trust": float(trust[bins == b].mean()), "count": int((bins == b).sum()), **share(right, bins == b)}
            for b in np.unique(bins)
        ],
    }
