"""The step evaluate_policy: does a judge who sees only predicted videos agree with what really happened?

Judged are the same trajectories for every method, as many successes as failures in every split and task family. The
recorded videos are judged too (method ``true``): that accuracy is the judge's own ceiling. Accuracy is pooled per seed
and averaged over seeds, by split and task family, with intervals.
"""

from __future__ import annotations

import json
import logging
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
from pydantic import Field
from tqdm import tqdm

from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode import VIEWS, Episode
from worldline_core.evaluation.policy.judge import Judge, Judgement, Trajectory, judge_trajectory
from worldline_core.evaluation.policy.measured_judge import MeasuredEvidenceJudge
from worldline_core.evaluation.policy.vlm_judge import VLMJudge
from worldline_core.evaluation.recordings import TRUE_METHOD, Recordings, open_rollouts, open_tracks
from worldline_core.evaluation.scores import (
    SUMMARY_FILE,
    Score,
    bootstrap_mean,
    paired_difference,
    write_scores,
    write_table,
)
from worldline_core.evaluation.segmenters.segmenter import SegmenterName, open_segmenter
from worldline_core.evaluation.vlm.vlm_config import VLMConfig, open_vlm
from worldline_core.store.atomic import write_json_atomic

logger = logging.getLogger(__name__)

DECISIONS_FILE = "decisions.parquet"
_OUTCOMES = ("success", "failure")
_ALL = "all"
_COLUMNS = (
    "method", "episode_id", "embodiment", "split", "scene", "task_family", "seed", "instruction", "outcome",
    "predicted", "evidence_family", "decided_by", "answers", "malformed_answers", "evidence",
)  # fmt: skip
_INTEGERS = {"seed", "answers", "malformed_answers"}


class PolicyEvaluationConfig(StrictModel):
    """Who judges, and what."""

    judge: Literal["measured", "qwen3_vl", "openai"] = "measured"
    vlm: VLMConfig = VLMConfig()
    segmenter: SegmenterName = Field(default="learned", description="used by the measured judge")
    sam3_weights: Path | None = None
    views: tuple[Literal["head", "left_wrist", "right_wrist"], ...] = VIEWS
    splits: tuple[str, ...] = ("test", "ood_test")
    balanced: bool = True
    max_per_group: int | None = Field(default=None, ge=1, description="of each outcome, in each split and family")
    resamples: int = Field(default=2000, ge=100)
    seed: int = Field(default=42, ge=0)


