"""Pages of the evaluations: "Video quality", and "Policy and planning"."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Sequence
from statistics import median

from markupsafe import Markup

from worldline_core.evaluation.metric_registry import METRICS, ON_REQUEST, metric_of
from worldline_core.evaluation.policy.evidence import failure_kind
from worldline_core.evaluation.scores import TRUE_METHOD
from worldline_core.pages.charts import Dot, Series, interval_chart, line_chart
from worldline_core.pages.page import Table, interval, number, percent, with_note, words
from worldline_core.report.context import (
    SPLIT_LABELS,
    ReportContext,
    Section,
    VideoScores,
    in_order,
    method,
    predicting,
)
from worldline_core.store.artifact_files import JsonObject, read_json, read_rows

ALL = "all"
EDGE_BLOCKS = 5
MODELS = (TRUE_METHOD, "stage2", "causal", "other")
"""Kinds of methods with the true controls."""
CHARTED = {"robot_iou_exact": "robot IoU, exact", "robot_iou": "robot IoU", "ssim": "SSIM"}
QUALITY = (
    "Mean over time for each trajectory, then over trajectories, with 95\u202f% bootstrap intervals over trajectories. Robot IoU,"
    " exact: a segmenter's mask of the prediction against the recording's exact mask. Robot IoU, segmenter: the same segmenter"
    " masks the true and the predicted video independently of each other."
)


def quality_section(context: ReportContext) -> Section:
    """Tables and charts by split, and the cost of predictions."""
    scores = context.video_scores
    if not scores.groups:
        return Section("quality", "Video quality", missing="no video evaluation was given (input evaluate_video).")
    names = {metric.name for group in scores.groups for name in scores.names(group) if (metric := metric_of(name))}
    return context.section(
        "quality",
        "Video quality",
        QUALITY,
        instruments=[(s.get("description", s["name"]), instrument_accuracy(scores, s)) for s in scores.segmenters],
        unavailable=sorted(scores.unavailable.items()),
        asked=[METRICS[name] for name in ON_REQUEST if name in names],
        groups=[
            {
                "title": SPLIT_LABELS.get(group, group).capitalize(),
                "tables": [
                    table
                    for view in ("head", "left_wrist", "right_wrist")
                    for table in metric_tables(scores, group, view)
                ],
                "charts": [*difference_charts(scores, group), *charts_over_time(scores, group)],
            }
            for group in scores.groups
        ],
        cost=cost(context),
    )


def instrument_accuracy(scores: VideoScores, segmenter: JsonObject) -> list[tuple[str, Markup | None]]:
    """IoU of a segmenter's masks of true frames with the exact ones, by group."""
    known, metric = segmenter.get("accuracy_on_true_frames", {}), f"robot_iou_exact{segmenter.get('suffix', '')}@head"
    return [
        (SPLIT_LABELS.get(g, g), interval(known[g][metric], 3)) for g in scores.groups if metric in known.get(g, {})
    ]


def metric_tables(scores: VideoScores, group: str, view: str) -> list[Table]:
    """Methods in rows, metrics of one view in columns, up to eight; the best of each column in bold."""
    measured = {name.removesuffix(f"@{view}") for name in scores.names(group) if name.endswith(f"@{view}")}
    order = [*METRICS]
    shown = sorted((n for n in measured if metric_of(n)), key=lambda n: ("[" in n, order.index(n.partition("[")[0]), n))
    methods, tables = scores.methods(group), list[Table]()
    for metrics in (shown[i : i + 8] for i in range(0, len(shown), 8)):
        rows: list[list[object]] = [[m.long_label] for m in methods]
        headings, counts = ["Method"], [0]
        for metric in metrics:
            base, _, variant = metric.partition("[")
            entry = METRICS[base]
            found = [scores.value(group, m.name, f"{metric}@{view}") for m in methods]
            best = (min if entry.lower_is_better else max)(value["mean"] for value in found if value)
            for row, value in zip(rows, found, strict=True):
                cell = interval(value, entry.digits)
                row.append(Markup("<strong>{}</strong>").format(cell) if value and value["mean"] == best else cell)
            headings.append(f"{entry.heading}, {variant.rstrip(']')}" if variant else entry.heading)
            counts += [value["count"] for value in found if value]
        caption = f"{words(view).capitalize()} view; trajectories: {max(counts)}. Best of each column in bold."
        tables.append(Table(headings, rows, range(1, len(headings)), caption))
    return tables


