"""The step evaluate_policy: does a judge who sees only predicted videos agree with what really happened?

As many successes as failures are judged in every split and task family: of every method those that it predicted, first of
all those that all methods predicted, so that one with few videos narrows no other's figure. The recorded videos are judged too (method ``true``): that accuracy is the judge's own ceiling. Accuracy is pooled per seed
and averaged over seeds, by split and task family, with intervals.
"""

from __future__ import annotations

import json
import logging
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.evaluation.evaluation_config import PolicyEvaluationConfig
from worldline_core.evaluation.policy.agreement import policy_agreement, require_policies
from worldline_core.evaluation.policy.judge import Judge, confidence_of, judge_trajectory
from worldline_core.evaluation.policy.measured_judge import MeasuredEvidenceJudge
from worldline_core.evaluation.policy.novelty import KnownSetting
from worldline_core.evaluation.policy.saved_trust import JudgedBy, SavedMethod, SavedTrust, content_digest, predicted_by
from worldline_core.evaluation.policy.trust import TRUST_COLUMNS, calibrated, trust_verdicts
from worldline_core.evaluation.policy.vlm_judge import VLMJudge
from worldline_core.evaluation.recordings import (
    TRUE_METHOD,
    open_rollouts,
    open_tracks,
    rows_of,
    stride_of,
    trajectory_of,
)
from worldline_core.evaluation.scores import (
    SUMMARY_FILE,
    Score,
    bootstrap_mean,
    kept_part,
    method_differences,
    part_file,
    write_scores,
    write_table,
)
from worldline_core.evaluation.segmenters.segmenter import open_segmenter
from worldline_core.evaluation.vlm_models import open_vlm
from worldline_core.progress import with_progress
from worldline_core.store.atomic import write_json_atomic

logger = logging.getLogger(__name__)

DECISIONS_FILE = "decisions.parquet"
_OUTCOMES = ("success", "failure")
_ALL = "all"
_COLUMNS = (
    "method", "episode_id", "embodiment", "split", "scene", "task_family", "seed", "instruction", "outcome",
    "predicted", "evidence_family", "decided_by", "answers", "malformed_answers", "evidence",
)  # fmt: skip
_LABELS = ("episode_id", "embodiment", "split", "scene", "task_family", "instruction", "outcome")


