"""Page "Video quality": metrics of predicted videos with intervals and paired differences, and the time that they take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from markupsafe import Markup

from worldline_core.evaluation.metric_registry import METRICS, ON_REQUEST
from worldline_core.pages.charts import Dot, Series, interval_chart, line_chart
from worldline_core.pages.page import Table, interval, number, render, words
from worldline_core.report.context import (
    IOU_METRICS,
    SPLIT_LABELS,
    Method,
    ReportContext,
    Section,
    VideoScores,
    method,
)
from worldline_core.store.artifact_files import JsonObject, read_json

TITLE = "Video quality"
ALWAYS = tuple(name for name in METRICS if name not in ON_REQUEST)
SUBGROUP_METRICS = ("robot_iou_exact", "robot_iou", "ssim", "psnr")
EDGE_BLOCKS = 5


def quality_section(context: ReportContext) -> Section:
    """Tables and charts by split, and the cost of predictions."""
    scores = context.video_scores
    if not scores.groups:
        return Section("quality", TITLE, missing="no video evaluation was given (input evaluate_video).")
    lead = (
        "Head-view metrics, mean over time for each trajectory, then over trajectories, with 95\u202f% bootstrap intervals over"
        " trajectories. Robot IoU, exact: a segmenter's mask of the prediction against the recording's exact mask. Robot IoU,"
        " segmenter: the same segmenter masks the true and the predicted video independently of each other. Object IoU: the moved"
        " object, segmented by the colour that the instruction names, in the frames in which it has moved."
    )
    names = {name.partition("@")[0].partition("[")[0] for group in scores.groups for name in scores.names(group)}
    return context.section(
        "quality",
        TITLE,
        lead,
        instruments=instruments(scores),
        unavailable=sorted(scores.unavailable.items()),
        asked=[METRICS[name] for name in ON_REQUEST if name in names],
        groups=[group_parts(context, scores, group) for group in scores.groups],
        cost=cost(context),
    )


def instruments(scores: VideoScores) -> list[tuple[str, list[tuple[str, Markup | None]]]]:
    """The segmenters of robots and objects, and the IoU of their masks of true frames with the exact ones, by group."""

    def accuracy(segmenter: dict[str, Any], metric: str) -> list[tuple[str, Markup | None]]:
        known = segmenter.get("accuracy_on_true_frames", {})
        return [
            (SPLIT_LABELS.get(group, group), interval(found, 3))
            for group in scores.groups
            if (found := known.get(group, {}).get(f"{metric}@head"))
        ]

    robots = [
        (s.get("description", s["name"]), accuracy(s, f"robot_iou_exact{s.get('suffix', '')}"))
        for s in scores.segmenters
    ]
    objects = [accuracy(s, "object_iou_exact") for s in scores.segmenters[:1]]
    return robots + [("the colour that the instruction names, for objects", known) for known in objects if known]


def group_parts(context: ReportContext, scores: VideoScores, group: str) -> dict[str, object]:
    """Tables and charts of one split."""
    iou = next((m for m in IOU_METRICS if any(row["metric"] == m for row in scores.by_frame)), None)
    shown = {"Robot IoU": iou, "SSIM": "ssim", "Object IoU": "object_iou_exact"}
    order = [*METRICS]
    asked = sorted(
        {base for name in scores.names(group) if (base := name.partition("@")[0]).partition("[")[0] in ON_REQUEST},
        key=lambda name: (order.index(name.partition("[")[0]), name),
    )
    second = [
        metric_table(scores, group, "head", [f"{metric}{s['suffix']}" for metric in IOU_METRICS],
                     f"Head view by a second segmenter, {s['name']}")
        for s in scores.segmenters
        if s.get("suffix")
    ]  # fmt: skip
    tables = [
        metric_table(scores, group, "head"),
        metric_table(scores, group, "head", asked, "Paths of the tools, scene and controls, head view"),
        *second,
    ]
    return {
        "title": SPLIT_LABELS.get(group, group).capitalize(),
        "tables": [table for table in tables if table],
        "charts": [
            *difference_charts(context, scores, group),
            *(chart for label, metric in shown.items() if (chart := over_time(scores, group, metric, label))),
        ],
        "wrists": [
            table for view in ("left_wrist", "right_wrist") if (table := metric_table(scores, group, view)) is not None
        ],
        "subgroups": subgroup_table(scores, group),
    }


def metric_table(
    scores: VideoScores, group: str, view: str, metrics: Sequence[str] = ALWAYS, title: str = ""
) -> Table | None:
    """Methods in rows, metrics of one view in columns (``name`` or ``name[variant]``); the best of each column in bold."""
    methods = scores.methods(group)
    shown = [m for m in metrics if any(scores.value(group, method.name, f"{m}@{view}") for method in methods)]
    if not shown:
        return None
    cells: dict[str, list[object]] = {method.name: [] for method in methods}
    headings, counts = ["Method"], [0]
    for metric in shown:
        base, _, variant = metric.partition("[")
        entry = METRICS[base]
        found = {m.name: scores.value(group, m.name, f"{metric}@{view}") for m in methods}
        means = {name: value["mean"] for name, value in found.items() if value}
        best = (min if entry.lower_is_better else max)(means, key=lambda name: means[name])
        for name, value in found.items():
            cell = interval(value, entry.digits)
            cells[name].append(Markup("<strong>{}</strong>").format(cell) if name == best else cell)
        headings.append(f"{entry.heading}, {variant.rstrip(']')}" if variant else entry.heading)
        counts += [value["count"] for value in found.values() if value]
    caption = (
        f"{title or words(view).capitalize() + ' view'}; trajectories: {max(counts)}. Best of each column in bold."
    )
    rows = [[m.long_label, *cells[m.name]] for m in methods]
    return Table(headings, rows, range(1, len(headings)), caption)


def difference_charts(context: ReportContext, scores: VideoScores, group: str) -> list[Markup]:
    """Paired differences of the main method to every other, in robot IoU and SSIM of the head view."""
    primary = scores.primary(group, context.config.primary_method)
    if primary is None:
        return []
    wanted = {
        "robot_iou_exact": "robot IoU (exact masks)",
        "robot_iou": "robot IoU (segmenter on both)",
        "ssim": "SSIM",
    }
    charts = []
    for metric, label in wanted.items():
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
    """A head-view metric frame by frame: the drift of predictions."""
    series = []
    for m in scores.methods(group):
        key = (m.name, group, "head", metric)
        rows = [row for row in scores.by_frame if (row["method"], row["split"], row["view"], row["metric"]) == key]
        rows.sort(key=lambda row: row["frame"])
        if rows:
            frames, means = [float(row["frame"]) for row in rows], [float(row["mean"]) for row in rows]
            series.append(Series(m.long_label, frames, means, colour=m.colour, dashed=m.group == "run"))
    if not series:
        return None
    return line_chart(series, title=f"{label} along the prediction", x_label="frame (0 is given)", y_label=label)


def subgroup_table(scores: VideoScores, group: str) -> Table | None:
    """The main metrics by embodiment and by outcome."""
    rows = []
    for subgroup in scores.subgroups(group):
        for m in scores.methods(subgroup):
            cells = [scores.value(subgroup, m.name, f"{metric}@head") for metric in SUBGROUP_METRICS]
            shown = [interval(c, METRICS[name].digits) for name, c in zip(SUBGROUP_METRICS, cells, strict=True)]
            rows.append([subgroup.split("/", 1)[1], m.long_label, *shown])
    headings = ["Embodiment or outcome", "Method", *[METRICS[metric].heading for metric in SUBGROUP_METRICS]]
    return Table(headings, rows, range(2, 6)) if rows else None


@dataclass(frozen=True)
class Timing:
    """The times that one rollout step recorded (run/speed.json)."""

    name: str
    content: JsonObject

    @property
    def banks(self) -> bool:
        """Whether the rollout is of candidate banks."""
        return self.name.startswith("banks_")

    @property
    def method(self) -> Method:
        return method(self.name.removeprefix("banks_"))

    @property
    def label(self) -> str:
        return f"{self.method.long_label}{', candidate banks' if self.banks else ''}"

    @property
    def blocks(self) -> list[float]:
        """Seconds of each block of the long rollout made to measure it.

        Processor seconds where they were recorded: other programs do not stretch them. Empty for models of whole clips.
        """
        long = self.content.get("long_rollout") or {}
        values = long.get("block_processor_seconds") or long.get("block_seconds")
        return [float(value) for value in values or []]

    @property
    def ratio(self) -> float | None:
        """Cost of the last blocks over that of the first (medians of five each); None for fewer than ten blocks."""
        blocks = self.blocks
        if len(blocks) < 2 * EDGE_BLOCKS:
            return None
        return median(blocks[-EDGE_BLOCKS:]) / median(blocks[:EDGE_BLOCKS])


def timings(context: ReportContext) -> list[Timing]:
    """Times of the rollout steps, those of candidate banks last."""
    read = [Timing(n, read_json(path / "run" / "speed.json")) for n, path in context.variants("rollout").items()]
    known = [timing for timing in read if timing.content.get("seconds_per_frame") is not None]
    return sorted(known, key=lambda timing: (timing.banks, timing.method.rank))


def longest(found: Sequence[Timing]) -> list[Timing]:
    """The block-causal rollouts of the most blocks."""
    most = max((len(timing.blocks) for timing in found), default=0)
    return [timing for timing in found if len(timing.blocks) == most > 1]


def cost(context: ReportContext) -> Markup | None:
    """Time per frame and per block; a slot, because times differ from run to run."""
    found = timings(context)
    if not found:
        return None
    rows = [
        [
            timing.label,
            *[timing.content.get(key) for key in ("steps", "dtype", "batch_size", "frames")],
            number(1000 * float(timing.content["seconds_per_frame"]), 1),
            len(timing.blocks) or None,
            number(1000 * median(timing.blocks), 0) if timing.blocks else None,
            None if timing.ratio is None else number(timing.ratio, 2),
        ]
        for timing in found
    ]
    headings = [
        "Method", "Steps", "Precision", "Batch", "Frames", "ms per frame", "Blocks", "ms per block", "Last to first block",
    ]  # fmt: skip
    caption = (
        "Wall time of predicting and decoding. A frame is one instant in all views. Steps: of a whole clip, or of a block for causal"
        f" models. Last to first block: medians of {EDGE_BLOCKS} blocks each, sampling alone."
    )
    shown = longest(found)
    body = render(
        "report/cost.html",
        devices=sorted({str(t.content["device_name"]) for t in found if t.content.get("device_name")}),
        table=Table(headings, rows, range(1, 9), caption),
        chart=block_chart(shown) if shown else None,
    )
    return context.slot("cost", body, "Recorded when the report was made; see run/run.js.")


def block_chart(shown: Sequence[Timing]) -> Markup:
    """Time of every block of rollouts of equally many blocks."""
    count = len(shown[0].blocks)
    series = [
        Series(
            timing.label, [float(i + 1) for i in range(count)], [1000 * seconds for seconds in timing.blocks],
            colour=timing.method.colour, dashed=timing.method.group == "run", markers=count <= 8,
        )
        for timing in shown
    ]  # fmt: skip
    by_processor = any("block_processor_seconds" in (t.content.get("long_rollout") or {}) for t in shown)
    return line_chart(
        series, title=f"Time of each block, from the first to number {count}", x_label="block (16 frames of every view)",
        y_label="processor ms" if by_processor else "ms per trajectory",
        y_range=(0.0, 1.15 * max(v for s in series for v in s.y)),
    )  # fmt: skip


def constant_cost(context: ReportContext) -> str:
    """One line about the constant cost of blocks, for the first page."""
    shown = longest(timings(context))
    ratios = [timing.ratio for timing in shown if timing.ratio is not None]
    if not ratios:
        return ""
    return f"Cost of the last of {len(shown[0].blocks)} causal blocks over the first: ratio {max(ratios):.2f}."