def evaluate_policy(config: PolicyEvaluationConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Judge every method's videos and compare with the recorded outcomes.

    Inputs: episodes, rollouts.<method>; tracks and segmenter where the judge uses them.
    Output: scores.parquet (metric ``correct``), decisions.parquet (every verdict with its evidence), summary.json.
    """
    recordings = Recordings.open(inputs["episodes"])
    rollouts = open_rollouts(inputs)
    tracks = open_tracks(inputs.get("tracks"))
    judge = open_judge(config, inputs.get("segmenter"))
    common = set.intersection(*(set(rollout.episode_ids) for rollout in rollouts.values()))
    chosen = choose_trajectories(config, [recordings.episode(name) for name in sorted(common)])

    rows: list[dict[str, Any]] = []
    too_short: Counter[str] = Counter()
    for episode in tqdm(chosen, desc="evaluate_policy", unit="trajectory", disable=None):
        name = episode.episode_id
        videos = [(TRUE_METHOD, 0)]
        videos += [(method, seed) for method, rollout in rollouts.items() for seed in rollout.seeds(name)]
        for method, seed in videos:
            part = output / "run" / "parts" / method / f"{name}.{seed}.json"
            if not part.exists():
                video = recordings.seen_video(
                    name, config.views, rollout=rollouts.get(method), seed=seed, tracks=tracks
                )
                trajectory = Trajectory(episode.instruction, video.frames, episode.fps, video.points)
                write_json_atomic(part, _verdict(judge_trajectory(judge, trajectory), video.num_frames))
            verdict = json.loads(part.read_text())
            if verdict["num_frames"] < episode.num_video_frames:
                too_short[method] += 1  # the outcome may lie after the end of this video
                continue
            rows.append(_row(method, seed, episode, verdict))
    if too_short:
        logger.warning("Predictions shorter than their recordings were not judged: %s", dict(too_short))
    return _write(config, rows, dict(too_short), judge.name, output)


def choose_trajectories(config: PolicyEvaluationConfig, episodes: Sequence[Episode]) -> list[Episode]:
    """As many successes as failures in every split and task family, drawn with the seed; sorted by episode."""
    groups: dict[tuple[str, str], dict[str, list[Episode]]] = defaultdict(lambda: {name: [] for name in _OUTCOMES})
    for episode in episodes:
        if episode.split in config.splits and episode.outcome in _OUTCOMES:
            groups[episode.split, episode.task_family][episode.outcome].append(episode)
    chosen: list[Episode] = []
    generator = np.random.default_rng(config.seed)
    for key in sorted(groups):
        group = groups[key]
        fewest = min(len(members) for members in group.values())
        for outcome in _OUTCOMES:
            members = sorted(group[outcome], key=lambda episode: episode.episode_id)
            limit = fewest if config.balanced else len(members)
            limit = limit if config.max_per_group is None else min(limit, config.max_per_group)
            picked = generator.permutation(len(members))[:limit]
            chosen += [members[index] for index in sorted(picked)]
    return sorted(chosen, key=lambda episode: episode.episode_id)


def open_judge(config: PolicyEvaluationConfig, segmenter: Path | None) -> Judge:
    """The judge that the config names."""
    if config.judge == "measured":
        return MeasuredEvidenceJudge(open_segmenter(config.segmenter, learned=segmenter, sam3=config.sam3_weights))
    return VLMJudge(open_vlm(config.judge, config.vlm))


def _verdict(judgement: Judgement, num_frames: int) -> dict[str, Any]:
    return {
        "num_frames": num_frames,
        "success": judgement.success,
        "family": judgement.family,
        "decided_by": judgement.decided_by,
        "answers": judgement.answers,
        "malformed_answers": judgement.malformed_answers,
        "statements": [{"pass": name, **facts} for name, facts in judgement.statements],
    }


def _row(method: str, seed: int, episode: Episode, verdict: dict[str, Any]) -> dict[str, Any]:
    return {
        "method": method,
        "episode_id": episode.episode_id,
        "embodiment": episode.embodiment,
        "split": episode.split,
        "scene": episode.scene,
        "task_family": episode.task_family,
        "seed": seed,
        "instruction": episode.instruction,
        "outcome": episode.outcome,
        "predicted": "success" if verdict["success"] else "failure",
        "evidence_family": verdict["family"],
        "decided_by": verdict["decided_by"],
        "answers": verdict["answers"],
        "malformed_answers": verdict["malformed_answers"],
        "evidence": json.dumps(verdict["statements"], sort_keys=True),
    }


def _write(
    config: PolicyEvaluationConfig, rows: list[dict[str, Any]], too_short: dict[str, int], judge: str, output: Path
) -> dict[str, Any]:
    schema = pa.schema([(name, pa.int32() if name in _INTEGERS else pa.string()) for name in _COLUMNS])
    rows = sorted(rows, key=lambda row: (row["method"], row["episode_id"], row["seed"]))
    write_table(output / DECISIONS_FILE, rows, schema)
    write_scores(
        output,
        [
            Score(
                row["method"], row["episode_id"], row["embodiment"], row["split"], "", row["seed"], "correct",
                float(row["predicted"] == row["outcome"]), row["scene"], row["task_family"], row["outcome"],
            )
            for row in rows
        ],
    )  # fmt: skip
    summary = summarise_decisions(rows, resamples=config.resamples, seed=config.seed)
    summary |= {"judge": judge, "shorter_than_recording": too_short, "interval": "95 % bootstrap over trajectories"}
    write_json_atomic(output / SUMMARY_FILE, summary)
    overall = {method: values["all"]["accuracy"]["mean"] for method, values in summary["methods"].items()}
    return {"trajectories": summary["trajectories"], "judge": judge, "accuracy": overall}


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
        names = (_ALL, row["split"], row["task_family"], f"{row['split']}/{row['task_family']}")
        for name in dict.fromkeys(names):
            groups[row["method"], name].append(row)
    methods: dict[str, dict[str, Any]] = defaultdict(dict)
    by_trajectory: dict[str, dict[str, float]] = {}
    for (method, group), members in sorted(groups.items()):
        per_trajectory, per_seed = _means(members, "episode_id"), _means(members, "seed")
        if group == _ALL:
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
