"""The step evaluate_planning: is the candidate chosen by its predicted video better than one taken blindly?

Every method's videos of the same banks go through the same brackets. Labels stay sealed until all choices of all methods are on disk.
The recorded videos are chosen from too (method ``true``): that is the selector's own ceiling. Beside the methods are shortcuts,
which see no video (`shortcuts`): what a model gains counts over the best of them.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ArtifactError, DataError
from worldline_core.evaluation.evaluation_config import PlanningConfig
from worldline_core.evaluation.planning.bracket import (
    CandidateVideo,
    Choice,
    ScoringSelector,
    Selector,
    VLMSelector,
    choose,
    learned_selector,
    measured_selector,
    shown_order,
    shown_video,
)
from worldline_core.evaluation.policy.learned_judge import open_learned_judge
from worldline_core.evaluation.recordings import open_rollouts, open_tracks, trajectory_of
from worldline_core.evaluation.scores import (
    SUMMARY_FILE,
    TRUE_METHOD,
    Score,
    area_under_curve,
    bootstrap_mean,
    kept_part,
    part_file,
    write_scores,
    write_table,
)
from worldline_core.evaluation.segmenters.segmenter import open_segmenter
from worldline_core.evaluation.shortcuts import (
    FEATURES,
    RULES,
    BankFacts,
    bank_facts,
    medoid,
    tree_scores,
)
from worldline_core.evaluation.vlm import open_vlm
from worldline_core.progress import with_progress
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.store.atomic import write_json_atomic

CHOICES_FILE = "choices.parquet"
CANDIDATE_SCORES_FILE = "candidate_scores.parquet"
SEALED_FILE = "sealed_outcomes.parquet"
DIRECT = "direct_execution"
SHORTCUT = "shortcut_"
"""Prefix of the shortcuts' names in the tables."""
_CHOICE_COLUMNS = ("method", "bank", "run", "budget", "episode_id", "trace")


