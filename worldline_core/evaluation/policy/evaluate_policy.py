"""The step evaluate_policy: does a judge who sees only predicted videos agree with what really happened?

As many successes as failures are judged in every split and task family: of every method those that it predicted, first of all those
that all methods predicted. The recorded videos are judged too (method ``true``): that accuracy is the judge's own ceiling. Accuracy
is averaged over the seeds of a recording, by split and task family, with intervals. Shortcuts, which see no video
(`evaluation.shortcuts`), give verdicts on the same attempts: what a model knows counts over the best of them.
"""

from __future__ import annotations

import json
import logging
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.stats import rankdata

from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation.evaluation_config import PolicyEvaluationConfig
from worldline_core.evaluation.policy.judge import Judge, Judgement, VLMJudge, confidence_of, judge_trajectory
from worldline_core.evaluation.policy.learned_judge import open_learned_judge
from worldline_core.evaluation.policy.measured_judge import MeasuredEvidenceJudge
from worldline_core.evaluation.policy.trust import assess_trust
from worldline_core.evaluation.recordings import (
    Trajectory,
    open_rollouts,
    open_tracks,
    rows_of,
    stride_of,
    trajectory_of,
)
from worldline_core.evaluation.scores import (
    DECISIONS_FILE,
    SUMMARY_FILE,
    TRUE_METHOD,
    Score,
    bootstrap_mean,
    kept_part,
    part_file,
    write_scores,
    write_table,
)
from worldline_core.evaluation.segmenters.segmenter import open_segmenter
from worldline_core.evaluation.shortcuts import verdicts_without_video
from worldline_core.evaluation.vlm import open_vlm
from worldline_core.progress import with_progress
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.store.atomic import write_json_atomic

logger = logging.getLogger(__name__)

_OUTCOMES = ("success", "failure")
_ALL = "all"
_LABELS = ("episode_id", "embodiment", "split", "scene", "task_family", "instruction", "outcome")
_COLUMNS = (
    "method", "episode_id", "embodiment", "split", "scene", "task_family", "seed", "start", "instruction",
    "outcome", "predicted", "undecided", "confidence", "evidence_family", "decided_by", "answers", "malformed_answers", "evidence",
)  # fmt: skip


