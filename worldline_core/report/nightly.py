"""Comparison with earlier nights: a history of summaries, and a flag on what became worse than chance explains.

The history is one JSON object a line: `{"night": "2026-11-21", "metrics": {name: {mean, low, high, count}}}`. Metrics
are named `<what>/<where>/<method>/<metric>`: `video/test/shipped_stage2/ssim@head`, `planning/N=32/true/success`.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from markupsafe import Markup

from worldline_core.errors import ArtifactError
from worldline_core.evaluation.scores import Interval
from worldline_core.pages.charts import Series, line_chart
from worldline_core.pages.page import Table, code, interval, render, words
from worldline_core.report.context import ReportConfig, ReportContext, Section
from worldline_core.report.decisions import planning_section, policy_section
from worldline_core.report.quality import quality_section
from worldline_core.store.artifact_files import JsonObject, read_json, read_json_lines
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic

logger = logging.getLogger(__name__)

HISTORY_FILE = "history.jsonl"
EVALUATIONS = ("evaluate_video", "evaluate_policy", "evaluate_planning")
LOWER_IS_BETTER = ("lpips", "error", "seconds", "malformed")
TITLE = "Nights"
MOST_CHARTS, MOST_LINES, MOST_TICKS = 8, 8, 8
HEADLINES = ("robot_iou_exact@head", "robot_iou@head", "ssim@head", "accuracy", "success")


@dataclass(frozen=True)
class Night:
    """What one night measured: means with 95 % intervals over trajectories, by metric."""

    night: str
    metrics: Mapping[str, Interval]


@dataclass(frozen=True)
class Change:
    """One metric beside the night before."""

    metric: str
    present: Interval
    previous: Interval | None
    verdict: Literal["better", "worse", "same", "new"]


@dataclass(frozen=True)
class NightlyComparison:
    """The present night against the one before it."""

    night: str
    previous: str | None
    changes: Sequence[Change]

    @property
    def regressions(self) -> list[Change]:
        """What became worse beyond the interval."""
        return [change for change in self.changes if change.verdict == "worse"]


def compare_with_history(scores: Mapping[str, Path], history: Path, night: str | None = None) -> Path:
    """Record a night, write `comparison.json` and pages with trends into the history's folder, and return it.

    Args:
        scores: finished Scores by step name.
        history: folder of the history.
        night: name of the night (default: today's date, UTC).

    Raises:
        ArtifactError: nothing was measured, or the history is damaged.
    """
    compared = record_night(history, night or time.strftime("%Y-%m-%d", time.gmtime()), scores)
    for change in compared.regressions:
        logger.warning(
            "worse than %s: %s %s, was %s", compared.previous, change.metric, change.present, change.previous
        )
    regressions = [change.metric for change in compared.regressions]
    write_json_atomic(history / "comparison.json", asdict(compared) | {"regressions": regressions})
    context = ReportContext(ReportConfig(), {**scores, "history": history}, history)
    nights = nights_section(context)
    sections = [make(context) for make in (quality_section, policy_section, planning_section)]
    text = f"Night {compared.night}: {len(regressions)} of {len(compared.changes)} metrics became worse."
    first = replace(nights, title="WorldLine nightly evaluation", lead=f"{text} {nights.lead}")
    home = render("report/page.html", title=first.title, section=first, sections=sections, next=None)
    context.write_pages(home, sections)
    return history


def record_night(history: Path, night: str, inputs: Mapping[str, Path]) -> NightlyComparison:
    """Appends a night's scores to the history and compares them with the night before.

    Args:
        history: folder of `history.jsonl`; made when absent. The same night is replaced, not repeated.
        night: name of the night, sortable (an ISO date).
        inputs: finished Scores by step name (`evaluate_video`, `evaluate_policy`, `evaluate_planning`, variants with a dot).

    Raises:
        ArtifactError: nothing was measured, or the history is damaged.
    """
    metrics = collect_metrics(inputs)
    if not metrics:
        raise ArtifactError(
            "A night without scores",
            where=night,
            expected=f"inputs named {', '.join(EVALUATIONS)}",
            got=", ".join(sorted(inputs)) or "none",
        )
    others = [n for n in read_history(history) if n.night != night]
    nights = sorted([*others, Night(night, metrics)], key=lambda n: n.night)
    lines = [json.dumps(asdict(item), sort_keys=True, allow_nan=False) for item in nights]
    write_bytes_atomic(history / HISTORY_FILE, ("\n".join(lines) + "\n").encode())
    return compare_nights([n for n in nights if n.night <= night])


def read_history(history: Path) -> list[Night]:
    """The nights of a history folder, oldest first; no file means no nights.

    Raises:
        ArtifactError: a line is not a night.
    """
    path = history / HISTORY_FILE
    nights: list[Night] = []
    for row in read_json_lines(path) if path.is_file() else ():
        try:
            metrics = {name: Interval(**value) for name, value in row["metrics"].items()}
            nights.append(Night(str(row["night"]), metrics))
        except (KeyError, TypeError, AttributeError) as error:
            raise ArtifactError(
                "A line of the history is not a night",
                where=path,
                expected="night, metrics of mean, low, high, count",
                got=str(error),
            ) from error
    return sorted(nights, key=lambda n: n.night)


def collect_metrics(inputs: Mapping[str, Path]) -> dict[str, Interval]:
    """The intervals that are watched, by name: `<what>/<where>/<method>/<metric>`.

    Watched are whole splits and every number of candidates; embodiments and families apart would make a false alarm
    likely on any night. What has no finite mean and bounds is left out.
    """
    found: dict[str, Interval] = {}
    for name, folder in sorted(inputs.items()):
        step, _, variant = name.partition(".")
        summary = read_json(folder / "summary.json") if step in EVALUATIONS else {}
        what = ".".join(part for part in (step.removeprefix("evaluate_"), variant) if part)
        for where, method, metric, value in intervals(step, summary):
            numbers = [value.get(key) for key in ("mean", "low", "high")] if isinstance(value, dict) else []
            finite = [float(n) for n in numbers if isinstance(n, (int, float)) and math.isfinite(n)]
            if len(finite) == 3:
                mean, low, high = finite
                found[f"{what}/{where}/{method}/{metric}"] = Interval(mean, low, high, int(value.get("count", 0)))
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


def compare_nights(nights: Sequence[Night]) -> NightlyComparison:
    """The last of several nights against the one before it."""
    present = nights[-1]
    previous = nights[-2] if len(nights) > 1 else None
    before = previous.metrics if previous else {}
    changes = [
        Change(name, value, before.get(name), verdict(name, value, before.get(name)))
        for name, value in sorted(present.metrics.items())
    ]
    return NightlyComparison(present.night, previous.night if previous else None, changes)


def verdict(metric: str, present: Interval, previous: Interval | None) -> Literal["better", "worse", "same", "new"]:
    """Better or worse only where the mean left the previous night's interval."""
    if previous is None:
        return "new"
    if previous.low <= present.mean <= previous.high:
        return "same"
    fell = present.mean < previous.low
    return "better" if fell == any(word in metric for word in LOWER_IS_BETTER) else "worse"


def nights_section(context: ReportContext) -> Section:
    """The present night against the one before, and charts over all nights."""
    nights = read_history(context.inputs["history"])
    if not nights:
        return Section("nights", TITLE, missing="the history holds no night yet.")
    compared = compare_nights(nights)
    if compared.previous is None:
        lead = f"The first night, {compared.night}: there is nothing to compare it with yet."
    else:
        lead = (
            f"Night {compared.night} beside {compared.previous}. A metric is flagged when its mean left the interval of the"
            " night before."
        )
    tables = [change_table(compared, name) for name in ("worse", "better")]
    return context.section("nights", TITLE, lead, compared=compared, tables=tables, charts=trend_charts(nights))


def change_table(compared: NightlyComparison, verdict: str) -> Table | None:
    """Metrics that became better or worse, before and now."""
    rows = [
        [
            code(c.metric),
            interval(None if c.previous is None else asdict(c.previous), 3),
            interval(asdict(c.present), 3),
        ]
        for c in compared.changes
        if c.verdict == verdict
    ]
    return Table(("Metric", "Night before", "This night"), rows, [1, 2], verdict.capitalize()) if rows else None


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
