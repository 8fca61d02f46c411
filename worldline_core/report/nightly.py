"""The page of the nightly evaluation: changes against the good nights before, pictures of the losses, trends."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from markupsafe import Markup

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import RegressionError
from worldline_core.evaluation.recordings import HEAD
from worldline_core.pages.charts import Series as Line
from worldline_core.pages.charts import line_chart
from worldline_core.pages.page import Table, code, interval, render, words
from worldline_core.pictures import contact_sheet, jpeg_bytes
from worldline_core.report.comparison import (
    DRIFT_NIGHTS,
    Change,
    Night,
    NightlyComparison,
    Verdict,
    read_history,
    record_night,
)
from worldline_core.report.context import ReportConfig, ReportContext, Section
from worldline_core.report.decisions import decisions_section
from worldline_core.report.quality import quality_section
from worldline_core.report.videos import compared_rows
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.store.artifact_files import digest_value
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic

PICTURES = "pictures"
HEADLINES = ("robot_iou_exact@head", "robot_iou@head", "ssim@head", "accuracy", "success")
MOST_CHARTS, MOST_LINES, MOST_TICKS = 8, 8, 8
MOST_NIGHTS, MOST_COLUMNS = 30, 6
MOST_PICTURES = 4
QUESTIONS = {
    "step": "",
    "level": f" beside the median of the last {DRIFT_NIGHTS} good nights",
    "drift": f" as a trend over the last {DRIFT_NIGHTS} good nights",
}


def compare_with_history(
    scores: Mapping[str, Path], history: Path, night: str | None = None, artifacts: Mapping[str, Path] | None = None
) -> NightlyComparison:
    """Record a night, and write `comparison.json`, pictures and pages with trends into the history's folder.

    Args:
        scores: finished evaluations by step name.
        night: its name, as in `record_night`.
        artifacts: ``filter`` (the episodes) and ``rollout.<method>`` of this night, for pictures.

    Raises:
        ArtifactError: nothing was measured, the night is recorded with other scores, or the history is damaged.
    """
    compared = record_night(history, night, scores)
    compared = replace(compared, pictures=_write_pictures(history, compared, artifacts or {}))
    changes = [asdict(change) | {"verdict": change.verdict} for change in compared.changes]
    write_json_atomic(
        history / "comparison.json", asdict(compared) | {"changes": changes, "regressions": compared.regressions}
    )
    context = ReportContext(ReportConfig(), scores, history)
    sections = [make(context) for make in (quality_section, decisions_section)]
    first = _page(context, compared, read_history(history))
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


def _write_pictures(history: Path, compared: NightlyComparison, artifacts: Mapping[str, Path]) -> dict[str, str]:
    """Head views of the recordings that lost most, or of each method's first recording; replaces those of the night before."""
    shutil.rmtree(history / PICTURES, ignore_errors=True)
    rollouts = {
        name.partition(".")[2]: RolloutSet.open(path) for name, path in artifacts.items() if name.startswith("rollout.")
    }
    if "filter" not in artifacts or not rollouts:
        return {}
    episodes = EpisodeSet.open(artifacts["filter"])
    recorded = {row.episode_id for row in episodes.rows}
    lost = [(change.metric.split("/")[2], recording) for change in compared.worse for recording, _ in change.worst]
    written: dict[str, str] = {}
    for method, recording in lost or [(name, rollout.episode_ids[0]) for name, rollout in rollouts.items()]:
        rollout, what = rollouts.get(method), f"{recording}, {method}"
        if rollout is None or recording not in recorded or what in written or HEAD not in rollout.views(recording):
            continue
        rows = compared_rows(rollout, episodes, recording, [HEAD])
        written[what] = f"{PICTURES}/{digest_value([compared.night, what])[:16]}.jpg"
        sheet = contact_sheet(rows, title=f"{compared.night}: {recording}")
        write_bytes_atomic(history / written[what], jpeg_bytes(sheet))
        if len(written) == MOST_PICTURES:
            break
    return written


def _page(context: ReportContext, compared: NightlyComparison, nights: Sequence[Night]) -> Section:
    lead = f"Night {compared.night}: {len(compared.regressions)} of {len(compared.changes)} metrics became worse."
    if compared.previous is not None:
        lead += (
            f" It is held against {compared.previous}, the last good night, and the last {DRIFT_NIGHTS} good ones, on the same"
            " recordings. Flagged is what chance does not explain (two false alarms in a hundred nights, over all metrics)."
        )
    return context.section(
        "nights", "WorldLine nightly evaluation", lead, compared=compared, charts=_trends(nights), history=_history(nights),
        tables=[_changes(compared, verdict) for verdict in ("worse", "missing", "better")],
    )  # fmt: skip


def _history(nights: Sequence[Night]) -> Table:
    """The latest nights, whether they are good, and their headline metrics."""
    headlines = [n for n in nights[-1].metrics if n.split("/")[-1].startswith(HEADLINES)][:MOST_COLUMNS]
    rows = [
        [night.night, "good" if night.good else "red"]
        + [interval(asdict(night.metrics[name]), 3) if name in night.metrics else None for name in headlines]
        for night in list(nights)[::-1][:MOST_NIGHTS]
    ]
    caption = f"The last {len(rows)} nights"
    return Table(("Night", "State", *headlines), rows, range(2, 2 + len(headlines)), caption, dense=True)


def _changes(compared: NightlyComparison, verdict: Verdict) -> Table | None:
    def difference(change: Change) -> Markup | None:
        if change.tested is None:
            return None
        shown = interval(asdict(change.tested.test), 3, signed=True)
        return Markup("{}{}").format(shown, QUESTIONS[change.tested.question])

    rows = [
        [
            code(c.metric),
            *(interval(None if value is None else asdict(value), 3) for value in (c.previous, c.present)),
            difference(c),
            ", ".join(f"{recording} ({value:+.3f})" for recording, value in c.worst),
        ]
        for c in compared.changes
        if c.verdict == verdict
    ]
    headings = "Metric", "Last good night", "This night", "Difference on the same recordings", "Most on"
    return Table(headings, rows, [1, 2, 3], verdict.capitalize()) if rows else None


def _trends(nights: Sequence[Night]) -> list[Markup]:
    """Headline metrics over the nights: a chart per metric and split, a line per method."""
    grouped: dict[tuple[str, str], list[str]] = {}
    for name in sorted({name for night in nights for name in night.metrics}):
        parts = name.split("/")
        if len(parts) == 4 and parts[3].startswith(HEADLINES):
            grouped.setdefault((f"{parts[0]}, {parts[1]}", parts[3]), []).append(name)
    charts = []
    for (where, metric), members in sorted(grouped.items())[:MOST_CHARTS]:
        lines = []
        for index, name in enumerate(members[:MOST_LINES]):
            points = [(float(i + 1), night.metrics[name]) for i, night in enumerate(nights) if name in night.metrics]
            means, low, high = ([getattr(v, key) for _, v in points] for key in ("mean", "low", "high"))
            x = [place for place, _ in points]
            lines.append(Line(name.split("/")[2], x, means, low, high, colour=f"c{index}", markers=True))
        charts.append(
            line_chart(
                lines, title=f"{words(metric)} ({where})", y_label=metric,
                x_label=f"night ({nights[0].night} to {nights[-1].night})",
                x_ticks=[float(i + 1) for i in range(0, len(nights), max(1, len(nights) // MOST_TICKS))],
            )
        )  # fmt: skip
    return charts
