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
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from markupsafe import Markup

from worldline_core.errors import ArtifactError
from worldline_core.pages.charts import Series, line_chart
from worldline_core.pages.page import Table, code, interval, render, words
from worldline_core.report.context import ReportContext, ReportInputs, Section
from worldline_core.report.planning import planning_section
from worldline_core.report.policy import policy_section
from worldline_core.report.quality import quality_section
from worldline_core.report.report_config import ReportConfig
from worldline_core.store.artifact_files import read_json, read_json_lines
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic

logger = logging.getLogger(__name__)

HISTORY_FILE = "history.jsonl"
EVALUATIONS = ("evaluate_video", "evaluate_policy", "evaluate_planning")
LOWER_IS_BETTER = ("lpips", "error", "seconds", "malformed")
TITLE = "Nights"
MOST_CHARTS = 8
HEADLINES = ("robot_iou_exact@head", "robot_iou@head", "ssim@head", "accuracy", "success")
Verdict = Literal["better", "worse", "same", "new"]


@dataclass(frozen=True)
class Measured:
    """A mean with its 95 % interval over trajectories."""

    mean: float
    low: float
    high: float
    count: int = 0


@dataclass(frozen=True)
class Night:
    """What one night measured."""

    night: str
    metrics: Mapping[str, Measured]


@dataclass(frozen=True)
class Change:
    """One metric beside the night before."""

    metric: str
    present: Measured
    previous: Measured | None
    verdict: Verdict


@dataclass(frozen=True)
class NightlyComparison:
    """The present night against the one before it."""

    night: str
    previous: str | None
    changes: Sequence[Change] = field(default_factory=tuple)

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
        was = change.previous
        if was is not None:
            logger.warning("worse than %s: %s %.4f, was %.4f [%.4f, %.4f]", compared.previous, change.metric,
                           change.present.mean, was.mean, was.low, was.high)  # fmt: skip
    write_json_atomic(
        history / "comparison.json", asdict(compared) | {"regressions": [c.metric for c in compared.regressions]}
    )
    context = ReportContext(ReportConfig(), ReportInputs({**scores, "history": history}), history)
    nights = nights_section(context)
    sections = [make(context) for make in (quality_section, policy_section, planning_section)]
    text = f"Night {compared.night}: {len(compared.regressions)} of {len(compared.changes)} metrics became worse."
    first = replace(nights, title="WorldLine nightly evaluation", lead=f"{text} {nights.lead}")
    context.write_pages(
        render("report/page.html", title=first.title, section=first, sections=sections, next=None), sections
    )
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
    nights = sorted(
        [*(n for n in read_history(history) if n.night != night), Night(night, metrics)], key=lambda n: n.night
    )
    lines = [json.dumps(asdict(item), sort_keys=True, allow_nan=False) for item in nights]
    write_bytes_atomic(history / HISTORY_FILE, ("\n".join(lines) + "\n").encode())
    return compare_nights([n for n in nights if n.night <= night])


def read_history(history: Path) -> list[Night]:
    """The nights of a history folder, oldest first; no file means no nights.

    Raises:
        ArtifactError: a line is not a night.
    """
    path = history / HISTORY_FILE
    if not path.is_file():
        return []
    nights: list[Night] = []
    for row in read_json_lines(path):
        try:
            metrics = {name: Measured(**value) for name, value in row["metrics"].items()}
            nights.append(Night(str(row["night"]), metrics))
        except (KeyError, TypeError, AttributeError) as error:
            raise ArtifactError(
                "A line of the history is not a night",
                where=path,
                expected="night, metrics of mean, low, high, count",
                got=str(error),
            ) from error
    return sorted(nights, key=lambda n: n.night)


def collect_metrics(inputs: Mapping[str, Path]) -> dict[str, Measured]:
    """The intervals that are watched, by name: `<what>/<where>/<method>/<metric>`.

    Watched are whole splits and every number of candidates; embodiments and families apart would make a false alarm
    likely on any night.
    """
    found: dict[str, Measured] = {}
    for name, folder in sorted(inputs.items()):
        step, _, variant = name.partition(".")
        summary = read_json(folder / "summary.json") if step in EVALUATIONS else {}
        what = ".".join(part for part in (step.removeprefix("evaluate_"), variant) if part)
        for where, method, metric, value in intervals(step, summary):
            measured = read_interval(value)
            if measured is not None:
                found[f"{what}/{where}/{method}/{metric}"] = measured
    return found


