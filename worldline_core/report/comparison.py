"""Paired comparisons of evaluations: two runs, or a night with the good nights before it.

Series of scores by recording and their joint test are in `evaluation.paired`. A night is tested in three ways, all metrics and ways
together; the probability that any turns red on a night without a change is FALSE_ALARM:

- ``step``: the mean difference to the last good night;
- ``level``: the mean difference to each recording's median over the last DRIFT_NIGHTS good nights;
- ``drift``: the trend of each recording (least squares) over these nights and this one.

`history.jsonl` has a JSON object a line, oldest night first: `{"night": "2026-11-21", "good": true, "metrics": {name: {mean, low,
high, count}}}`; the scores by recording are in `scores/`, a Parquet file a night. A night with regressions is not good: later
nights are compared with the same reference until the loss is repaired or accepted.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from worldline_core.errors import ArtifactError, ConfigError
from worldline_core.evaluation.metric_registry import metric_of
from worldline_core.evaluation.paired import (
    EVALUATIONS,
    PairedTest,
    Series,
    differences,
    margin_of,
    paired_tests,
    read_scores,
    read_series,
    sign_of,
    write_series,
)
from worldline_core.evaluation.scores import SCORES_FILE, SUMMARY_FILE, Interval
from worldline_core.store.artifact_files import (
    MANIFEST_NAME,
    JsonObject,
    digest_value,
    linked_folder,
    read_json,
    read_json_lines,
)
from worldline_core.store.atomic import write_bytes_atomic
from worldline_core.store.store import exclusive_lock
from worldline_core.untrusted_text import visible

FALSE_ALARM = 0.02
DRIFT_NIGHTS = 7
LEAST_NIGHTS = 4
"""Level and drift are tested from so many good nights on."""

Verdict = Literal["better", "worse", "same", "new", "missing"]


def collect_metrics(inputs: Mapping[str, Path]) -> dict[str, Interval]:
    """Intervals of finished evaluations by name, ``<what>/<where>/<method>/<metric>``: ``video/test/shipped_stage2/ssim@head``.

    Whole splits and every number of candidates; embodiments and task families would only add false alarms. Metrics without a
    finite mean and bounds are left out.

    Args:
        inputs: folders by step name, a variant after a dot; other steps than evaluations are ignored.

    Raises:
        ArtifactError: a summary has another form than its evaluation writes.
    """
    found: dict[str, Interval] = {}
    for name, folder in sorted(inputs.items()):
        step, _, variant = name.partition(".")
        path = folder / SUMMARY_FILE
        summary = read_json(path) if step in EVALUATIONS else {}
        what = ".".join(part for part in (step.removeprefix("evaluate_"), variant) if part)
        try:
            for where, method, metric, value in _intervals(step, summary):
                numbers = [value.get(key) for key in ("mean", "low", "high")] if isinstance(value, dict) else []
                finite = [float(n) for n in numbers if isinstance(n, (int, float)) and math.isfinite(n)]
                if len(finite) == 3:
                    mean, low, high = finite
                    found[f"{what}/{where}/{method}/{metric}"] = Interval(mean, low, high, int(value.get("count", 0)))
        except (AttributeError, TypeError, ValueError, OverflowError) as error:
            raise ArtifactError(
                "A summary of an evaluation has another form",
                where=path,
                expected="by group or method the mean, low, high and count of each metric",
                got=str(error),
                next_step=f"delete {folder}, then the same command writes it again",
            ) from error
    return found


def _intervals(step: str, summary: JsonObject) -> Iterator[tuple[str, str, str, Any]]:
    if step == "evaluate_video":
        for split, methods in summary.get("metrics", {}).items():
            for method, metrics in methods.items() if "/" not in split else ():
                yield from ((split, method, metric, value) for metric, value in metrics.items())
    for method, values in summary.get("methods", {}).items() if step != "evaluate_video" else ():
        if step == "evaluate_policy":
            yield from ((g, method, "accuracy", v.get("accuracy")) for g, v in values.items() if "/" not in g)
        else:
            yield from ((f"N={n}", method, "success", v.get("success")) for n, v in values.get("budgets", {}).items())


# Two runs


@dataclass(frozen=True)
class Difference:
    """A metric of a method in a group, in both runs, over the recordings that both have.

    Attributes:
        difference, low, high: first minus second and its 95 % paired bootstrap interval.
        better: ``first`` or ``second`` where chance does not explain the difference (all rows together at 5 %, eight recordings at
            least), else "".
    """

    what: str
    group: str
    method: str
    metric: str
    first: float
    second: float
    difference: float
    low: float
    high: float
    recordings: int
    better: str


def read_run(place: str) -> Series:
    """The series of a run: the folder of an evaluation or of a report, or ``HISTORY:NIGHT``.

    Raises: ArtifactError for a place without scores.
    """
    folder, _, night = place.rpartition(":")
    if folder and not Path(place).exists():
        return read_night(Path(folder), night)
    path = Path(place)
    if (path / SCORES_FILE).is_file():
        return read_scores(path, subgroups=True)
    inputs = read_json(path / MANIFEST_NAME).get("inputs")
    names = [name for name in inputs if name.partition(".")[0] in EVALUATIONS] if isinstance(inputs, dict) else []
    folders = [folder for name in names if (folder := linked_folder(path, name)) is not None]
    if not folders or len(folders) < len(names):
        raise ArtifactError(
            "Nothing to compare here", where=place,
            got=f"{len(folders)} of the evaluations {names}" if names else "neither scores nor a report's manifest",
            expected="the folder of an evaluation, of a report, or HISTORY:NIGHT (artifacts/nightly:2026-11-21)",
        )  # fmt: skip
    return {name: values for folder in folders for name, values in read_scores(folder, subgroups=True).items()}


def compare_runs(
    first: str, second: str, methods: tuple[str, str] | None = None, metrics: Sequence[str] = ()
) -> list[Difference]:
    """Differences of all series that both runs have.

    Args:
        methods: compare this method of the first run with that one of the second.
        metrics: only these (``ssim@head``); none means all.

    Raises:
        ArtifactError: a run has no scores.
        ConfigError: the runs share no method or no recording.
    """
    runs = [read_run(first), read_run(second)]
    if methods is not None:
        runs = [_of_method(run, method) for run, method in zip(runs, methods, strict=True)]
    found = differences(*runs)
    known = sorted({name.split("/", 3)[3] for name in found})
    if unknown := set(metrics) - set(known):
        raise ConfigError("Metrics that not both runs have", expected=f"some of {known}", got=sorted(unknown))
    found = {name: values for name, values in found.items() if not metrics or name.split("/", 3)[3] in metrics}
    if not found:
        named = [sorted({name.split("/")[2] for name in run}) for run in runs]
        raise ConfigError(
            "The runs have no recording and method in common", where=f"{first} and {second}", got=f"{named[0]} and {named[1]}",
            next_step="compare runs over the same recordings; --methods A B pairs methods of other names",
        )  # fmt: skip
    rows = []
    together = paired_tests(found)
    for name, test in paired_tests(found, least=1).items():
        what, group, method, metric = name.split("/", 3)
        means = [sum(run[name][r] for r in found[name]) / test.count for run in runs]
        entry = metric_of(metric)
        low, high = (-test.high, -test.low) if entry and entry.lower_is_better else (test.low, test.high)
        joint = together.get(name)
        better = "first" if joint and joint.p_better <= 0.05 else "second" if joint and joint.p_worse <= 0.05 else ""
        label = method if methods is None else f"{methods[0]} - {methods[1]}"
        values = means[0], means[1], means[0] - means[1], low, high
        rows.append(Difference(what, group.replace("|", "/"), label, metric, *values, test.count, better))
    return rows


def _of_method(run: Series, method: str) -> Series:
    parts = {name: name.split("/", 3) for name in run}
    kept = {f"{p[0]}/{p[1]}/*/{p[3]}": run[name] for name, p in parts.items() if p[2] == method}
    if not kept:
        raise ConfigError("No such method", expected=f"one of {sorted({p[2] for p in parts.values()})}", got=method)
    return kept


def as_table(rows: Sequence[Difference]) -> str:
    """Rows as aligned text."""
    heading = ("metric", "group", "method", "first", "second", "difference", "95 %", "n", "better")
    lines = [heading] + [
        (
            r.metric, f"{r.what} {r.group}", r.method, f"{r.first:.3f}", f"{r.second:.3f}", f"{r.difference:+.3f}",
            f"[{r.low:+.3f}, {r.high:+.3f}]", f"{r.recordings}", r.better,
        )
        for r in rows
    ]  # fmt: skip
    lines = [tuple(map(visible, line)) for line in lines]
    widths = [max(len(line[column]) for line in lines) for column in range(len(heading))]
    return "\n".join("  ".join(text.ljust(w) for text, w in zip(line, widths, strict=True)).rstrip() for line in lines)


# A night and the nights before it


class Tested(NamedTuple):
    """Verdict on one metric, and the question (``step``, ``level`` or ``drift``) and test that decided it."""

    verdict: Verdict
    question: str
    test: PairedTest


@dataclass(frozen=True)
class Change:
    """One metric beside the last good night; None where one of the two did not measure it.

    ``tested`` is None for metrics without scores by recording; their mean is held against the interval of the good night.
    """

    metric: str
    present: Interval | None
    previous: Interval | None
    tested: Tested | None = None

    @property
    def verdict(self) -> Verdict:
        if self.previous is None:
            return "new"
        if self.present is None:
            return "missing"
        if self.tested is not None:
            return self.tested.verdict
        if self.previous.low <= self.present.mean <= self.previous.high:
            return "same"
        return "better" if (self.present.mean > self.previous.high) == (sign_of(self.metric) > 0) else "worse"

    @property
    def worst(self) -> tuple[tuple[str, float], ...]:
        """The recordings that lost most, where the metric became worse and they are known."""
        return self.tested.test.worst if self.tested and self.tested.verdict == "worse" else ()

    def __str__(self) -> str:
        if self.tested is None or self.tested.verdict != "worse":
            return f"{self.metric} ({self.verdict})"
        test = self.tested.test
        worst = ", ".join(f"{recording} ({value:+.3f})" for recording, value in test.worst)
        bounds = f"[{test.low:+.3f}, {test.high:+.3f}]"
        return f"{self.metric}: {self.tested.question} {test.mean:+.3f} {bounds} on {test.count} recordings, most on {worst}"


def compare_series(present: Series, earlier: Sequence[Series]) -> dict[str, Tested]:
    """Verdicts on every metric that this and the last good night have scores of by recording.

    Args:
        earlier: the good nights before the present one, oldest first, at least one.
    """
    asked = {"step": differences(present, earlier[-1])}
    if len(earlier) >= LEAST_NIGHTS:
        several = earlier[-DRIFT_NIGHTS:]
        asked |= {"level": differences(present, medians(several)), "drift": trends([*several, present])}
    tests = paired_tests({f"{q}:{name}": values for q, found in asked.items() for name, values in found.items()})
    of_metric = {
        name: {q: tests[f"{q}:{name}"] for q in asked if f"{q}:{name}" in tests}
        for name in asked["step"]
        if f"step:{name}" in tests
    }
    return {name: _decide(found, margin_of(name)) for name, found in of_metric.items()}


def _decide(tests: Mapping[str, PairedTest], margin: float) -> Tested:
    losses = [(test.p_worse, q) for q, test in tests.items() if test.p_worse <= FALSE_ALARM and -test.mean > margin]
    if losses:
        question = min(losses)[1]
        return Tested("worse", question, tests[question])
    step = tests["step"]
    return Tested("better" if step.p_better <= FALSE_ALARM and step.mean > margin else "same", "step", step)


def _shared(nights: Sequence[Series]) -> Iterator[tuple[str, list[str]]]:
    """Series that all nights have, with the recordings that all have of it."""
    for name in sorted(set[str].intersection(*(set(night) for night in nights))):
        recordings = sorted(set[str].intersection(*(set(night[name]) for night in nights)))
        if recordings:
            yield name, recordings


def medians(nights: Sequence[Series]) -> Series:
    """The median of each recording over several nights."""
    return {
        name: {r: float(np.median([night[name][r] for night in nights])) for r in recordings}
        for name, recordings in _shared(nights)
    }


def trends(nights: Sequence[Series]) -> Series:
    """The gain of each recording from the first to the last of several nights, by a line through its values."""
    time = np.linspace(-1.0, 1.0, len(nights))
    weights = 2 * time / (time**2).sum()
    return {
        name: {r: sign_of(name) * float(weights @ [night[name][r] for night in nights]) for r in recordings}
        for name, recordings in _shared(nights)
    }


# The history of nights

HISTORY_FILE = "history.jsonl"


@dataclass(frozen=True)
class Night:
    """Means of one night with 95 % intervals over trajectories, by metric; only good nights are compared with later ones."""

    night: str
    metrics: Mapping[str, Interval]
    good: bool = True


@dataclass(frozen=True)
class NightlyComparison:
    """A night against the last good one before it; ``pictures`` are files by what they show."""

    night: str
    previous: str | None
    changes: Sequence[Change]
    pictures: Mapping[str, str] = field(default_factory=dict)

    @property
    def worse(self) -> list[Change]:
        """Metrics that became worse or are no longer measured."""
        return [change for change in self.changes if change.verdict in ("worse", "missing")]

    @property
    def regressions(self) -> list[str]:
        return [change.metric for change in self.worse]


def record_night(history: Path, night: str | None, inputs: Mapping[str, Path]) -> NightlyComparison:
    """Append a night's scores to the history and compare them with the good nights before.

    Args:
        night: its name; default: today's date (UTC), with the time if today has other scores already. The same scores under the
            same name are the same night, measured again.
        inputs: finished evaluations by step name, a variant after a dot.

    Raises:
        ArtifactError: nothing was measured, the night is recorded with other scores, or the history is damaged.
    """
    metrics = collect_metrics(inputs)
    if not metrics:
        raise ArtifactError(
            "A night without scores",
            where=night,
            expected=f"inputs named {', '.join(EVALUATIONS)}",
            got=", ".join(sorted(inputs)) or "none",
        )
    series = _series(inputs)
    with exclusive_lock(history / ".lock"):
        nights = read_history(history)
        known = {found.night: index for index, found in enumerate(nights)}
        name = night or time.strftime("%Y-%m-%d", time.gmtime())
        if name in known and nights[known[name]].metrics == metrics:
            return compare_nights(nights[: known[name] + 1], history)
        if name in known and night is not None:
            raise ArtifactError(
                "This night is recorded with other scores", where=history / HISTORY_FILE, got=name,
                next_step="give another name with --night, or none",
            )  # fmt: skip
        if name in known:
            name = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime())
        write_series(scores_file(history, name), series)
        compared = compare_nights([*nights, Night(name, metrics)], history)
        _write_history(history, [*nights, Night(name, metrics, good=not compared.regressions)])
        return compared


def compare_nights(nights: Sequence[Night], history: Path) -> NightlyComparison:
    """The last of several nights against the good ones before it."""
    present = nights[-1]
    good = [night for night in nights[:-1] if night.good]
    before = good[-1].metrics if good else {}
    names = sorted({*present.metrics, *before})
    earlier = [read_series(scores_file(history, night.night)) for night in good[-DRIFT_NIGHTS:]]
    tested = compare_series(read_series(scores_file(history, present.night)), earlier) if earlier else {}
    changes = [Change(name, present.metrics.get(name), before.get(name), tested.get(name)) for name in names]
    return NightlyComparison(present.night, good[-1].night if good else None, changes)


def accept_night(history: Path, night: str) -> None:
    """Mark a night as good: later ones are compared with it.

    Raises:
        ArtifactError: there is no such night, or the history is damaged.
    """
    with exclusive_lock(history / ".lock"):
        nights = read_history(history)
        _require_night(history, nights, night)
        _write_history(history, [replace(found, good=found.good or found.night == night) for found in nights])


def read_night(history: Path, night: str) -> Series:
    """The scores by recording of a recorded night.

    Raises:
        ArtifactError: there is no such night, or the history is damaged.
    """
    _require_night(history, read_history(history), night)
    return read_series(scores_file(history, night))


def _require_night(history: Path, nights: Sequence[Night], night: str) -> None:
    if night not in (names := [found.night for found in nights]):
        raise ArtifactError(
            "No such night", where=history / HISTORY_FILE, expected=", ".join(names) or "a history", got=night
        )


def _series(inputs: Mapping[str, Path]) -> Series:
    """Scores by recording of all evaluations of a night; those of `evaluate_video.long` under `video.long`."""
    found: Series = {}
    for name, folder in sorted(inputs.items()):
        step, _, variant = name.partition(".")
        if step in EVALUATIONS and (folder / SCORES_FILE).is_file():
            for series, values in read_scores(folder).items():
                what, _, rest = series.partition("/")
                found[f"{what}.{variant}/{rest}" if variant else series] = values
    return found


def scores_file(history: Path, night: str) -> Path:
    """The file of a night's scores by recording."""
    return history / "scores" / f"{digest_value(night)[:16]}.parquet"


