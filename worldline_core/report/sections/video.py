"""Section "Video quality": full-frame metrics and robot-mask IoU with intervals and paired differences."""

from __future__ import annotations

from collections.abc import Sequence

from worldline_core.report.charts import Dot, Series, interval_chart, line_chart
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.markup import Column, Html, code, element, interval, join, notice, paragraph, table
from worldline_core.report.video_scores import IOU_METRICS, SPLIT_LABELS, VideoScores

TITLE = "Video quality"
METRICS: tuple[tuple[str, str, int], ...] = (
    ("robot_iou_exact", "Robot IoU, exact ↑", 3),
    ("robot_iou", "Robot IoU, segmenter ↑", 3),
    ("ssim", "SSIM ↑", 3),
    ("psnr", "PSNR, dB ↑", 2),
    ("lpips", "LPIPS ↓", 3),
    ("end_effector_error_px", "Tool error, px ↓", 2),
)
LOWER_IS_BETTER = frozenset({"lpips", "end_effector_error_px"})


def video_section(context: ReportContext) -> Section:
    """Tables by split and view, and what the controls are worth."""
    scores = context.video_scores
    if not scores.groups:
        return Section("video", TITLE, missing="no video evaluation was given (input evaluate_video).")
    lead = (
        "Head-view metrics, mean over time for each trajectory, then over trajectories, with 95\u202f% bootstrap intervals over"
        " trajectories. Robot IoU, exact: a segmenter's mask of the prediction against the recording's exact mask. Robot IoU,"
        " segmenter: the same segmenter masks the true and the predicted video independently of each other."
    )
    parts: list[Html] = [segmenter_note(scores)]
    for group in scores.groups:
        parts.append(element("h3", SPLIT_LABELS.get(group, group).capitalize()))
        parts += [metric_table(scores, group, "head"), second_segmenters(scores, group)]
        iou = next((m for m in IOU_METRICS if any(row["metric"] == m for row in scores.by_frame)), None)
        drift = [over_time(scores, group, iou, "Robot IoU"), over_time(scores, group, "ssim", "SSIM")]
        charts = [*difference_charts(context, scores, group), *drift]
        parts.append(element("div", charts, class_="grid2") if any(charts) else Html(""))
        parts.append(folded_tables(scores, group))
    return Section("video", TITLE, lead, join(parts))


def segmenter_note(scores: VideoScores) -> Html:
    """How accurate the instrument itself is, and what could not be measured."""
    parts: list[Html] = []
    for segmenter in scores.segmenters:
        accuracy = segmenter.get("accuracy_on_true_frames", {})
        known = []
        for group in scores.groups:
            found = accuracy.get(group, {}).get(f"robot_iou_exact{segmenter.get('suffix', '')}@head")
            if found:
                known.append(
                    join(SPLIT_LABELS.get(group, group), " ", interval(found["mean"], found["low"], found["high"], 3))
                )
        shown = (
            join([join(item, "; " if i + 1 < len(known) else ".") for i, item in enumerate(known)])
            if known
            else "not measured."
        )
        parts.append(
            paragraph(
                element("strong", "The instrument: "),
                str(segmenter.get("description", segmenter["name"])).rstrip("."),
                ". Its masks of true frames against the exact masks, IoU: ",
                shown,
            )
        )
    parts += [notice(code(name), f": {reason}") for name, reason in sorted(scores.unavailable.items())]
    return join(parts)


def metric_table(
    scores: VideoScores, group: str, view: str, metrics: Sequence[tuple[str, str, int]] = METRICS, title: str = ""
) -> Html:
    """Methods in rows, metrics (name, heading, digits) of one view in columns; the best of each column stands out."""
    methods = scores.methods(group)
    shown = [item for item in metrics if any(scores.value(group, m.name, f"{item[0]}@{view}") for m in methods)]
    if not shown:
        return Html("")
    best: dict[str, str] = {}
    for metric, _, _ in shown:
        values = {m.name: found["mean"] for m in methods if (found := scores.value(group, m.name, f"{metric}@{view}"))}
        best[metric] = (min if metric in LOWER_IS_BETTER else max)(values, key=lambda name: values[name])
    rows: list[list[object]] = []
    for method in methods:
        cells: list[Html | None] = []
        for metric, _, digits in shown:
            found = scores.value(group, method.name, f"{metric}@{view}")
            cell = interval(found["mean"], found["low"], found["high"], digits) if found else None
            cells.append(element("strong", cell) if cell is not None and best[metric] == method.name else cell)
        rows.append([method.long_label, *cells])
    counts = [found["count"] for m in methods if (found := scores.value(group, m.name, f"{shown[0][0]}@{view}"))]
    columns = [Column("Method"), *[Column(label, numeric=True) for _, label, _ in shown]]
    heading = title or f"{view.replace('_', ' ').capitalize()} view"
    return table(columns, rows, caption=f"{heading}; trajectories: {max(counts)}. Best of each column in bold.")