def evaluate_policy(config: PolicyEvaluationConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Judge every method's videos and compare with the recorded outcomes.

    Inputs: episodes, rollouts.<method>; tracks and segmenter where the judge uses them.
    Output: scores.parquet (metric ``correct``), decisions.parquet (every verdict with its evidence), summary.json (with
    ``compare_policies`` also how success rates of policies agree: ``agreement.py``; with ``trust`` how far verdicts are to be
    trusted: ``trust.py``); with ``trust`` also trust.safetensors, for evaluations without outcomes (``saved_trust.py``).
    """
    episodes = EpisodeSet.open(inputs["episodes"])
    rollouts = open_rollouts(inputs)
    tracks = open_tracks(inputs)
    judge = open_judge(config, inputs.get("segmenter"))
    asked = None if config.trust is None else config.trust.calibration
    saved = None if asked is None else SavedTrust.read(asked)
    recordings = None if saved is None else (saved.controls, saved.setups, saved.training_recordings)
    known = None if config.trust is None else KnownSetting.of(episodes, tracks, config.trust, recordings)
    predicted = {method: set(rollout.episode_ids) for method, rollout in rollouts.items()}
    times = Counter(name for names in predicted.values() for name in names)
    rows = rows_of(episodes, times)
    chosen = choose_trajectories(config, rows, times)
    outcomes = chosen_outcomes(config)
    judged_by = JudgedBy(
        judge=judge.name, views=config.views, segmenter=config.segmenter,
        segmenter_weights=content_digest(inputs["segmenter"]) if "segmenter" in inputs else None,
    )  # fmt: skip
    if saved is not None:
        saved.require(judged_by, {row.embodiment for row in chosen})
    if config.compare_policies and chosen:
        require_policies({row.source for row in chosen})

    def verdict_on(row: EpisodeRow, method: str, seed: int) -> dict[str, Any]:
        rollout = rollouts.get(method)
        video = trajectory_of(episodes, row, config.views, rollout=rollout, seed=seed, tracks=tracks)
        seen = video.num_frames * (1 if rollout is None else stride_of(rollout, row))
        return {"num_frames": seen, **asdict(judge_trajectory(judge, video))}

    decisions: list[dict[str, Any]] = []
    too_short: Counter[str] = Counter()
    for row in with_progress(chosen, "evaluate_policy", "recording"):
        name = row.episode_id
        videos = [
            (TRUE_METHOD, 0),
            *(
                (method, seed)
                for method in rollouts
                if name in predicted[method]
                for seed in rollouts[method].seeds(name)
            ),
        ]
        for method, seed in videos:
            part = part_file(output / "run" / "parts", method, name, seed)
            verdict = kept_part(part, partial(verdict_on, row, method, seed))
            if verdict["num_frames"] < row.video_frames:
                too_short[method] += 1  # the outcome may lie after the end of this video
                continue
            decisions.append({
                "method": method,
                "seed": seed,
                **{label: getattr(row, label) for label in _LABELS},
                **{key: verdict[key] for key in ("decided_by", "answers", "malformed_answers")},
                "predicted": "success" if verdict["success"] else "failure",
                "evidence_family": verdict["family"],
                "evidence": json.dumps(verdict["statements"], sort_keys=True),
                "confidence": confidence_of(verdict),
            })  # fmt: skip
    if too_short:
        logger.warning("Predictions shorter than their recordings were not judged: %s", dict(too_short))
    judgeable = [row for row in rows if row.split in config.splits and row.outcome in outcomes]
    judged = {row["episode_id"] for row in decisions if row["method"] != TRUE_METHOD}
    counts: dict[str, Any] = {
        "found": len(rows),
        "kept": len(judged),
        "left_out": {
            "in other splits": sum(row.split not in config.splits for row in rows),
            "without a recorded success or failure": sum(
                row.split in config.splits and row.outcome not in outcomes for row in rows
            ),
            "not drawn (evaluate_policy.balanced, max_per_group)": len(judgeable) - len(chosen),
            "predicted shorter than recorded": len(chosen) - len(judged),
        },
    }
    if not decisions:
        left_out = ", ".join(f"{count} {reason}" for reason, count in counts["left_out"].items() if count)
        raise DataError(
            "No video can be judged",
            where=inputs["episodes"],
            expected=f"predictions of recordings of the splits {', '.join(config.splits)} that ended in success or failure",
            got=f"{len(rows)} predicted episodes: {left_out}",
            next_step="predict recordings with known outcomes, name a saved calibration (evaluate_policy.trust.calibration), or "
            "leave the judgement out: evaluate_policy: null",
        )
    facts: dict[str, Any] = {"shorter_than_recording": dict(too_short)}
    resampling = {"resamples": config.resamples, "seed": config.seed}
    attempts = {row.episode_id: {"policy": row.source, "start": row.bank or row.episode_id} for row in chosen}
    labelled = [
        {"task": _verb(decision["instruction"]), **attempts[decision["episode_id"]], **decision}
        for decision in decisions
    ]
    with_outcome = [row for row in labelled if row["outcome"] in _OUTCOMES]
    if config.compare_policies and with_outcome:
        facts["policies"] = policy_agreement(with_outcome, **resampling)
    if config.trust is not None and known is not None:
        news = {name: known.novelties(name) for name in {row["episode_id"] for row in labelled}}
        of_predictions = [{**row, **news[row["episode_id"]]} for row in labelled if row["method"] != TRUE_METHOD]
        made = {method: predicted_by(rollout.root) for method, rollout in rollouts.items()}
        before = None if saved is None else {method: saved.calibration_of(by) for method, by in made.items()}
        trusted, methods = trust_verdicts(
            of_predictions, config.trust, policies=config.compare_policies, saved=before, **resampling
        )
        facts["trust"] = {
            "settings": config.trust.model_dump(mode="json"), "training_recordings": known.count, "methods": methods,
        }  # fmt: skip
        columns = dict.fromkeys(TRUST_COLUMNS)
        decisions = [{**columns, **row} for row in labelled if row["method"] == TRUE_METHOD] + trusted
        if saved is None:
            calibrations = {
                method: SavedMethod(predicted_by=by, signals=found.signals, weights=tuple(found.weights))
                for method, by in made.items()
                if by is not None and methods.get(method, {}).get("available")
                for found in (calibrated([row for row in trusted if row["method"] == method]),)
            }
            robots = tuple(sorted({row.embodiment for row in chosen}))
            SavedTrust(
                format=1, judged_by=judged_by, embodiments=robots, least_trust=config.trust.least_trust,
                training_recordings=known.count, methods=calibrations, controls=known.controls, setups=known.setups,
            ).write(output)  # fmt: skip
    return counts | _write(config, decisions, facts, judge.name, output)


def chosen_outcomes(config: PolicyEvaluationConfig) -> tuple[str, ...]:
    """Recordings with which outcomes are judged: with a calibration that was made before, also those whose outcome is unknown."""
    saved = config.trust is not None and config.trust.calibration is not None
    return (*_OUTCOMES, "unknown") if saved else _OUTCOMES


def _verb(instruction: str) -> str:
    return instruction.split(maxsplit=1)[0].lower() if instruction.strip() else "none"


def choose_trajectories(
    config: PolicyEvaluationConfig, rows: Sequence[EpisodeRow], times: Mapping[str, int]
) -> list[EpisodeRow]:
    """As many successes as failures in every split and task family (unknown outcomes, where they are judged: all), drawn with
    the seed; sorted by episode.

    Args:
        times: by episode, how many methods predicted it; those that more have predicted are taken first.
    """
    outcomes = chosen_outcomes(config)
    groups: dict[tuple[str, str], dict[str, list[EpisodeRow]]] = defaultdict(lambda: {name: [] for name in outcomes})
    for row in rows:
        if row.split in config.splits and row.outcome in outcomes:
            groups[row.split, row.task_family][row.outcome].append(row)
    chosen: list[EpisodeRow] = []
    generator = np.random.default_rng(config.seed)
    for _, group in sorted(groups.items()):
        fewest = min(len(group[outcome]) for outcome in _OUTCOMES)
        for outcome in outcomes:
            members = sorted(group[outcome], key=lambda row: row.episode_id)
            limit = fewest if config.balanced and outcome in _OUTCOMES else len(members)
            limit = limit if config.max_per_group is None else min(limit, config.max_per_group)
            drawn = generator.permutation(len(members))
            picked = sorted(drawn, key=lambda index: -times[members[index].episode_id])[:limit]
            chosen += [members[index] for index in sorted(picked)]
    return sorted(chosen, key=lambda row: row.episode_id)


def open_judge(config: PolicyEvaluationConfig, segmenter: Path | None) -> Judge:
    """The judge that the config names."""
    if config.judge == "measured":
        opened = open_segmenter(config.segmenter, learned=segmenter, sam3=config.sam3_weights)
        return MeasuredEvidenceJudge(opened, states_confidence=config.trust is not None)
    return VLMJudge(open_vlm(config.judge, config.vlm))


def _write(
    config: PolicyEvaluationConfig, rows: list[dict[str, Any]], facts: dict[str, Any], judge: str, output: Path
) -> dict[str, Any]:
    rows = sorted(rows, key=lambda row: (row["method"], row["episode_id"], row["seed"]))
    write_table(output / DECISIONS_FILE, rows, _COLUMNS if config.trust is None else (*_COLUMNS, *TRUST_COLUMNS))
    write_scores(
        output,
        [
            Score(
                row["method"], row["episode_id"], row["embodiment"], row["split"], "", row["seed"], "correct",
                float(row["predicted"] == row["outcome"]), row["scene"], row["task_family"], row["outcome"],
            )
            for row in rows
            if row["outcome"] in _OUTCOMES
        ],
    )  # fmt: skip
    summary = summarise_decisions(rows, resamples=config.resamples, seed=config.seed)
    summary |= {"judge": judge, "interval": "95 % bootstrap over trajectories", **facts}
    write_json_atomic(output / SUMMARY_FILE, summary)
    overall = {
        method: values[_ALL]["accuracy"]["mean"]
        for method, values in summary["methods"].items()
        if "accuracy" in values[_ALL]
    }
    return {"trajectories": summary["trajectories"], "judge": judge, "accuracy": overall}


def summarise_decisions(rows: Sequence[Mapping[str, Any]], *, resamples: int, seed: int) -> dict[str, Any]:
    """Accuracy of every method and group, and differences between methods. Where outcomes are unknown, only what was judged.

    Args:
        rows: verdicts with method, episode_id, seed, split, task_family, outcome, predicted, answers, malformed_answers.

    Returns:
        {"trajectories", "methods": {method: {group: {"accuracy": interval, "seeds": {...}, "confusion": {...}}}},
         "differences": [...]}, where outcomes are unknown with "predicted_success" (an interval) too; groups are "all", each split, each family, and split/family.
    """
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = defaultdict(list)
    for row in rows:
        names = (_ALL, row["split"], row["task_family"], f"{row['split']}/{row['task_family']}")
        for name in dict.fromkeys(names):
            groups[row["method"], name].append(row)
    methods: dict[str, dict[str, Any]] = defaultdict(dict)
    for (method, group), judged in sorted(groups.items()):
        members = [row for row in judged if row["outcome"] in _OUTCOMES]
        found: dict[str, Any] = {}
        if members:
            confusion = {"true_success": 0, "false_success": 0, "true_failure": 0, "false_failure": 0}
            for row in members:
                right = "true" if row["predicted"] == row["outcome"] else "false"
                confusion[f"{right}_{row['predicted']}"] += 1
            accuracy = bootstrap_mean(list(_accuracy(members, "episode_id").values()), resamples=resamples, seed=seed)
            seeds = {str(name): value for name, value in _accuracy(members, "seed").items()}
            found = {"accuracy": asdict(accuracy), "seeds": seeds, "confusion": confusion}
        if unknown := [{**row, "outcome": "success"} for row in judged if row["outcome"] not in _OUTCOMES]:
            shares = list(_accuracy(unknown, "episode_id").values())
            found["predicted_success"] = asdict(bootstrap_mean(shares, resamples=resamples, seed=seed))
        found |= {name: sum(row[name] for row in judged) for name in ("malformed_answers", "answers")}
        methods[method][group] = found
    known = {method: [row for row in groups[method, _ALL] if row["outcome"] in _OUTCOMES] for method in methods}
    by_method = {method: _accuracy(rows, "episode_id") for method, rows in known.items()}
    return {
        "trajectories": len({row["episode_id"] for row in rows}),
        "methods": dict(methods),
        "differences": method_differences(by_method, "accuracy", resamples=resamples, seed=seed),
    }


def _accuracy(rows: Sequence[Mapping[str, Any]], key: str) -> dict[Any, float]:
    """Share of right verdicts by trajectory or seed."""
    values: dict[Any, list[float]] = defaultdict(list)
    for row in rows:
        values[row[key]].append(float(row["predicted"] == row["outcome"]))
    return {name: sum(items) / len(items) for name, items in sorted(values.items())}