def _write_history(history: Path, nights: Sequence[Night]) -> None:
    lines = [json.dumps(asdict(night), sort_keys=True, allow_nan=False) for night in nights]
    write_bytes_atomic(history / HISTORY_FILE, ("\n".join(lines) + "\n").encode())


def read_history(history: Path) -> list[Night]:
    """The nights of a history folder, oldest first; no file means no nights.

    Raises:
        ArtifactError: a line is not a night.
    """
    path = history / HISTORY_FILE
    nights: list[Night] = []
    for row in read_json_lines(path, atomic=True):
        try:
            nights.append(_night(row))
            if any(nights[-1].night == other.night for other in nights[:-1]):
                raise ValueError(f"the night {nights[-1].night} a second time")
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise ArtifactError(
                "A line of the history is not a night",
                where=path,
                expected="night, good, and metrics of mean, low, high, count",
                got=str(error),
            ) from error
    return nights


def _night(row: JsonObject) -> Night:
    night = Night(row["night"], {name: Interval(**v) for name, v in row["metrics"].items()}, row["good"])
    numbers = [number for value in night.metrics.values() for number in asdict(value).values()]
    if not all(type(number) in (int, float) and math.isfinite(number) for number in numbers):
        raise ValueError("a value that is not a finite number")
    if not isinstance(night.night, str) or not isinstance(night.good, bool):
        raise TypeError("night must be a text, good true or false")
    return night