def second_segmenters(scores: VideoScores, group: str) -> Html:
    """Robot IoU by every further segmenter: does the order of methods depend on the instrument?"""
    tables = []
    for segmenter in scores.segmenters:
        if suffix := segmenter.get("suffix"):
            metrics = tuple(
                (f"{name}{suffix}", label, digits) for name, label, digits in METRICS if name in IOU_METRICS
            )
            tables.append(
                metric_table(scores, group, "head", metrics, f"Head view by a second segmenter, {segmenter['name']}")
            )
    return join(tables)


def difference_charts(context: ReportContext, scores: VideoScores, group: str) -> list[Html]:
    """Paired differences of the main method to every other, in robot IoU and SSIM of the head view."""
    primary = scores.primary(group, context.config.primary_method)
    if primary is None:
        return []
    wanted = [("robot_iou_exact", "robot IoU (exact masks)"), ("robot_iou", "robot IoU (segmenter on both)")]
    wanted += [
        (f"robot_iou{segmenter['suffix']}", f"robot IoU ({segmenter['name']} segmenter on both)")
        for segmenter in scores.segmenters
        if segmenter.get("suffix")
    ]
    charts: list[Html] = []
    for metric, label in (*wanted, ("ssim", "SSIM")):
        dots: list[Dot] = []
        for other in scores.methods(group):
            found = scores.difference(group, primary.name, other.name, f"{metric}@head")
            if found is not None:
                name = other.label if other.group in (primary.group, "baseline") else other.long_label
                dots.append(Dot(name, found["mean"], found["low"], found["high"], other.colour))
        if dots:
            title = f"{primary.long_label} minus each other: {label}"
            value_label = f"paired difference, 95 % interval; right of zero, {primary.label} is better"
            charts.append(interval_chart(dots, title=title, value_label=value_label, zero_line=True, signed=True))
    return charts


def over_time(scores: VideoScores, group: str, metric: str | None, label: str) -> Html:
    """A head-view metric frame by frame: how predictions drift."""
    series = []
    for method in scores.methods(group):
        key = (method.name, group, "head", metric)
        rows = [row for row in scores.by_frame if (row["method"], row["split"], row["view"], row["metric"]) == key]
        rows.sort(key=lambda row: row["frame"])
        if rows:
            frames, means = [float(row["frame"]) for row in rows], [float(row["mean"]) for row in rows]
            series.append(Series(method.long_label, frames, means, colour=method.colour, dashed=method.group == "run"))
    if not series:
        return Html("")
    return line_chart(series, title=f"{label} along the prediction", x_label="frame (0 is given)", y_label=label)


def folded_tables(scores: VideoScores, group: str) -> Html:
    """Wrist views, and embodiments and outcomes apart, folded away."""
    parts: list[Html] = []
    wrists = [metric_table(scores, group, view) for view in ("left_wrist", "right_wrist")]
    if any(wrists):
        parts.append(element("details", element("summary", "Wrist views"), wrists))
    drift = over_time(scores, group, "psnr", "PSNR, dB")
    if drift:
        chart = element("div", drift, class_="grid2")
        parts.append(element("details", element("summary", "PSNR along the prediction"), chart))
    subgroups = scores.subgroups(group)
    if subgroups:
        rows = []
        for subgroup in subgroups:
            for method in scores.methods(subgroup):
                cells = [
                    scores.value(subgroup, method.name, f"{metric}@head")
                    for metric in ("robot_iou_exact", "robot_iou", "ssim", "psnr")
                ]
                shown = [
                    interval(c["mean"], c["low"], c["high"], 2 if i == 3 else 3) if c else None
                    for i, c in enumerate(cells)
                ]
                rows.append([subgroup.split("/", 1)[1], method.long_label, *shown])
        columns = [Column("Embodiment or outcome"), Column("Method")]
        columns += [
            Column(label, numeric=True)
            for label in ("Robot IoU, exact ↑", "Robot IoU, segmenter ↑", "SSIM ↑", "PSNR, dB ↑")
        ]
        parts.append(
            element("details", element("summary", "By embodiment and by outcome (head view)"), table(columns, rows))
        )
    return join(parts)
