"""Section "Nights": how the shipped checkpoints fared over the nights, with what became worse."""

from __future__ import annotations

from collections.abc import Sequence

from worldline_core.report.charts import Series, line_chart
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.markup import Column, Html, code, element, interval, join, notice, paragraph, table
from worldline_core.report.nightly import Change, Night, compare_nights, read_history

TITLE = "Nights"
MOST_CHARTS = 8
HEADLINES = ("robot_iou_exact@head", "robot_iou@head", "ssim@head", "accuracy", "success")


def trend_section(context: ReportContext) -> Section:
    """The present night against the one before, and charts over all nights."""
    folder = context.inputs.get("history")
    nights = read_history(folder) if folder is not None else []
    if not nights:
        return Section("nights", TITLE, missing="the history holds no night yet.")
    compared = compare_nights(nights)
    if compared.previous is None:
        return Section(
            "nights",
            TITLE,
            f"The first night, {compared.night}: there is nothing to compare it with yet.",
            trend_charts(nights),
        )
    worse = compared.regressions
    better = [change for change in compared.changes if change.verdict == "better"]
    lead = f"Night {compared.night} beside {compared.previous}. A metric is flagged when its mean left the interval of the night before."
    verdict = (
        notice(f"{len(worse)} of {len(compared.changes)} metrics became worse.")
        if worse
        else paragraph("No metric became worse.")
    )
    parts = [verdict, change_table("Worse", worse), change_table("Better", better), trend_charts(nights)]
    return Section("nights", TITLE, lead, join(parts))


def change_table(caption: str, changes: Sequence[Change]) -> Html:
    """Metrics that moved, before and now."""
    if not changes:
        return Html("")
    rows = []
    for change in changes:
        before = change.previous
        was = interval(before.mean, before.low, before.high, 3) if before else None
        rows.append(
            [code(change.metric), was, interval(change.present.mean, change.present.low, change.present.high, 3)]
        )
    return table(
        [Column("Metric"), Column("Night before", numeric=True), Column("This night", numeric=True)],
        rows,
        caption=caption,
    )


def trend_charts(nights: Sequence[Night]) -> Html:
    """Headline metrics over the nights, one chart a metric and split, a line a method."""
    names = sorted({name for night in nights for name in night.metrics})
    shown = [name for name in names if name.rsplit("/", 1)[-1].startswith(HEADLINES)]
    charts: list[Html] = []
    grouped: dict[tuple[str, str], list[str]] = {}
    for name in shown:
        parts = name.split("/")
        if len(parts) == 4:
            grouped.setdefault((f"{parts[0]}, {parts[1]}", parts[3]), []).append(name)
    for (where, metric), members in sorted(grouped.items())[:MOST_CHARTS]:
        series = []
        for index, name in enumerate(members[:8]):
            points = [(i, night.metrics[name]) for i, night in enumerate(nights) if name in night.metrics]
            x, values = [float(i + 1) for i, _ in points], [value for _, value in points]
            means, low, high = ([getattr(v, key) for v in values] for key in ("mean", "low", "high"))
            series.append(Series(name.split("/")[2], x, means, low, high, colour=f"c{index}", markers=True))
        title = f"{metric.replace('_', ' ')} ({where})"
        ticks = [float(i + 1) for i in range(0, len(nights), max(1, len(nights) // 8))]
        charts.append(
            line_chart(
                series,
                title=title,
                x_label=f"night ({nights[0].night} to {nights[-1].night})",
                y_label=metric,
                x_ticks=ticks,
            )
        )
    return element("div", charts, class_="grid2") if charts else Html("")
