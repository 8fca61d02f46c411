"""Page "Video quality": full-frame metrics and robot-mask IoU with intervals and paired differences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from markupsafe import Markup

from worldline_core.evaluation.metric_registry import METRICS, ON_REQUEST
from worldline_core.pages.charts import Dot, Series, interval_chart, line_chart
from worldline_core.pages.page import Table, interval, words
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.video_scores import IOU_METRICS, SPLIT_LABELS, VideoScores

TITLE = "Video quality"
ALWAYS = tuple(name for name in METRICS if name not in ON_REQUEST)
SUBGROUP_METRICS = ("robot_iou_exact", "robot_iou", "ssim", "psnr")


def quality_section(context: ReportContext) -> Section:
    """Tables by split and view, and what the controls are worth."""
    scores = context.video_scores
    if not scores.groups:
        return Section("quality", TITLE, missing="no video evaluation was given (input evaluate_video).")
    lead = (
        "Head-view metrics, mean over time for each trajectory, then over trajectories, with 95\u202f% bootstrap intervals over"
        " trajectories. Robot IoU, exact: a segmenter's mask of the prediction against the recording's exact mask. Robot IoU,"
        " segmenter: the same segmenter masks the true and the predicted video independently of each other. Object IoU: what the"
        " task moves, found by the colour that the instruction names, in the frames in which it has moved."
    )
    return context.section(
        "quality",
        TITLE,
        lead,
        instruments=instruments(scores),
        unavailable=sorted(scores.unavailable.items()),
        asked=[METRICS[name] for name in ON_REQUEST if scores.measured(name)],
        groups=[group_parts(context, scores, group) for group in scores.groups],
    )


def instruments(scores: VideoScores) -> list[tuple[str, list[tuple[str, Markup | None]]]]:
    """What masks robots and things, and how well its masks of true frames fit the exact ones, by group."""
    found = [
        (s.get("description", s["name"]), accuracy_of(scores, s, f"robot_iou_exact{s.get('suffix', '')}"))
        for s in scores.segmenters
    ]
    things = [accuracy_of(scores, s, "object_iou_exact") for s in scores.segmenters[:1]]
    return found + [("the colour that the instruction names, for things", known) for known in things if known]


def accuracy_of(scores: VideoScores, segmenter: dict[str, Any], metric: str) -> list[tuple[str, Markup | None]]:
    """How accurate the instrument itself is on true frames, by group."""
    accuracy = segmenter.get("accuracy_on_true_frames", {})
    return [
        (SPLIT_LABELS.get(group, group), interval(found, 3))
        for group in scores.groups
        if (found := accuracy.get(group, {}).get(f"{metric}@head"))
    ]


def group_parts(context: ReportContext, scores: VideoScores, group: str) -> dict[str, object]:
    """Tables and charts of one split."""
    iou = next((m for m in IOU_METRICS if any(row["metric"] == m for row in scores.by_frame)), None)
    shown = {"Robot IoU": iou, "SSIM": "ssim", "Object IoU": "object_iou_exact"}
    drift = [over_time(scores, group, metric, label) for label, metric in shown.items()]
    wrists = [metric_table(scores, group, view) for view in ("left_wrist", "right_wrist")]
    return {
        "title": SPLIT_LABELS.get(group, group).capitalize(),
        "tables": [
            found
            for found in (
                metric_table(scores, group, "head"),
                on_request_table(scores, group),
                *second_segmenters(scores, group),
            )
            if found
        ],
        "charts": [*difference_charts(context, scores, group), *(chart for chart in drift if chart)],
        "wrists": [found for found in wrists if found],
        "psnr": over_time(scores, group, "psnr", "PSNR, dB"),
        "subgroups": subgroup_table(scores, group),
    }


def metric_table(
    scores: VideoScores, group: str, view: str, metrics: Sequence[str] = ALWAYS, suffix: str = "", title: str = ""
) -> Table | None:
    """Methods in rows, metrics of one view in columns (``name`` or ``name[variant]``); the best of each column stands out."""
    methods = scores.methods(group)
    names = {metric: f"{metric}{suffix}@{view}" for metric in metrics}
    shown = [m for m in metrics if any(scores.value(group, method.name, names[m]) for method in methods)]
    if not shown:
        return None
    best: dict[str, str] = {}
    entries = {metric: METRICS[metric.partition("[")[0]] for metric in shown}
    for metric in shown:
        values = {m.name: found["mean"] for m in methods if (found := scores.value(group, m.name, names[metric]))}
        best[metric] = (min if entries[metric].lower_is_better else max)(values, key=lambda name: values[name])
    rows = []
    for method in methods:
        cells = [interval(scores.value(group, method.name, names[metric]), entries[metric].digits) for metric in shown]
        rows.append([
            method.long_label,
            *[Markup("<strong>{}</strong>").format(cell) if cell and best[metric] == method.name else cell
              for metric, cell in zip(shown, cells, strict=True)],
        ])  # fmt: skip
    counts = [found["count"] for m in methods if (found := scores.value(group, m.name, names[shown[0]]))]
    caption = (
        f"{title or words(view).capitalize() + ' view'}; trajectories: {max(counts)}. Best of each column in bold."
    )
    variants = {metric: metric.partition("[")[2].rstrip("]") for metric in shown}
    headings = [
        f"{entries[metric].heading}, {variants[metric]}" if variants[metric] else entries[metric].heading
        for metric in shown
    ]
    return Table(headings=["Method", *headings], rows=rows, numeric=range(1, len(headings) + 1), caption=caption)


def on_request_table(scores: VideoScores, group: str) -> Table | None:
    """The metrics that were asked for by name."""
    found = {name.partition("@")[0] for method in scores.methods(group) for name in scores.names(group, method.name)}
    order = [*METRICS]
    asked = sorted(
        (name for name in found if name.partition("[")[0] in ON_REQUEST),
        key=lambda name: (order.index(name.partition("[")[0]), name),
    )
    return metric_table(scores, group, "head", asked, title="Paths of the tools, scene and controls, head view")


def second_segmenters(scores: VideoScores, group: str) -> list[Table | None]:
    """Robot IoU by every further segmenter: does the order of methods depend on the instrument?"""
    return [
        metric_table(scores, group, "head", IOU_METRICS, suffix, f"Head view by a second segmenter, {found['name']}")
        for found in scores.segmenters
        if (suffix := found.get("suffix"))
    ]


def difference_charts(context: ReportContext, scores: VideoScores, group: str) -> list[Markup]:
    """Paired differences of the main method to every other, in robot IoU and SSIM of the head view."""
    primary = scores.primary(group, context.config.primary_method)
    if primary is None:
        return []
    wanted = {"robot_iou_exact": "robot IoU (exact masks)", "robot_iou": "robot IoU (segmenter on both)"}
    wanted |= {
        f"robot_iou{found['suffix']}": f"robot IoU ({found['name']} segmenter on both)"
        for found in scores.segmenters
        if found.get("suffix")
    }
    charts = []
    for metric, label in {**wanted, "ssim": "SSIM"}.items():
        dots = [
            Dot(
                other.label if other.group in (primary.group, "baseline") else other.long_label,
                found["mean"], found["low"], found["high"], other.colour,
            )
            for other in scores.methods(group)
            if (found := scores.difference(group, primary.name, other.name, f"{metric}@head"))
        ]  # fmt: skip
        if dots:
            title = f"{primary.long_label} minus each other: {label}"
            value_label = f"paired difference, 95 % interval; right of zero, {primary.label} is better"
            charts.append(interval_chart(dots, title=title, value_label=value_label, zero_line=True, signed=True))
    return charts


def over_time(scores: VideoScores, group: str, metric: str | None, label: str) -> Markup | None:
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
        return None
    return line_chart(series, title=f"{label} along the prediction", x_label="frame (0 is given)", y_label=label)


def subgroup_table(scores: VideoScores, group: str) -> Table | None:
    """Embodiments and outcomes apart."""
    rows = []
    for subgroup in scores.subgroups(group):
        for method in scores.methods(subgroup):
            cells = [scores.value(subgroup, method.name, f"{metric}@head") for metric in SUBGROUP_METRICS]
            shown = [interval(c, METRICS[m].digits) for m, c in zip(SUBGROUP_METRICS, cells, strict=True)]
            rows.append([subgroup.split("/", 1)[1], method.long_label, *shown])
    headings = ["Embodiment or outcome", "Method", *[METRICS[metric].heading for metric in SUBGROUP_METRICS]]
    return Table(headings, rows, range(2, 6)) if rows else None