def evaluate_planning(config: PlanningConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Choose in every bank, for every method and budget; then open the labels.

    Inputs: banks, rollouts.<method>; tracks, segmenter and judge where the selector uses them.
    Output: choices.parquet, candidate_scores.parquet (where the selector scores videos one by one), scores.parquet (metrics
    ``success@N`` and ``area``), summary.json. Shortcuts are methods ``shortcut_<name>``.
    """
    episodes = EpisodeSet.open(inputs["banks"])
    rollouts = open_rollouts(inputs)
    tracks = open_tracks(inputs)
    banks = list_banks(episodes.rows)
    selector = open_selector(config, inputs)

    def choose_in_bank(method: str, bank: str) -> dict[str, Any]:
        load = candidate_loader(config.views, episodes, tracks, rollouts.get(method), method, banks[bank])
        task = banks[bank][0].instruction

        def by_video(scene: str, shown: Sequence[int]) -> Choice:
            return choose(selector, task, shown, load, scene=scene, seed=config.seed)

        chosen = choices_of_bank(config, bank, banks[bank], by_video)
        shown = max((choice["budget"] for choice in chosen), default=0)
        scoring = isinstance(selector, ScoringSelector)
        scores = [selector.score(task, load(number))[0] for number in range(shown)] if scoring else []
        return {"choices": chosen, "scores": scores}

    choices: list[dict[str, Any]] = []
    candidate_scores: dict[str, dict[str, Sequence[float]]] = defaultdict(dict)
    for method in (TRUE_METHOD, *rollouts):
        for bank in with_progress(banks, f"evaluate_planning {method}", "bank"):
            part = part_file(output / "run" / "parts", method, bank)
            found = kept_part(part, partial(choose_in_bank, method, bank))
            choices += [{"method": method, "bank": bank, **choice} for choice in found["choices"]]
            if found["scores"]:
                candidate_scores[method][bank] = found["scores"]
    found, kept = len(banks), len({choice["bank"] for choice in choices})
    if not kept:
        raise DataError(
            "No bank has enough candidates to choose among", where=inputs["banks"],
            expected=f"at least {min(config.budgets)}, the smallest of evaluate_planning.budgets",
            got=f"{found} banks of up to {max(map(len, banks.values()), default=0)}",
        )  # fmt: skip
    in_progress = with_progress(banks, "evaluate_planning shortcuts", "bank")
    facts = {bank: bank_facts(episodes, tracks, banks[bank]) for bank in in_progress}
    rules = {bank: rule_scores(own) for bank, own in facts.items()}
    for bank, rows in banks.items():
        choices += shortcut_choices(config, bank, rows, rule_choosers(facts[bank], rules[bank]))
    table = [choice | {"trace": json.dumps(choice["trace"], sort_keys=True)} for choice in choices]
    write_table(output / CHOICES_FILE, table, _CHOICE_COLUMNS)
    scored_candidates = [
        {"method": method, "bank": bank, "episode_id": row.episode_id, "value": score}
        for method, own in candidate_scores.items()
        for bank, scores in own.items()
        for row, score in zip(banks[bank], scores, strict=False)
    ]
    if scored_candidates:
        write_table(output / CANDIDATE_SCORES_FILE, scored_candidates, ("method", "bank", "episode_id", "value"))
    # Only now: nothing above has read, or could read, how any candidate ended.
    outcomes = read_outcomes(
        inputs.get("sealed", inputs["banks"]) / SEALED_FILE, [row.episode_id for rows in banks.values() for row in rows]
    )
    scored = tree_scores_by_shortcut(
        facts, {bank: [outcomes[row.episode_id] for row in rows] for bank, rows in banks.items()}
    )
    for bank, rows in banks.items():
        choosers = {name: best_of(scores.get(bank)) for name, scores in scored.items() if scores}
        choices += shortcut_choices(config, bank, rows, choosers)
    for name, scores in ({name: {bank: own[name] for bank, own in rules.items()} for name in RULES} | scored).items():
        candidate_scores[f"{SHORTCUT}{name}"] = {bank: [*own] for bank, own in scores.items() if own is not None}
    left_out = {"with fewer candidates than the smallest budget": found - kept}
    counts = write_results(config, selector.name, banks, choices, candidate_scores, outcomes, output)
    return {"found": found, "kept": kept, "left_out": left_out, **counts}


def list_banks(rows: list[EpisodeRow]) -> dict[str, list[EpisodeRow]]:
    """Candidates of each bank in their order.

    Raises: DataError when rows are no candidates, or a bank has two with one number or two instructions.
    """
    banks: dict[str, list[EpisodeRow]] = defaultdict(list)
    for row in rows:
        if row.bank is None or row.candidate is None:
            raise DataError(
                "An episode of the banks is no candidate",
                where=row.episode_id,
                expected="bank and candidate in the index",
                next_step="give candidate banks, not ordinary recordings",
            )
        banks[row.bank].append(row)
    ordered = {bank: sorted(members, key=lambda row: row.candidate or 0) for bank, members in sorted(banks.items())}
    for bank, members in ordered.items():
        if len({row.candidate for row in members}) != len(members) or len({row.instruction for row in members}) != 1:
            raise DataError("A bank's candidates need distinct numbers and one instruction", where=bank)
    return ordered


def open_selector(config: PlanningConfig, inputs: Mapping[str, Path]) -> Selector:
    """The selector of a config, from the inputs ``segmenter`` or ``judge``."""
    if config.selector == "learned":
        return learned_selector(open_learned_judge(inputs.get("judge")))
    if config.selector == "measured":
        opened = open_segmenter(config.segmenter, learned=inputs.get("segmenter"), sam3=config.sam3_weights)
        return measured_selector(opened)
    return VLMSelector(open_vlm(config.selector, config.vlm))


def choices_of_bank(
    config: PlanningConfig, bank: str, rows: Sequence[EpisodeRow], choice: Callable[[str, Sequence[int]], Choice]
) -> list[dict[str, Any]]:
    """One choice per run and budget, given the scene's name and the candidates shown; budgets larger than the bank are left out.

    The paper samples a new bank for every run. Here a run is another order of the same bank (the first one is the
    recorded order), which changes what the smaller budgets contain.
    """
    results = []
    numbers = range(len(rows))
    for run in range(config.runs):
        order = [*numbers] if run == 0 else shown_order(numbers, f"{bank} run {run}", config.seed)
        for budget in sorted({budget for budget in config.budgets if budget <= len(rows)}):
            chosen = choice(f"{bank} {run} {budget}", order[:budget])
            episode_id = rows[chosen.candidate].episode_id
            results.append({"run": run, "budget": budget, "episode_id": episode_id, "trace": asdict(chosen)})
    return results


Chooser = Callable[[Sequence[int]], int]
"""Chooses one of the candidates shown, by their numbers."""


def best_of(scores: np.ndarray | None) -> Chooser:
    """The highest score; of equals, or without scores in this bank, the one shown first."""
    return lambda shown: shown[0] if scores is None else shown[int(np.argmax(scores[list(shown)]))]


def rule_scores(facts: BankFacts) -> dict[str, np.ndarray | None]:
    """Scores of a bank's candidates by the rules; None where a rule does not see what it needs."""
    return {name: rule(facts) for name, rule in RULES.items()}


def rule_choosers(facts: BankFacts, scores: Mapping[str, np.ndarray | None]) -> dict[str, Chooser]:
    """Shortcuts without labels, with their `rule_scores`."""
    return {"medoid": medoid(facts)} | {name: best_of(own) for name, own in scores.items()}


def tree_scores_by_shortcut(
    facts: Mapping[str, BankFacts], ends: Mapping[str, Sequence[bool]]
) -> dict[str, dict[str, np.ndarray]]:
    """Scores of the candidates of each bank by trees that learned from other banks, by the shortcut's name."""
    known = {bank: np.array(own, dtype=bool) for bank, own in ends.items()}
    features = {name: {bank: make(own) for bank, own in facts.items()} for name, make in FEATURES.items()}
    return {
        name: tree_scores({bank: own for bank, own in by_bank.items() if own is not None}, known)
        for name, by_bank in features.items()
    }


def shortcut_choices(
    config: PlanningConfig, bank: str, rows: Sequence[EpisodeRow], choosers: Mapping[str, Chooser]
) -> list[dict[str, Any]]:
    """Choices of rules that see no video."""
    return [
        {"method": f"{SHORTCUT}{name}", "bank": bank, **choice}
        for name, chooser in choosers.items()
        for choice in choices_of_bank(config, bank, rows, partial(_without_video, chooser))
    ]


def _without_video(chooser: Chooser, _scene: str, shown: Sequence[int]) -> Choice:
    return Choice(chooser(shown), {}, [], 0, 0)


def candidate_loader(
    views: Sequence[str],
    episodes: EpisodeSet,
    tracks: ActionTracks | None,
    rollout: RolloutSet | None,
    method: str,
    rows: Sequence[EpisodeRow],
) -> Callable[[int], CandidateVideo]:
    """Loads a candidate's video by its number in the bank, recorded or predicted by a method; each is decoded once.

    Raises: ArtifactError when the method has not predicted every candidate.
    """
    predicted = {row.episode_id for row in rows} if rollout is None else set(rollout.episode_ids)
    missing = [row.episode_id for row in rows if row.episode_id not in predicted]
    if missing:
        raise ArtifactError(
            "A method has not predicted every candidate of a bank",
            where=f"method {method}, bank {rows[0].bank}",
            got=f"{len(missing)} missing, for example {missing[0]}",
            next_step="roll out all candidates with this method",
        )

    @cache
    def load(candidate: int) -> CandidateVideo:
        row = rows[candidate]
        seed = 0 if rollout is None else rollout.seeds(row.episode_id)[0]
        return shown_video(trajectory_of(episodes, row, views, rollout=rollout, seed=seed, tracks=tracks))

    return load


def read_outcomes(path: Path, episode_ids: Sequence[str]) -> dict[str, bool]:
    """Success of each candidate by the sealed labels.

    Raises:
        ArtifactError: without the file.
        DataError: when a candidate has no label, or one that is neither success nor failure.
    """
    if not path.is_file():
        raise ArtifactError(
            "The banks have no sealed outcomes", where=path, next_step="record the banks again, or restore the file"
        )
    table = {row["episode_id"]: row["outcome"] for row in pq.read_table(path).to_pylist()}
    unusable = [name for name in episode_ids if table.get(name) not in ("success", "failure")]
    if unusable:
        raise DataError(
            "Candidates without a sealed outcome",
            where=path,
            expected="success or failure for every candidate",
            got=f"{len(unusable)} without, for example {unusable[0]}: {table.get(unusable[0])!r}",
        )
    return {name: table[name] == "success" for name in episode_ids}


def areas_within_banks(
    scores: Mapping[str, Sequence[float]], ends: Mapping[str, Sequence[bool]], shown: Mapping[str, int]
) -> dict[str, float]:
    """The `area_under_curve` of the first ``shown`` candidates of each bank in which both outcomes occur."""
    areas = {
        bank: area_under_curve(own[: shown[bank]], ends[bank][: shown[bank]])
        for bank, own in sorted(scores.items())
        if bank in shown
    }
    return {bank: area for bank, area in areas.items() if not np.isnan(area)}


def write_results(
    config: PlanningConfig,
    selector: str,
    banks: Mapping[str, Sequence[EpisodeRow]],
    choices: Sequence[Mapping[str, Any]],
    candidate_scores: Mapping[str, Mapping[str, Sequence[float]]],
    outcomes: Mapping[str, bool],
    output: Path,
) -> dict[str, Any]:
    """Write scores.parquet and summary.json: success against the number of candidates, and the gain over direct execution.

    Direct execution of a policy takes one candidate blindly: its expected success in a bank is the mean over the bank's candidates, the
    same reference for every budget. ``over_shortcut`` of a method is its gain over the shortcut that succeeds most often at this budget,
    bank by bank. ``areas`` are means over banks of the `area_under_curve` of the candidates that the largest budget shows, in recorded order.
    """
    ends = {bank: [outcomes[row.episode_id] for row in rows] for bank, rows in banks.items()}
    direct = {bank: float(np.mean(own)) for bank, own in ends.items()}
    scores: list[Score] = []
    success: dict[str, dict[int, dict[str, list[float]]]] = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    malformed: dict[str, int] = defaultdict(int)
    for choice in choices:
        method, bank, budget = choice["method"], choice["bank"], choice["budget"]
        value = float(outcomes[choice["episode_id"]])
        success[method][budget][bank].append(value)
        malformed[method] += choice["trace"]["malformed_answers"]
        row, metric = banks[bank][0], f"success@{budget}"
        about = row.embodiment, row.split, "", choice["run"], metric, value, row.scene, row.task_family
        scores.append(Score(method, bank, *about))
    means = {
        name: {
            n: {bank: float(np.mean(runs)) for bank, runs in sorted(own.items())}
            for n, own in sorted(by_budget.items())
        }
        for name, by_budget in sorted(success.items())
    }
    rules = {name.removeprefix(SHORTCUT): own for name, own in means.items() if name.startswith(SHORTCUT)}

    def interval(values: Iterable[float]) -> dict[str, Any]:
        return asdict(bootstrap_mean(list(values), resamples=config.resamples, seed=config.seed))

    def result(budget: int, own: Mapping[str, float]) -> dict[str, Any]:
        best = max(rules, key=lambda name: np.mean([rules[name][budget][bank] for bank in own]))
        over = interval(value - rules[best][budget][bank] for bank, value in own.items())
        gain = interval(value - direct[bank] for bank, value in own.items())
        return {
            "success": interval(own.values()),
            "gain": gain,
            "banks": own,
            "over_shortcut": {"shortcut": best, "gain": over},
        }

    def by_family(by_budget: Mapping[int, Mapping[str, float]]) -> dict[str, dict[str, Any]]:
        """Results of each task family and budget."""
        found: dict[str, dict[int, dict[str, float]]] = defaultdict(lambda: defaultdict(dict))
        for budget, own in by_budget.items():
            for bank, value in own.items():
                found[banks[bank][0].task_family][budget][bank] = value
        return {family: {str(n): result(n, own) for n, own in by_budget.items()} for family, by_budget in found.items()}

    shown = {choice["bank"]: choice["budget"] for choice in sorted(choices, key=lambda choice: choice["budget"])}
    areas: dict[str, dict[str, Any]] = {"methods": {}, "shortcuts": {}}
    for name, scored in sorted(candidate_scores.items()):
        groups: dict[str, list[float]] = defaultdict(list)
        for bank, area in areas_within_banks(scored, ends, shown).items():
            row = banks[bank][0]
            about = row.embodiment, row.split, "", 0, "area", area, row.scene, row.task_family
            scores.append(Score(name, bank, *about))
            groups["all"].append(area)
            groups[row.task_family].append(area)
        kind = "shortcuts" if name.startswith(SHORTCUT) else "methods"
        areas[kind][name.removeprefix(SHORTCUT)] = {group: interval(own) for group, own in groups.items()}
    write_scores(output, scores)

    methods = {
        name: {
            "budgets": {str(n): result(n, own) for n, own in by_budget.items()},
            "by_family": by_family(by_budget),
            "malformed_answers": malformed[name],
        }
        for name, by_budget in means.items()
        if not name.startswith(SHORTCUT)
    }
    summary = {
        "selector": selector,
        "banks": {
            bank: {"task_family": rows[0].task_family, "candidates": len(rows), "direct_success": direct[bank]}
            for bank, rows in banks.items()
        },
        DIRECT: interval(direct.values()),
        "oracle": interval(float(any(own)) for own in ends.values()),
        "methods": methods,
        "shortcuts": {
            name: {str(n): interval(own.values()) for n, own in by_budget.items()} for name, by_budget in rules.items()
        },
        "areas": areas,
        "interval": "95 % bootstrap over banks",
    }
    write_json_atomic(output / SUMMARY_FILE, summary)
    largest = {
        name: found["budgets"][max(found["budgets"], key=int)]["success"]["mean"] for name, found in methods.items()
    }
    return {"banks": len(banks), DIRECT: summary[DIRECT]["mean"], "success_at_largest_budget": largest}
