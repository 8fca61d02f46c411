"""Two runs compared: paired differences with intervals, by metric and group, over the recordings that both evaluated.

A run is the folder of an evaluation, of a report (whose manifest names its evaluations), or ``HISTORY:NIGHT``, a night of a
nightly history.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from worldline_core.errors import ArtifactError, ConfigError
from worldline_core.evaluation.metric_registry import metric_of
from worldline_core.evaluation.paired import EVALUATIONS, Series, differences, paired_tests, read_scores, read_series
from worldline_core.evaluation.scores import SCORES_FILE, write_table
from worldline_core.report.nightly import read_history, scores_file
from worldline_core.store.artifact_files import MANIFEST_NAME, linked_folder, read_json
from worldline_core.untrusted_text import visible


@dataclass(frozen=True)
class Difference:
    """One row: the metric of a method in a group, in both runs, over the recordings that both have.

    Attributes:
        difference, low, high: first minus second and its 95 % paired bootstrap interval.
        better: the run that is better beyond chance, all rows together at 5 %; "" where neither is, or for fewer than
            eight recordings.
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
    """The series of a run, subgroups too (a night's: as far as they were kept).

    Raises: ArtifactError for a place that holds no scores.
    """
    folder, _, night = place.rpartition(":")
    if folder and not Path(place).exists():
        nights = [found.night for found in read_history(Path(folder))]
        if night not in nights:
            raise ArtifactError("No such night", where=folder, expected=", ".join(nights) or "a history", got=night)
        return read_series(scores_file(Path(folder), night))
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
    """Rows of all series that both runs have.

    Args:
        metrics: only these (``ssim@head``); all where none is named.
        methods: compare this method of the first run with that one of the second, whatever they are called.

    Raises:
        ArtifactError: a run holds no scores.
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
    family = paired_tests(found)
    for name, test in paired_tests(found, least=1).items():
        what, group, method, metric = name.split("/", 3)
        means = [sum(run[name][r] for r in found[name]) / test.count for run in runs]
        entry = metric_of(metric)
        low, high = (-test.high, -test.low) if entry and entry.lower_is_better else (test.low, test.high)
        of_all = family.get(name)
        better = (
            "" if of_all is None else "first" if of_all.p_better <= 0.05 else "second" if of_all.p_worse <= 0.05 else ""
        )
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
    """Rows as text, aligned."""
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


def as_json(rows: Sequence[Difference]) -> list[dict[str, Any]]:
    """Rows as plain values."""
    return [asdict(row) for row in rows]


def write_tidy(path: Path, places: Sequence[str]) -> None:
    """Write the scores of several runs as one table: a row each run, recording, method and metric of a group."""
    rows = []
    for place in places:
        for name, values in read_run(place).items():
            what, group, method, metric = name.split("/", 3)
            shared = {
                "source": place,
                "evaluation": what,
                "group": group.replace("|", "/"),
                "method": method,
                "metric": metric,
            }
            rows += [{**shared, "recording": recording, "value": value} for recording, value in values.items()]
    write_table(path, rows, ("source", "evaluation", "group", "method", "metric", "recording", "value"))
