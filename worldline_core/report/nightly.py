"""Comparison with earlier nights: a history of scores, and a flag on what became worse than chance explains.

The history is one JSON object a line, oldest first: `{"night": "2026-11-21", "good": true, "metrics": {name: {mean, low,
high, count}}}`; the scores of each recording lie in `scores/`, a Parquet file a night. Metrics are named
`<what>/<where>/<method>/<metric>`: `video/test/shipped_stage2/ssim@head`, `planning/N=32/true/success`. `night_changes`
says how a night is compared with earlier ones. A night with regressions is not good: later nights are compared with the same
reference until the loss is repaired or accepted.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from markupsafe import Markup

from worldline_core.errors import ArtifactError, RegressionError
from worldline_core.evaluation.paired import EVALUATIONS, read_scores, read_series, write_series
from worldline_core.evaluation.paired import Series as ScoreSeries
from worldline_core.evaluation.scores import SCORES_FILE, SUMMARY_FILE, Interval
from worldline_core.pages.charts import Series, line_chart
from worldline_core.pages.page import Table, code, interval, render, words
from worldline_core.report.context import ReportConfig, ReportContext, Section
from worldline_core.report.decisions import planning_section, policy_section
from worldline_core.report.night_changes import (
    DRIFT_NIGHTS,
    QUESTIONS,
    Change,
    NightlyComparison,
    compare_series,
    write_night_pictures,
)
from worldline_core.report.quality import quality_section
from worldline_core.store.artifact_files import JsonObject, digest_value, read_json, read_json_lines
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic
from worldline_core.store.store import exclusive_lock

HISTORY_FILE = "history.jsonl"
TITLE = "Nights"
MOST_CHARTS, MOST_LINES, MOST_TICKS = 8, 8, 8
MOST_NIGHTS, MOST_COLUMNS = 30, 6
HEADLINES = ("robot_iou_exact@head", "robot_iou@head", "ssim@head", "accuracy", "success")


@dataclass(frozen=True)
class Night:
    """What one night measured: means with 95 % intervals over trajectories, by metric. ``good``: later nights may be
    compared with it."""

    night: str
    metrics: Mapping[str, Interval]
    good: bool = True


def compare_with_history(
    scores: Mapping[str, Path], history: Path, night: str | None = None, artifacts: Mapping[str, Path] | None = None
) -> NightlyComparison:
    """Record a night, and write `comparison.json`, pictures and pages with trends into the history's folder.

    Args:
        scores: finished Scores by step name.
        history: folder of the history.
        night: its name, as in `record_night`.
        artifacts: the episodes (``filter``) and predictions (``rollout.<method>``) of this night, for pictures of the
            recordings that lost most, or else of the first recording of each method.

    Raises:
        ArtifactError: nothing was measured, the night is recorded with other scores, or the history is damaged.
    """
    compared = record_night(history, night, scores)
    compared = replace(compared, pictures=write_night_pictures(history, compared, artifacts or {}))
    changes = [asdict(change) | {"verdict": change.verdict} for change in compared.changes]
    content = asdict(compared) | {"changes": changes, "regressions": compared.regressions}
    write_json_atomic(history / "comparison.json", content)
    context = ReportContext(ReportConfig(), {**scores, "history": history}, history)
    nights = nights_section(context, compared)
    sections = [make(context) for make in (quality_section, policy_section, planning_section)]
    text = f"Night {compared.night}: {len(compared.regressions)} of {len(compared.changes)} metrics became worse."
    first = replace(nights, title="WorldLine nightly evaluation", lead=f"{text} {nights.lead}")
    home = render("report/page.html", title=first.title, section=first, sections=sections, next=None)
    context.write_pages(home, sections)
    return compared


def refuse_regressions(compared: NightlyComparison, history: Path) -> None:
    """Raises RegressionError, which names the metrics, for a night that became worse."""
    if compared.regressions:
        raise RegressionError(
            f"{len(compared.regressions)} of {len(compared.changes)} metrics became worse than in {compared.previous}",
            where=history / "index.html",
            got="; ".join(str(change) for change in compared.worse)
            + (f"; pictures: {', '.join(compared.pictures.values())}" if compared.pictures else ""),
            next_step=f"find the cause; if this is the new normal: worldline nightly --accept {compared.night}",
        )


def record_night(history: Path, night: str | None, inputs: Mapping[str, Path]) -> NightlyComparison:
    """Appends a night's scores to the history and compares them with the last good night.

    Args:
        history: folder of `history.jsonl`; made when absent.
        night: its name. Default: today's date (UTC), and the time if today has other scores already. The same scores
            under the same name are the same night, measured again.
        inputs: finished Scores by step name (`evaluate_video`, `evaluate_policy`, `evaluate_planning`, variants with a dot).

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