def evaluate_policy(config: PolicyEvaluationConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Judge every method's videos and compare with the recorded outcomes.

    Inputs: episodes, rollouts.<method>; tracks, segmenter and judge where the judge uses them.
    Output: scores.parquet (metric ``correct``), decisions.parquet (every verdict with its evidence), summary.json.
    """
    episodes, rollouts, tracks = EpisodeSet.open(inputs["episodes"]), open_rollouts(inputs), open_tracks(inputs)
    predicted = {method: set(rollout.episode_ids) for method, rollout in rollouts.items()}
    times = Counter(name for names in predicted.values() for name in names)
    rows = rows_of(episodes, times)
    chosen = choose_trajectories(config, rows, times)
    if config.compare_policies and chosen:
        require_policies({row.source for row in chosen})
    if config.trust and tracks is None:
        raise ConfigError(
            "Trust in verdicts needs the controls", where="evaluate_policy.trust", expected="the input tracks",
            next_step="run render_actions and give its folder as --input tracks=FOLDER",
        )  # fmt: skip
    judge_name, judge = open_judge(config, inputs)

    def judge_video(row: EpisodeRow, rollout: RolloutSet | None, seed: int) -> dict[str, Any]:
        video = trajectory_of(episodes, row, config.views, rollout=rollout, seed=seed, tracks=tracks)
        seen = video.num_frames * (1 if rollout is None else stride_of(rollout, row))
        return {"num_frames": seen, **asdict(judge(video))}

    judged: list[dict[str, Any]] = []
    for row in with_progress(chosen, "evaluate_policy", "recording"):
        known_to = [method for method, names in predicted.items() if row.episode_id in names]
        predictions = [(method, seed) for method in known_to for seed in rollouts[method].seeds(row.episode_id)]
        for method, seed in [(TRUE_METHOD, 0), *predictions]:
            part = part_file(output / "run" / "parts", method, row.episode_id, seed)
            verdict = kept_part(part, partial(judge_video, row, rollouts.get(method), seed))
            judged.append(_decision(row, method, seed, verdict))
    # The outcome may come after the end of a video that is shorter than its recording.
    too_short = Counter(verdict["method"] for verdict in judged if not verdict["whole"])
    if too_short:
        logger.warning("Predictions shorter than their recordings were not judged: %s", dict(too_short))
    verdicts = [verdict for verdict in judged if verdict["whole"]]
    counts = _count(config, rows, chosen, verdicts, inputs["episodes"])

    resampling = {"resamples": config.resamples, "seed": config.seed}
    judged_rows = [row for row in chosen if row.episode_id in {verdict["episode_id"] for verdict in verdicts}]
    tasks = {verdict["episode_id"]: verdict["task"] for verdict in verdicts}
    shortcuts = verdicts_without_video(episodes, tracks, judged_rows, tasks)
    summary = summarise_decisions(verdicts, shortcuts, **resampling)
    summary |= {"judge": judge_name, "interval": "95 % bootstrap over trajectories"}
    summary["shorter_than_recording"] = dict(too_short)
    if config.compare_policies:
        summary["policies"] = policy_agreement(verdicts, **resampling)
    verdicts.sort(key=lambda row: (row["method"], row["episode_id"], row["seed"]))
    write_table(output / DECISIONS_FILE, verdicts, _COLUMNS)
    write_scores(output, map(_correctness, verdicts))
    write_json_atomic(output / SUMMARY_FILE, summary)
    if config.trust and tracks:
        assess_trust(output, config.trust, episodes, tracks, **resampling)
    overall = {name: found[_ALL]["accuracy"]["mean"] for name, found in summary["methods"].items()}
    return counts | {"trajectories": summary["trajectories"], "judge": judge_name, "accuracy": overall}


def choose_trajectories(
    config: PolicyEvaluationConfig, rows: Sequence[EpisodeRow], times: Mapping[str, int]
) -> list[EpisodeRow]:
    """Draw as many successes as failures in every split and task family, first those that more methods predicted (``times``)."""
    groups: dict[tuple[str, str], dict[str, list[EpisodeRow]]] = defaultdict(lambda: {name: [] for name in _OUTCOMES})
    for row in rows:
        if row.split in config.splits and row.outcome in _OUTCOMES:
            groups[row.split, row.task_family][row.outcome].append(row)
    chosen: list[EpisodeRow] = []
    generator = np.random.default_rng(config.seed)
    for _, group in sorted(groups.items()):
        fewest = min(len(group[outcome]) for outcome in _OUTCOMES)
        for outcome in _OUTCOMES:
            members = sorted(group[outcome], key=lambda row: row.episode_id)
            limit = fewest if config.balanced else len(members)
            drawn = generator.permutation(len(members))
            picked = sorted(drawn, key=lambda index: -times[members[index].episode_id])[:limit]
            chosen += [members[index] for index in sorted(picked)]
    return sorted(chosen, key=lambda row: row.episode_id)


def open_judge(
    config: PolicyEvaluationConfig, inputs: Mapping[str, Path]
) -> tuple[str, Callable[[Trajectory], Judgement]]:
    """Name and verdicts of the judge that the config names, from the inputs ``segmenter`` or ``judge``."""
    if config.judge == "learned":
        learned = open_learned_judge(inputs.get("judge"))
        return learned.name, learned.judge
    judge: Judge
    if config.judge == "measured":
        opened = open_segmenter(config.segmenter, learned=inputs.get("segmenter"), sam3=config.sam3_weights)
        judge = MeasuredEvidenceJudge(opened)
    else:
        judge = VLMJudge(open_vlm(config.judge, config.vlm))
    return judge.name, partial(judge_trajectory, judge)


def _decision(row: EpisodeRow, method: str, seed: int, verdict: Mapping[str, Any]) -> dict[str, Any]:
    """A row of the decisions; ``whole`` where the video shows the recording to its end."""
    return {
        **{label: getattr(row, label) for label in _LABELS},
        **{key: verdict[key] for key in ("decided_by", "answers", "malformed_answers", "undecided")},
        "method": method,
        "seed": seed,
        "policy": row.source,
        "start": row.bank or row.episode_id,
        "task": row.instruction.split(maxsplit=1)[0].lower() if row.instruction.strip() else "none",
        "whole": verdict["num_frames"] >= row.video_frames,
        "predicted": "success" if verdict["success"] else "failure",
        "evidence_family": verdict["family"],
        "evidence": json.dumps(verdict["statements"], sort_keys=True),
        "confidence": confidence_of(verdict),
    }


def _count(
    config: PolicyEvaluationConfig,
    rows: Sequence[EpisodeRow],
    chosen: Sequence[EpisodeRow],
    verdicts: Sequence[Mapping[str, Any]],
    where: Path,
) -> dict[str, Any]:
    """Episodes found, kept and left out by reason.

    Raises: DataError when none is left.
    """
    inside = [row for row in rows if row.split in config.splits]
    judgeable = [row for row in inside if row.outcome in _OUTCOMES]
    kept = len({verdict["episode_id"] for verdict in verdicts if verdict["method"] != TRUE_METHOD})
    left_out = {
        "in other splits": len(rows) - len(inside),
        "without a recorded success or failure": len(inside) - len(judgeable),
        "not drawn (evaluate_policy.balanced)": len(judgeable) - len(chosen),
        "predicted shorter than recorded": len(chosen) - kept,
    }
    if not verdicts:
        raise DataError(
            "No video can be judged",
            where=where,
            expected=f"predictions of recordings of the splits {', '.join(config.splits)} that ended in success or failure",
            got=f"{len(rows)} predicted episodes: " + ", ".join(f"{n} {reason}" for reason, n in left_out.items() if n),
            next_step="predict recordings with known outcomes, or leave the judgement out: evaluate_policy: null",
        )
    return {"found": len(rows), "kept": kept, "left_out": left_out}


def _correctness(row: Mapping[str, Any]) -> Score:
    return Score(
        row["method"], row["episode_id"], row["embodiment"], row["split"], "", row["seed"], "correct",
        float(row["predicted"] == row["outcome"]), row["scene"], row["task_family"], row["outcome"],
    )  # fmt: skip


def summarise_decisions(
    rows: Sequence[Mapping[str, Any]], shortcuts: Mapping[str, Mapping[str, bool]], *, resamples: int, seed: int
) -> dict[str, Any]:
    """Accuracy of every method and group.

    Args:
        rows: verdicts with method, episode_id, split, task_family, outcome, predicted, undecided, answers, malformed_answers.
        shortcuts: success by shortcut and episode, without any video.

    Returns:
        {"trajectories", "methods": {method: {group: {"accuracy": interval, "confusion": {...}, "over_shortcut": {"shortcut", "gain": interval},
        "undecided": {"share", "accuracy_of_decided"}}}}, "shortcuts": {shortcut: {group: interval}}}; groups are "all", each split, each
        family, and split/family; an undecided verdict counts as the nearer side; a gain is over the shortcut that is right most often
        there, recording by recording.
    """
    outcomes = {row["episode_id"]: row["outcome"] == "success" for row in rows}
    correct = {
        name: {episode: float(own[episode] == end) for episode, end in outcomes.items()}
        for name, own in shortcuts.items()
    }
    by_group: dict[str, dict[str, Any]] = defaultdict(dict)
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = defaultdict(list)
    for row in rows:
        names = (_ALL, row["split"], row["task_family"], f"{row['split']}/{row['task_family']}")
        for name in dict.fromkeys(names):
            groups[row["method"], name].append(row)
    methods: dict[str, dict[str, Any]] = defaultdict(dict)
    for (method, group), members in sorted(groups.items()):
        confusion = {"true_success": 0, "false_success": 0, "true_failure": 0, "false_failure": 0}
        for row in members:
            right = "true" if row["predicted"] == row["outcome"] else "false"
            confusion[f"{right}_{row['predicted']}"] += 1
        own = _accuracy(members)
        accuracy = bootstrap_mean(list(own.values()), resamples=resamples, seed=seed)
        best = max(sorted(correct), key=lambda name: np.mean([correct[name][episode] for episode in own]))
        gains = [value - correct[best][episode] for episode, value in own.items()]
        gain = asdict(bootstrap_mean(gains, resamples=resamples, seed=seed))
        if method == TRUE_METHOD:
            for name, values in correct.items():
                found = bootstrap_mean([values[episode] for episode in own], resamples=resamples, seed=seed)
                by_group[name][group] = asdict(found)
        decided = [row for row in members if not row["undecided"]]
        methods[method][group] = {
            "accuracy": asdict(accuracy),
            "undecided": {
                "share": 1.0 - len(decided) / len(members),
                "accuracy_of_decided": float(np.mean([row["predicted"] == row["outcome"] for row in decided]))
                if decided
                else None,
            },
            "over_shortcut": {"shortcut": best, "gain": gain},
            "confusion": confusion,
            **{name: sum(row[name] for row in members) for name in ("malformed_answers", "answers")},
        }
    return {
        "trajectories": len({row["episode_id"] for row in rows}),
        "methods": dict(methods),
        "shortcuts": dict(by_group),
    }


def _accuracy(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Share of right verdicts by trajectory."""
    values: dict[str, list[float]] = defaultdict(list)
    for row in rows:
        values[row["episode_id"]].append(float(row["predicted"] == row["outcome"]))
    return {name: sum(items) / len(items) for name, items in sorted(values.items())}


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

    Raises: DataError: fewer than three policies.
    """
    require_policies({row["policy"] for row in rows})
    found: dict[str, dict[str, Any]] = defaultdict(dict)
    for method in sorted({row["method"] for row in rows}):
        of_method = [row for row in rows if row["method"] == method]
        for task in (_ALL, *sorted({row["task"] for row in of_method})):
            chosen = [row for row in of_method if task in (_ALL, row["task"])]
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
            "value": float(value) if np.isfinite(value) else None,
            "over_starts_and_policies": _bounds(intervals[name]),
        }
        for name, value in values.items()
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
