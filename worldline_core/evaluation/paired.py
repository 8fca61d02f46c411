"""Evaluations of the same recordings compared, value by value: series of scores, and which differences are more than
chance.

A series is one metric of one method in one group of recordings: a value for each recording (or candidate bank). Its name is
``<what>/<group>/<method>/<metric>``: ``video/test/shipped_stage2/ssim@head``, ``planning/N=32/true/success``.

Many series are compared at once, and some of them always look bad by chance. `paired_tests` therefore asks how often the
*worst* of all of them would look so bad by chance alone: a bootstrap of the maximum of studentised means (Westfall and Young
1993, single step), in which all series resample the same recordings together, so that related series are not counted twice.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from worldline_core.errors import ArtifactError
from worldline_core.evaluation.metric_registry import metric_of
from worldline_core.evaluation.scores import (
    SCORES_FILE,
    SUMMARY_FILE,
    TRUE_METHOD,
    Interval,
    Score,
    table_schema,
    write_table,
)
from worldline_core.store.artifact_files import JsonObject, read_json, read_table

Series = dict[str, dict[str, float]]
"""By name of the series, the value of each recording."""
EVALUATIONS = ("evaluate_video", "evaluate_policy", "evaluate_planning")
LEAST_RECORDINGS = 8
"""With fewer recordings their spread is too uncertain for a test."""
DECISION_MARGIN = 0.01
"""For accuracies and success rates: a smaller loss is no regression."""
_COLUMNS = ("series", "recording", "value")
_OPTIONAL = {field.name for field in fields(Score) if field.default == ""}
_RESAMPLES = 2000


@dataclass(frozen=True)
class PairedTest:
    """Differences of one series over the recordings that both evaluations have; positive is better.

    Attributes:
        low, high: 95 % bootstrap interval of the mean, of this series alone.
        p_worse, p_better: how likely the worst (best) of all series tested together is so far from zero by chance.
        worst: the recordings that lost most, and how much.
    """

    mean: float
    low: float
    high: float
    count: int
    p_worse: float
    p_better: float
    worst: tuple[tuple[str, float], ...]


def collect_metrics(inputs: Mapping[str, Path]) -> dict[str, Interval]:
    """Intervals of finished evaluations (folders by step name, a variant after a dot) by the names of their series.

    Whole splits and every number of candidates; embodiments and task families would only add false alarms.
    """
    found: dict[str, Interval] = {}
    for name, folder in sorted(inputs.items()):
        step, _, variant = name.partition(".")
        if step in EVALUATIONS:
            what = ".".join(part for part in (step.removeprefix("evaluate_"), variant) if part)
            for place, value in _intervals(step, read_json(folder / SUMMARY_FILE)):
                found[f"{what}/{place}"] = Interval(*(value[field.name] for field in fields(Interval)))
    return found


def _intervals(step: str, summary: JsonObject) -> Iterator[tuple[str, Any]]:
    if step == "evaluate_video":
        for split, methods in summary.get("metrics", {}).items():
            for method, metrics in methods.items() if "/" not in split else ():
                yield from ((f"{split}/{method}/{metric}", value) for metric, value in metrics.items())
        return
    for method, values in summary.get("methods", {}).items():
        for group, value in (values if step == "evaluate_policy" else values["budgets"]).items():
            if step == "evaluate_planning":
                yield f"N={group}/{method}/success", value["success"]
            elif "/" not in group and value.get("accuracy") is not None:
                yield f"{group}/{method}/accuracy", value["accuracy"]


def read_scores(folder: Path, *, subgroups: bool = False) -> Series:
    """The series of a finished evaluation; seeds and views of a recording are averaged. ``subgroups``: of embodiments and outcomes as well (``test|ur5e_pair``).

    Raises: ArtifactError where the folder has no table of scores, or a damaged one.
    """
    path = folder / SCORES_FILE
    if not path.is_file():
        raise ArtifactError(
            "Not a finished evaluation", where=folder, expected=SCORES_FILE, next_step="run an evaluation"
        )
    cells: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in _read(path, [field.name for field in fields(Score)]):
        score = Score(**row)
        for name in _names(score, subgroups):
            cells[name][score.episode_id].append(score.value)
    return {name: {r: float(np.mean(v)) for r, v in sorted(values.items())} for name, values in sorted(cells.items())}


def _names(score: Score, subgroups: bool) -> list[str]:
    """The series that a score belongs to."""
    if score.metric == "correct":
        groups, what, metrics = ["all", score.split, score.task_family], "policy", ["accuracy"]
        groups += [f"{score.split}|{score.embodiment}"] if subgroups else []
    elif score.metric.startswith("success@"):
        groups, what, metrics = [f"N={score.metric.partition('@')[2]}"], "planning", ["success"]
        groups += [f"{groups[0]}|{score.embodiment}", f"{groups[0]}|{score.task_family}"] if subgroups else []
    elif metric_of(score.metric) is not None and score.method != TRUE_METHOD:
        groups = [group for group in score.groups if subgroups or "/" not in group]
        what, metrics = "video", [score.metric, *([f"{score.metric}@{score.view}"] if score.view else [])]
    else:
        return []
    method = score.method.replace("/", "|")
    return [
        f"{what}/{group.replace('/', '|')}/{method}/{metric}" for group in dict.fromkeys(groups) for metric in metrics
    ]


def _read(path: Path, columns: Sequence[str]) -> list[dict[str, Any]]:
    """Rows of a table that `write_table` wrote.

    Raises: ArtifactError where it is damaged, lacks a column or a value, or holds one that is no finite number: of those
        every test would be wrong, also that of other series.
    """
    table = read_table(path)
    if table is None:
        return []
    try:
        found = table.select([name for name in columns if name in table.column_names or name not in _OPTIONAL])
        found = found.cast(table_schema(found.column_names))
    except (KeyError, pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise ArtifactError("Not a table of scores", where=path, expected=", ".join(columns), got=str(error)) from error
    if any(column.null_count for column in found.columns) or not np.isfinite(found["value"].to_numpy()).all():
        raise ArtifactError(
            "A table of scores holds values that are none", where=path, expected="finite numbers, nothing empty",
            next_step="rebuild the artifact",
        )  # fmt: skip
    return found.to_pylist()


def write_series(path: Path, series: Series) -> None:
    """Write series as a tidy table: one row a series and recording."""
    rows = [
        {"series": name, "recording": recording, "value": value}
        for name, values in sorted(series.items())
        for recording, value in sorted(values.items())
    ]
    write_table(path, rows, _COLUMNS)


def read_series(path: Path) -> Series:
    """Series that `write_series` wrote; none where there is no such file.

    Raises: ArtifactError where it is damaged.
    """
    found: Series = defaultdict(dict)
    for row in _read(path, _COLUMNS):
        found[row["series"]][row["recording"]] = row["value"]
    return dict(found)


def sign_of(name: str) -> int:
    """1 for a series of which more is better, -1 for one of which less is."""
    metric = metric_of(name.rpartition("/")[2])
    return -1 if metric is not None and metric.lower_is_better else 1


def margin_of(name: str) -> float:
    """The smallest loss of a series that counts."""
    metric = metric_of(name.rpartition("/")[2])
    return DECISION_MARGIN if metric is None else metric.margin


def differences(present: Series, reference: Series) -> Series:
    """``present - reference`` of the recordings that both have, with the sign that makes positive better."""
    found: Series = {}
    for name in present.keys() & reference.keys():
        shared = present[name].keys() & reference[name].keys()
        found[name] = {r: sign_of(name) * (present[name][r] - reference[name][r]) for r in sorted(shared)}
    return {name: values for name, values in sorted(found.items()) if values}


def paired_tests(found: Series, *, least: int = LEAST_RECORDINGS) -> dict[str, PairedTest]:
    """Tests by series; p values hold for all of them at once. Those of fewer than ``least`` recordings are left out."""
    names = [name for name, values in sorted(found.items()) if len(values) >= least]
    if not names:
        return {}
    recordings = sorted({recording for name in names for recording in found[name]})
    column = {recording: place for place, recording in enumerate(recordings)}
    values, there = (np.zeros((len(recordings), len(names))) for _ in range(2))
    for place, name in enumerate(names):
        for recording, value in found[name].items():
            values[column[recording], place], there[column[recording], place] = value, 1.0
    counts = there.sum(axis=0)
    mean = values.sum(axis=0) / counts
    spread = np.sqrt((there * (values - mean) ** 2).sum(axis=0) / np.maximum(counts - 1, 1) / counts)
    varies = spread > 1e-12
    chance = np.full(len(recordings), 1 / len(recordings))
    draws = np.random.default_rng(0).multinomial(len(recordings), chance, _RESAMPLES).astype(np.float64)
    number = np.maximum(draws @ there, 1.0)
    means = (draws @ values) / number
    square = (draws @ values**2) / number - means**2
    # The spread of a draw of few different recordings may be next to nothing: it counts at least half of the sample's.
    own = np.maximum(np.sqrt(np.maximum(square, 0) / np.maximum(number - 1, 1.0)), spread / 2)
    away = ((means - mean) / np.where(varies, own, 1.0))[:, varies]
    highest, lowest = (away.max(axis=1), -away.min(axis=1)) if varies.any() else np.zeros((2, _RESAMPLES))
    low, high = np.quantile(means, [0.025, 0.975], axis=0)
    tests = {}
    for place, name in enumerate(names):
        t = mean[place] / spread[place] if varies[place] else np.sign(mean[place]) * np.inf if mean[place] else 0.0
        losses = sorted(((-value, recording) for recording, value in found[name].items() if value < 0), reverse=True)
        tests[name] = PairedTest(
            float(mean[place]), float(low[place]), float(high[place]), int(counts[place]),
            p_worse=float((1 + (lowest >= -t).sum()) / (1 + len(lowest))),
            p_better=float((1 + (highest >= t).sum()) / (1 + len(highest))),
            worst=tuple((recording, -loss) for loss, recording in losses[:3]),
        )  # fmt: skip
    return tests