def _series(inputs: Mapping[str, Path]) -> ScoreSeries:
    """Scores by recording of all evaluations of a night; those of a variant (`evaluate_video.long`) under its name."""
    found: ScoreSeries = {}
    for name, folder in sorted(inputs.items()):
        step, _, variant = name.partition(".")
        if step in EVALUATIONS and (folder / SCORES_FILE).is_file():
            for series, values in read_scores(folder).items():
                what, _, rest = series.partition("/")
                found[f"{what}.{variant}/{rest}" if variant else series] = values
    return found


def scores_file(history: Path, night: str) -> Path:
    """Where the scores by recording of a night lie."""
    return history / "scores" / f"{digest_value(night)[:16]}.parquet"


def accept_night(history: Path, night: str) -> None:
    """Mark a night as good: later ones are compared with it.

    Raises:
        ArtifactError: there is no such night, or the history is damaged.
    """
    with exclusive_lock(history / ".lock"):
        nights = read_history(history)
        if night not in (names := [found.night for found in nights]):
            raise ArtifactError("No such night", where=history / HISTORY_FILE, expected=", ".join(names), got=night)
        _write_history(history, [replace(found, good=found.good or found.night == night) for found in nights])


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
                expected="night, metrics of mean, low, high, count",
                got=str(error),
            ) from error
    return nights


def _night(row: JsonObject) -> Night:
    night = Night(row["night"], {name: Interval(**v) for name, v in row["metrics"].items()}, row.get("good", True))
    numbers = [number for value in night.metrics.values() for number in asdict(value).values()]
    if not all(type(number) in (int, float) and math.isfinite(number) for number in numbers):
        raise ValueError("a value that is not a finite number")
    if not isinstance(night.night, str) or not isinstance(night.good, bool):
        raise TypeError("night must be a text, good true or false")
    return night


def collect_metrics(inputs: Mapping[str, Path]) -> dict[str, Interval]:
    """The intervals that are watched, by name: `<what>/<where>/<method>/<metric>`.

    Whole splits and every number of candidates are watched. Embodiments and task families are not watched separately: so
    many tests would make a false alarm likely every night. Metrics without a finite mean and bounds are left out.

    Raises: ArtifactError when a summary has another form than its evaluation writes.
    """
    found: dict[str, Interval] = {}
    for name, folder in sorted(inputs.items()):
        step, _, variant = name.partition(".")
        path = folder / SUMMARY_FILE
        summary = read_json(path) if step in EVALUATIONS else {}
        what = ".".join(part for part in (step.removeprefix("evaluate_"), variant) if part)
        try:
            for where, method, metric, value in intervals(step, summary):
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
                next_step=f"worldline verify {folder} --set-aside, then the same command writes it again",
            ) from error
    return found


def intervals(step: str, summary: JsonObject) -> Iterator[tuple[str, str, str, Any]]:
    """(where, method, metric, interval) of an evaluation's summary."""
    if step == "evaluate_video":
        for split, methods in summary.get("metrics", {}).items():
            for method, metrics in methods.items() if "/" not in split else ():
                yield from ((split, method, metric, value) for metric, value in metrics.items())
    for method, values in summary.get("methods", {}).items() if step != "evaluate_video" else ():
        if step == "evaluate_policy":
            yield from ((g, method, "accuracy", v.get("accuracy")) for g, v in values.items() if "/" not in g)
        else:
            yield from ((f"N={n}", method, "success", v.get("success")) for n, v in values.get("budgets", {}).items())


def compare_nights(nights: Sequence[Night], history: Path) -> NightlyComparison:
    """The last of several nights against the good ones before it, whose scores by recording lie in the history's folder."""
    present = nights[-1]
    good = [night for night in nights[:-1] if night.good]
    before = good[-1].metrics if good else {}
    names = sorted({*present.metrics, *before})
    earlier = [read_series(scores_file(history, night.night)) for night in good[-DRIFT_NIGHTS:]]
    tested = compare_series(read_series(scores_file(history, present.night)), earlier) if earlier else {}
    changes = [Change(name, present.metrics.get(name), before.get(name), tested.get(name)) for name in names]
    return NightlyComparison(present.night, good[-1].night if good else None, changes)