def difference_charts(scores: VideoScores, group: str) -> list[Markup]:
    """Paired differences of the main method to every other, in robot IoU and SSIM of the head view."""
    primary, charts = scores.primary(group), list[Markup]()
    if primary is None:
        return []
    for metric, label in CHARTED.items():
        dots = [
            Dot(other.long_label, found["mean"], found["low"], found["high"], other.colour)
            for other in scores.methods(group)
            if (found := scores.difference(group, primary.name, other.name, f"{metric}@head"))
        ]
        if dots:
            title = f"{primary.long_label} minus each other: {label}"
            value_label = f"paired difference, 95 % interval; right of zero, {primary.label} is better"
            charts.append(interval_chart(dots, title=title, value_label=value_label, zero_line=True, signed=True))
    return charts


def charts_over_time(scores: VideoScores, group: str) -> list[Markup]:
    """Head-view metrics frame by frame: the drift of predictions."""
    charts = []
    for metric, label in CHARTED.items():
        series = []
        for m in scores.methods(group):
            key = (m.name, group, "head", metric)
            rows = [row for row in scores.by_frame if (row["method"], row["split"], row["view"], row["metric"]) == key]
            rows.sort(key=lambda row: row["frame"])
            if rows:
                frames, means = [float(row["frame"]) for row in rows], [float(row["mean"]) for row in rows]
                series.append(Series(m.long_label, frames, means, colour=m.colour, dashed=m.group == "run"))
        if series:
            title = f"{label} along the prediction"
            charts.append(line_chart(series, title=title, x_label="frame (0 is given)", y_label=label))
    return charts


def block_costs(content: JsonObject) -> tuple[float, float] | None:
    """Median seconds of a block of the long rollout, and the ratio of the last five to the first five; None for fewer than ten.

    Processor seconds where they were recorded: other programs do not stretch them.
    """
    long = content.get("long_rollout") or {}
    blocks = long.get("block_processor_seconds") or long.get("block_seconds") or []
    if len(blocks) < 2 * EDGE_BLOCKS:
        return None
    return median(blocks), median(blocks[-EDGE_BLOCKS:]) / median(blocks[:EDGE_BLOCKS])


def cost(context: ReportContext) -> Markup | None:
    """Time per frame and per block; a slot, because times differ from run to run."""
    rows, devices = list[list[object]](), set[str]()
    for name, path in context.variants("rollout").items():
        content = read_json(path / "run" / "speed.json")
        if content.get("seconds_per_frame") is None:
            continue
        banks = ", candidate banks" if name.startswith("banks_") else ""
        blocks = block_costs(content)
        rows.append([
            method(name).long_label + banks,
            *[content.get(key) for key in ("steps", "dtype", "batch_size", "frames")],
            number(1000 * float(content["seconds_per_frame"]), 1),
            *((None, None) if blocks is None else (number(1000 * blocks[0], 0), number(blocks[1], 2))),
        ])  # fmt: skip
        devices.add(str(content.get("device_name") or "unknown device"))
    headings = [
        "Method",
        "Steps",
        "Precision",
        "Batch",
        "Frames",
        "ms per frame",
        "ms per block",
        "Last to first block",
    ]
    caption = (
        f"Wall time of predicting and decoding on {'; '.join(sorted(devices))}. A frame is one instant in all views. Steps: of a whole"
        f" clip, or of a block for causal models. Last to first block: medians of {EDGE_BLOCKS} blocks each, sampling alone."
    )
    table = Table(headings, rows, range(1, len(headings)), caption).__html__()
    return context.slot("cost", table, "Recorded when the report was made; see run/run.js.") if rows else None


