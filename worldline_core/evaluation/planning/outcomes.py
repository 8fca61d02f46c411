"""After the choices: opening the sealed labels, success against the number of candidates, gain over direct execution."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow.parquet as pq

from worldline_core.errors import ArtifactError, DataError
from worldline_core.evaluation.scores import SUMMARY_FILE, Score, write_scores
from worldline_core.evaluation.statistics import Interval, bootstrap_mean
from worldline_core.store.atomic import write_json_atomic

if TYPE_CHECKING:
    from worldline_core.data.episodes.episode_set import EpisodeRow
    from worldline_core.evaluation.planning.evaluate_planning import PlanningConfig

DIRECT = "direct_execution"


def read_outcomes(path: Path, episode_ids: Sequence[str]) -> dict[str, bool]:
    """Whether each candidate succeeded.

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


def write_results(
    config: PlanningConfig,
    selector: str,
    banks: Mapping[str, Sequence[EpisodeRow]],
    choices: Sequence[Mapping[str, Any]],
    outcomes: Mapping[str, bool],
    output: Path,
) -> dict[str, Any]:
    """Write scores.parquet and summary.json.

    Direct execution of a policy takes one candidate blindly: its expected success in a bank is the mean over the
    bank's candidates, the same reference for every budget.
    """
    direct = {bank: float(np.mean([outcomes[row.episode_id] for row in rows])) for bank, rows in banks.items()}
    oracle = {bank: float(any(outcomes[row.episode_id] for row in rows)) for bank, rows in banks.items()}
    scores: list[Score] = []
    success: dict[str, dict[int, dict[str, list[float]]]] = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    malformed: dict[str, int] = defaultdict(int)
    for choice in choices:
        method, bank, budget = choice["method"], choice["bank"], choice["budget"]
        value = float(outcomes[choice["episode_id"]])
        success[method][budget][bank].append(value)
        malformed[method] += choice["trace"]["malformed_answers"]
        scores.append(_score(method, banks[bank][0], choice["run"], f"success@{budget}", value))
    scores += [_score(DIRECT, banks[bank][0], 0, "success", value) for bank, value in direct.items()]
    write_scores(output, scores)

    def interval(values: Sequence[float]) -> Interval:
        return bootstrap_mean(values, resamples=config.resamples, seed=config.seed)

    def deviation(values: Sequence[float]) -> float:
        return float(np.std(values, ddof=1)) if len(values) > 1 else 0.0

    def statistics(by_bank: Mapping[str, Sequence[float]]) -> dict[str, Any]:
        means = {bank: float(np.mean(by_bank[bank])) for bank in sorted(by_bank)}
        over_runs = deviation([float(np.mean(run)) for run in zip(*by_bank.values(), strict=True)])
        spread = {"std_over_banks": deviation(list(means.values())), "std_over_runs": over_runs}
        return {
            "success": {**interval(list(means.values())).as_json(), **spread},
            "gain": interval([means[bank] - direct[bank] for bank in means]).as_json(),
            "banks": means,
        }

    methods = {
        method: {
            "budgets": {str(budget): statistics(values) for budget, values in sorted(by_budget.items())},
            "by_family": _by_family(by_budget, banks, direct),
            "malformed_answers": malformed[method],
        }
        for method, by_budget in sorted(success.items())
    }
    summary = {
        "selector": selector,
        "banks": {
            bank: {
                "scene": rows[0].scene,
                "embodiment": rows[0].embodiment,
                "task_family": rows[0].task_family,
                "instruction": rows[0].instruction,
                "candidates": len(rows),
                "direct_success": direct[bank],
                "any_success": bool(oracle[bank]),
            }
            for bank, rows in banks.items()
        },
        DIRECT: interval(list(direct.values())).as_json(),
        "oracle": interval(list(oracle.values())).as_json(),
        "methods": methods,
        "interval": "95 % bootstrap over banks",
    }
    write_json_atomic(output / SUMMARY_FILE, summary)
    largest = {
        method: values["budgets"][max(values["budgets"], key=int)]["success"]["mean"]
        for method, values in methods.items()
    }
    return {"banks": len(banks), DIRECT: summary[DIRECT]["mean"], "success_at_largest_budget": largest}


def _by_family(
    by_budget: Mapping[int, Mapping[str, Sequence[float]]],
    banks: Mapping[str, Sequence[EpisodeRow]],
    direct: Mapping[str, float],
) -> dict[str, dict[str, dict[str, float]]]:
    """Mean success and gain of each task family and budget."""
    families: dict[str, dict[str, dict[str, float]]] = defaultdict(dict)
    for budget, values in sorted(by_budget.items()):
        for family in sorted({banks[bank][0].task_family for bank in values}):
            members = [bank for bank in values if banks[bank][0].task_family == family]
            mean = float(np.mean([np.mean(values[bank]) for bank in members]))
            gain = mean - float(np.mean([direct[bank] for bank in members]))
            families[family][str(budget)] = {"success": mean, "gain": gain, "banks": len(members)}
    return dict(families)


def _score(method: str, row: EpisodeRow, run: int, metric: str, value: float) -> Score:
    return Score(method, row.bank or "", row.embodiment, row.split, "", run, metric, value, row.scene, row.task_family)