def intervals(step: str, summary: Mapping[str, Any]) -> Iterator[tuple[str, str, str, Any]]:
    """(where, method, metric, interval) of an evaluation's summary."""
    if step == "evaluate_video":
        for split, methods in summary.get("metrics", {}).items():
            for method, metrics in methods.items() if "/" not in split else ():
                yield from ((split, method, metric, value) for metric, value in metrics.items())
    elif step == "evaluate_policy":
        for method, groups in summary.get("methods", {}).items():
            yield from (
                (group, method, "accuracy", value.get("accuracy"))
                for group, value in groups.items()
                if "/" not in group
            )
    elif step == "evaluate_planning":
        for method, values in summary.get("methods", {}).items():
            for budget, value in values.get("budgets", {}).items():
                yield f"N={budget}", method, "success", value.get("success")


def read_interval(value: Any) -> Measured | None:
    """An object with finite mean, low and high; None for anything else."""
    numbers = [value.get(key) for key in ("mean", "low", "high")] if isinstance(value, dict) else []
    if not numbers or not all(isinstance(n, (int, float)) and math.isfinite(n) for n in numbers):
        return None
    mean, low, high = (float(n) for n in numbers if n is not None)
    return Measured(mean, low, high, int(value.get("count", 0)))


def compare_nights(nights: Sequence[Night]) -> NightlyComparison:
    """The last of several nights against the one before it."""
    present = nights[-1]
    previous = nights[-2] if len(nights) > 1 else None
    changes = [
        Change(name, value, before, verdict(name, value, before))
        for name, value in sorted(present.metrics.items())
        for before in [previous.metrics.get(name) if previous else None]
    ]
    return NightlyComparison(present.night, previous.night if previous else None, changes)


def verdict(metric: str, present: Measured, previous: Measured | None) -> Verdict:
    """Better or worse only where the mean left the previous night's interval."""
    if previous is None:
        return "new"
    sign = -1.0 if any(word in metric for word in LOWER_IS_BETTER) else 1.0
    low, high = sorted((sign * previous.low, sign * previous.high))
    mean = sign * present.mean
    return "worse" if mean < low else "better" if mean > high else "same"


def nights_section(context: ReportContext) -> Section:
    """The present night against the one before, and charts over all nights."""
    folder = context.inputs.get("history")
    nights = read_history(folder) if folder is not None else []
    if not nights:
        return Section("nights", TITLE, missing="the history holds no night yet.")
    compared = compare_nights(nights)
    lead = (
        f"The first night, {compared.night}: there is nothing to compare it with yet."
        if compared.previous is None
        else f"Night {compared.night} beside {compared.previous}. A metric is flagged when its mean left the interval of the"
        " night before."
    )
    better = [change for change in compared.changes if change.verdict == "better"]
    tables = [change_table("Worse", compared.regressions), change_table("Better", better)]
    return context.section(
        "nights",
        TITLE,
        lead,
        compared=compared,
        tables=tables if compared.previous else [],
        charts=trend_charts(nights),
    )


def change_table(caption: str, changes: Sequence[Change]) -> Table | None:
    """Metrics that moved, before and now."""
    rows = [
        [code(change.metric), interval(None if was is None else asdict(was), 3), interval(asdict(change.present), 3)]
        for change in changes
        for was in [change.previous]
    ]
    return Table(("Metric", "Night before", "This night"), rows, [1, 2], caption) if rows else None


def trend_charts(nights: Sequence[Night]) -> list[Markup]:
    """Headline metrics over the nights: one chart per metric and split, a line per method."""
    names = sorted({name for night in nights for name in night.metrics})
    grouped: dict[tuple[str, str], list[str]] = {}
    for name in names:
        parts = name.split("/")
        if len(parts) == 4 and parts[3].startswith(HEADLINES):
            grouped.setdefault((f"{parts[0]}, {parts[1]}", parts[3]), []).append(name)
    charts = []
    for (where, metric), members in sorted(grouped.items())[:MOST_CHARTS]:
        series = []
        for index, name in enumerate(members[:8]):
            points = [(float(i + 1), night.metrics[name]) for i, night in enumerate(nights) if name in night.metrics]
            means, low, high = ([getattr(v, key) for _, v in points] for key in ("mean", "low", "high"))
            x = [place for place, _ in points]
            series.append(Series(name.split("/")[2], x, means, low, high, colour=f"c{index}", markers=True))
        charts.append(
            line_chart(
                series, title=f"{words(metric)} ({where})", y_label=metric,
                x_label=f"night ({nights[0].night} to {nights[-1].night})",
                x_ticks=[float(i + 1) for i in range(0, len(nights), max(1, len(nights) // 8))],
            )
        )  # fmt: skip
    return charts