# Policy and planning


def decisions_section(context: ReportContext) -> Section:
    """Policy evaluations, then planning evaluations."""
    judged = [
        policy_evaluation(summary, read_rows(folder / "decisions.parquet"))
        for folder in context.variants("evaluate_policy").values()
        if (summary := read_json(folder / "summary.json")).get("methods")
    ]
    planned = [planning_evaluation(summary) for summary in context.summaries("evaluate_planning")]
    title = "Policy and planning"
    if not judged and not planned:
        return Section("decisions", title, missing="inputs evaluate_policy and evaluate_planning.")
    return context.section("decisions", title, judged=judged, planned=planned)


def policy_evaluation(summary: JsonObject, verdicts: Sequence[JsonObject] = ()) -> dict[str, object]:
    """Values of one policy evaluation for the template; ``verdicts`` are the rows of its decisions.parquet."""
    results = summary["methods"]
    dots = [
        Dot(m.long_label, found["mean"], found["low"], found["high"], m.colour)
        for m in in_order(results)
        if (found := results[m.name].get(ALL, {}).get("accuracy"))
    ]
    title = f"Accuracy over {summary.get('trajectories', '?')} trajectories (judge: {summary.get('judge', 'unknown')})"
    value_label = "agreement with the recorded outcome, 95 % interval"
    return {
        "chart": interval_chart(dots, digits=2, value_label=value_label, title=title) if dots else None,
        "short": sorted((summary.get("shorter_than_recording") or {}).items()),
        "groups": accuracy_table(results) if dots else None,
        "ranking": policy_ranking(summary["policies"]) if summary.get("policies") else None,
        "trust": trust_view(summary["trust"]) if summary.get("trust") else None,
        "failures": failure_tables(verdicts),
    }


def accuracy_table(results: JsonObject) -> Table:
    """Accuracy by split and by task family, the confusion of outcomes, and unreadable answers of the judge."""
    found_groups = {group for values in results.values() for group in values if "/" not in group}
    groups = sorted(found_groups, key=lambda g: (g != ALL, g not in SPLIT_LABELS, g))
    headings = ["Videos of", *[words(SPLIT_LABELS.get(g, g)).capitalize() for g in groups]]
    headings += ["Successes judged a success", "Failures judged a failure", "Unreadable answers"]
    rows: list[list[object]] = []
    for m in in_order(results):
        cells = [interval(results[m.name].get(g, {}).get("accuracy")) for g in groups]
        total = results[m.name].get(ALL, {})
        counts = total.get("confusion") or {}
        for right, wrong in (("true_success", "false_failure"), ("true_failure", "false_success")):
            cells.append(Markup(f"{counts[right]} of {counts[right] + counts[wrong]}") if counts else None)  # noqa: S704
        rows.append([m.long_label, *cells, f"{total.get('malformed_answers', 0)} of {total.get('answers', 0)}"])
    caption = "Accuracy by split and by task family, 95 % interval"
    return Table(headings, rows, range(1, len(headings)), caption, dense=True)


def failure_tables(verdicts: Sequence[JsonObject]) -> list[Table]:
    """For every method, what went wrong in its videos (columns) beside what went wrong in the recorded ones (rows)."""
    recorded = {row["episode_id"]: _failure(row) for row in verdicts if row["method"] == TRUE_METHOD}
    counts: dict[str, Counter[tuple[str, str]]] = defaultdict(Counter)
    for row in verdicts:
        if row["method"] != TRUE_METHOD and row["episode_id"] in recorded:
            counts[row["method"]][recorded[row["episode_id"]], _failure(row)] += 1
    tables = []
    for m in predicting(counts):
        found = counts[m.name]
        order = sorted({kind for pair in found for kind in pair}, key=lambda kind: (kind != "success", kind))
        rows = [[kind, *[found[kind, other] for other in order]] for kind in order]
        caption = f"What is seen in videos of {m.long_label}"
        tables.append(Table(["Recorded video", *order], rows, range(1, len(order) + 1), caption, dense=True))
    return tables