def nights_section(context: ReportContext, compared: NightlyComparison | None = None) -> Section:
    """The present night against the good ones before, pictures, and charts over all nights."""
    nights = read_history(context.inputs["history"])
    if not nights:
        return Section("nights", TITLE, missing="the history holds no night yet.")
    compared = compared or compare_nights(nights, context.inputs["history"])
    if compared.previous is None:
        lead = f"The first night, {compared.night}: there is nothing to compare it with yet."
    else:
        lead = (
            f"Night {compared.night} beside {compared.previous}, the last good one, on the same recordings. Flagged is what"
            " chance does not explain (two false alarms in a hundred nights, over all metrics), beside that night or over"
            f" the last {DRIFT_NIGHTS} good ones, and what is not measured any more."
        )
    tables = [change_table(compared, name) for name in ("worse", "missing", "better")]
    shown = [{"file": file, "what": what} for what, file in compared.pictures.items()]
    return context.section(
        "nights", TITLE, lead, compared=compared, tables=tables, charts=trend_charts(nights), pictures=shown,
        history=history_table(nights),
    )  # fmt: skip


def history_table(nights: Sequence[Night]) -> Table:
    """Every night, the latest first: whether later ones are compared with it, and its headline metrics."""
    headlines = [n for n in nights[-1].metrics if n.split("/")[-1].startswith(HEADLINES)][:MOST_COLUMNS]
    rows = [
        [night.night, "good" if night.good else "red"]
        + [interval(asdict(night.metrics[name]), 3) if name in night.metrics else None for name in headlines]
        for night in list(nights)[::-1][:MOST_NIGHTS]
    ]
    return Table(
        ("Night", "State", *headlines), rows, range(2, 2 + len(headlines)), f"The last {len(rows)} nights", dense=True
    )


def change_table(compared: NightlyComparison, verdict: str) -> Table | None:
    """Metrics with this verdict, before and now."""
    rows = [
        [
            code(c.metric),
            *(interval(None if value is None else asdict(value), 3) for value in (c.previous, c.present)),
            difference_cell(c),
            ", ".join(f"{recording} ({value:+.3f})" for recording, value in c.worst),
        ]
        for c in compared.changes
        if c.verdict == verdict
    ]
    headings = "Metric", "Last good night", "This night", "Difference on the same recordings", "Most on"
    return Table(headings, rows, [1, 2, 3], verdict.capitalize()) if rows else None


def difference_cell(change: Change) -> Markup | None:
    """The paired difference, positive for better, to the good nights that the verdict is about."""
    if change.tested is None:
        return None
    question, test = change.tested.shown
    shown = interval({"mean": test.mean, "low": test.low, "high": test.high}, 3, signed=True)
    return Markup("{}{}").format(shown, QUESTIONS[question])


def trend_charts(nights: Sequence[Night]) -> list[Markup]:
    """Headline metrics over the nights: one chart per metric and split, a line per method."""
    grouped: dict[tuple[str, str], list[str]] = {}
    for name in sorted({name for night in nights for name in night.metrics}):
        parts = name.split("/")
        if len(parts) == 4 and parts[3].startswith(HEADLINES):
            grouped.setdefault((f"{parts[0]}, {parts[1]}", parts[3]), []).append(name)
    charts = []
    for (where, metric), members in sorted(grouped.items())[:MOST_CHARTS]:
        series = []
        for index, name in enumerate(members[:MOST_LINES]):
            points = [(float(i + 1), night.metrics[name]) for i, night in enumerate(nights) if name in night.metrics]
            means, low, high = ([getattr(v, key) for _, v in points] for key in ("mean", "low", "high"))
            x = [place for place, _ in points]
            series.append(Series(name.split("/")[2], x, means, low, high, colour=f"c{index}", markers=True))
        charts.append(
            line_chart(
                series, title=f"{words(metric)} ({where})", y_label=metric,
                x_label=f"night ({nights[0].night} to {nights[-1].night})",
                x_ticks=[float(i + 1) for i in range(0, len(nights), max(1, len(nights) // MOST_TICKS))],
            )
        )  # fmt: skip
    return charts