def _failure(row: JsonObject) -> str:
    """``success``, or what went wrong by the last evidence that was stated."""
    if row["predicted"] == "success":
        return "success"
    stated = [s for s in json.loads(row["evidence"]) if s["pass"] in ("first_pass", "verification")]
    return failure_kind(row["evidence_family"], stated[-1])


def policy_ranking(policies: JsonObject) -> dict[str, object]:
    """Recorded against predicted success rates of policies: the figure, their agreement, and every policy's rates."""
    methods = in_order(policies)
    rates = {m.name: policies[m.name][ALL]["policies"] for m in methods}
    points = [
        Series(
            m.long_label, [p["recorded"] for p in rates[m.name].values()],
            [p["predicted"] for p in rates[m.name].values()], colour=m.colour, scatter=True, names=list(rates[m.name]),
        )
        for m in methods if m.kind in MODELS
    ]  # fmt: skip
    chart = line_chart(
        [*points, Series("equal", [0.0, 1.0], [0.0, 1.0], colour="c5", dashed=True)],
        title="Success rate of every policy", x_label="as recorded", y_label="as predicted", y_range=(0.0, 1.02),
        x_ticks=[0.0, 0.25, 0.5, 0.75, 1.0],
    )  # fmt: skip

    def shown(found: JsonObject) -> str | None:
        bounds = found["over_starts_and_policies"]
        value = share(found["value"])
        return value if value is None or bounds is None else f"{value} ({number(bounds[0])} to {number(bounds[1])})"

    rows = [
        [m.long_label, words(task), *[shown(found[name]) for name in ("pearson", "spearman", "mmrv", "rate_error")]]
        for m in methods
        for task, found in policies[m.name].items()
    ]
    agreement = Table(
        ["Videos of", "Task", "Pearson r", "Spearman rho", "MMRV", "Error of rates"], rows, range(2, 6),
        "Agreement over policies, 95 % interval over starts and policies", dense=True,
    )  # fmt: skip
    recorded = rates[methods[0].name]
    listed = [
        [name, recorded[name]["attempts"], share(recorded[name]["recorded"])]
        + [share(rates[m.name].get(name, {}).get("predicted")) for m in methods]
        for name in sorted(recorded, key=lambda name: -recorded[name]["recorded"])
    ]
    headings = ["Policy", "Attempts", "Recorded", *[m.long_label for m in methods]]
    table = Table(headings, listed, range(1, len(headings)), "Success rates by policy", dense=True)
    return {"chart": chart, "agreement": agreement, "table": table}


def trust_view(trust: JsonObject) -> dict[str, object]:
    """Reliability of trust, its detection of errors, and the marks."""
    methods = trust["methods"]
    known = [m for m in predicting(methods) if methods[m.name]["available"]]
    bins = {m.name: methods[m.name]["reliability"] for m in known}
    lines = [
        Series(m.long_label, [b["trust"] for b in bins[m.name]], [b["value"] for b in bins[m.name]],
               [b["low"] for b in bins[m.name]], [b["high"] for b in bins[m.name]], m.colour, markers=True)
        for m in known
    ]  # fmt: skip
    lowest = min((x for line in lines for x in line.x), default=0.0)
    chart = line_chart(
        [*lines, Series("calibrated", [lowest, 1.0], [lowest, 1.0], colour="c5", dashed=True)],
        title="Are verdicts right as often as they say?", x_label="stated probability of a right verdict",
        y_label="share of right verdicts, 95 % interval", in_percent=True,
    )  # fmt: skip

    def measured(found: JsonObject) -> object:
        if found["value"] is None:
            return None
        low, high = found["low"], found["high"]
        return with_note(number(found["value"]), "" if low is None else f"[{number(low)}, {number(high)}]")

    figures = ("auroc", "calibration_error", "error", "error_of_marked", "error_of_others")
    rows: list[list[object]] = [
        [m.long_label, methods[m.name]["verdicts"], methods[m.name]["marked"]]
        + [measured(methods[m.name][name]) for name in figures]
        for m in known
    ]
    headings = [
        "Verdicts on videos of", "Verdicts", "Marked", "AUROC", "Calibration error", "Wrong", "Wrong among marked",
        "Wrong among others",
    ]  # fmt: skip
    caption = "Detection of wrong verdicts by trust (AUROC, 0.5 is chance) and by the marks, 95 % interval over starts"
    return {
        "recordings": trust["training_recordings"],
        "within": percent(1.0 - trust["settings"]["novelty_level"]),
        "least": percent(trust["settings"]["least_trust"]),
        "unavailable": [(m.long_label, methods[m.name]["reason"]) for m in predicting(methods) if m not in known],
        "chart": chart if known else None,
        "table": Table(headings, rows, range(1, len(headings)), caption, dense=True) if known else None,
    }


def planning_evaluation(summary: JsonObject) -> dict[str, object]:
    """Values of one planning evaluation for the template."""
    methods = summary["methods"]
    budgets = sorted({int(n) for values in methods.values() for n in values["budgets"]})
    families = sorted({bank["task_family"] for bank in summary["banks"].values()})
    x = [float(n) for n in budgets]
    series = [Series("direct execution", x, [summary["direct_execution"]["mean"]] * len(x), colour="c5", dashed=True)]
    rows: list[list[object]] = []
    for m in in_order(methods):
        by_budget = methods[m.name]["budgets"]
        found = {int(n): by_budget[n]["success"] for n in sorted(by_budget, key=int)}
        bounds = [[found[n][key] for n in found] for key in ("mean", "low", "high")]
        if m.kind not in MODELS:
            bounds = bounds[:1]
        series.append(Series(m.long_label, [*found], *bounds, colour=m.colour, dashed=m.group == "run", markers=True))
        by_family = [methods[m.name]["by_family"].get(family, {}) for family in families]
        rows.append([
            m.long_label,
            *[share(found.get(n, {}).get("mean")) for n in budgets],
            interval(most_candidates(methods[m.name])["gain"], signed=True),
            *[share(values[max(values, key=int)]["success"]) if values else None for values in by_family],
        ])  # fmt: skip
    chart = line_chart(
        series, title="Success of the chosen candidate, 95 % interval over banks", x_label="candidates N", y_label="success",
        log_x=True, x_ticks=x, in_percent=True, y_range=(0.0, 1.02),
    )  # fmt: skip
    most = f"N = {budgets[-1]}"
    headings = ["Chosen by videos of", *[f"N = {n}" for n in budgets], f"Gain at {most}"]
    headings += [f"{words(family)}, {most}" for family in families]
    caption = (
        "Success of the choice by number of candidates and by task, and gain over direct execution of the same banks"
    )
    return {
        "banks": len(summary["banks"]),
        "selector": summary.get("selector", "unknown"),
        "direct": summary["direct_execution"],
        "oracle": summary.get("oracle"),
        "chart": chart,
        "table": Table(headings, rows, range(1, len(headings)), caption, dense=True),
    }


def most_candidates(values: JsonObject) -> JsonObject:
    """A method's result among the most candidates."""
    return values["budgets"][max(values["budgets"], key=int)]


def share(value: float | None) -> str | None:
    """A share with two digits; None stays None."""
    return None if value is None else number(float(value))
