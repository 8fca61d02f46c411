"""Pages of the evaluations: "Video quality", and "Policy and planning"."""

from __future__ import annotations

from collections.abc import Callable
from statistics import median

from markupsafe import Markup

from worldline_core.evaluation.metric_registry import METRICS, ON_REQUEST, metric_of
from worldline_core.evaluation.scores import TRUE_METHOD
from worldline_core.pages.charts import Dot, Series, interval_chart, line_chart
from worldline_core.pages.page import Table, interval, number, percent, words
from worldline_core.report.context import (
    SPLIT_LABELS,
    Method,
    ReportContext,
    Section,
    VideoScores,
    in_order,
    method,
    predicting,
    share_interval,
)
from worldline_core.store.artifact_files import JsonObject, read_json

ALL = "all"
EDGE_BLOCKS = 5
MODELS = (TRUE_METHOD, "stage2", "causal", "other")
"""Kinds of methods with the true controls."""
QUALITY = (
    "Mean over time for each trajectory, then over trajectories, with 95\u202f% bootstrap intervals over trajectories. Robot IoU,"
    " exact: a segmenter's mask of the prediction against the recording's exact mask. Robot IoU, segmenter: the same segmenter"
    " masks the true and the predicted video independently of each other."
)


def method_table(
    heading: str,
    methods: list[Method],
    columns: dict[str, Callable[[Method], object]],
    caption: str = "",
) -> Table:
    """Methods in rows, a value of each in every column; ``{"mean", "low", "high"}`` is shown as a value with its interval."""

    def shown(value: object) -> object:
        return interval(value) if isinstance(value, dict) else number(value) if isinstance(value, float) else value

    rows = [[m.long_label, *(shown(value_of(m)) for value_of in columns.values())] for m in methods]
    return Table([heading, *columns], rows, range(1, len(columns) + 1), caption, dense=True)


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
                    t for view in ("head", "left_wrist", "right_wrist") for t in metric_tables(scores, group, view)
                ],
                "charts": quality_charts(scores, group),
            }
            for group in scores.groups
        ],
        cost=cost(context),
    )


def instrument_accuracy(scores: VideoScores, segmenter: JsonObject) -> list[tuple[str, Markup | None]]:
    """IoU of a segmenter's masks of true frames with the exact ones, by group."""
    known, metric = segmenter.get("accuracy_on_true_frames", {}), f"robot_iou_exact{segmenter.get('suffix', '')}@head"
    measured = [(group, known.get(group, {}).get(metric)) for group in scores.groups]
    return [(SPLIT_LABELS.get(group, group), interval(value, 3)) for group, value in measured if value is not None]


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
        tables.append(Table(headings, rows, range(1, len(headings)), caption, dense=True))
    return tables


def quality_charts(scores: VideoScores, group: str) -> list[Markup]:
    """Robot IoU and SSIM of the head view: the main method beside every other, and the drift of predictions along time."""
    primary = scores.primary(group)
    if primary is None:
        return []
    differences, drifts = list[Markup](), list[Markup]()
    for metric in (scores.iou_metric(group, primary.name), "ssim"):
        label = METRICS[metric].title if metric else ""
        dots, series = list[Dot](), list[Series]()
        for m in scores.methods(group):
            if found := scores.difference(group, primary.name, m.name, f"{metric}@head"):
                dots.append(Dot(m.long_label, found["mean"], found["low"], found["high"], m.colour))
            if rows := scores.along_time(group, m.name, f"{metric}"):
                series.append(Series(m.long_label, *zip(*rows, strict=True), colour=m.colour, dashed=m.group == "run"))
        if dots:
            title = f"{primary.long_label} minus each other: {label}"
            value_label = f"paired difference, 95 % interval; right of zero, {primary.label} is better"
            differences.append(interval_chart(dots, title=title, value_label=value_label, zero_line=True, signed=True))
        if series:
            title = f"{label} along the prediction"
            drifts.append(line_chart(series, title=title, x_label="frame (0 is given)", y_label=label))
    return differences + drifts


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
        blocks = block_costs(content)
        times = (None, None) if blocks is None else (number(1000 * blocks[0], 0), number(blocks[1], 2))
        label = method(name).long_label + (", candidate banks" if name.startswith("banks_") else "")
        settings = [content.get(key) for key in ("steps", "dtype", "batch_size")]
        rows.append([label, *settings, number(1000 * float(content["seconds_per_frame"]), 1), *times])
        devices.add(str(content.get("device_name") or "unknown device"))
    headings = "Method", "Steps", "Precision", "Batch", "ms per frame", "ms per block", "Last to first block"
    caption = (
        f"Wall time of predicting and decoding on {'; '.join(sorted(devices))}. A frame is one instant in all views. Steps: of a whole"
        f" clip, or of a block for causal models. Last to first block: medians of {EDGE_BLOCKS} blocks each, sampling alone."
    )
    table = Table(headings, rows, range(1, len(headings)), caption).__html__()
    return context.slot("cost", table, "Recorded when the report was made; see run/run.js.") if rows else None


# Policy and planning


def decisions_section(context: ReportContext) -> Section:
    """Policy evaluations, then planning evaluations."""
    judged = [policy_evaluation(summary) for summary in context.summaries("evaluate_policy")]
    planned = [planning_evaluation(summary) for summary in context.summaries("evaluate_planning")]
    title = "Policy and planning"
    if not judged and not planned:
        return Section("decisions", title, missing="inputs evaluate_policy and evaluate_planning.")
    return context.section("decisions", title, judged=judged, planned=planned)


def policy_evaluation(summary: JsonObject) -> dict[str, object]:
    """Values of one policy evaluation for the template."""
    results = summary["methods"]
    dots = [
        Dot(m.long_label, found["mean"], found["low"], found["high"], m.colour)
        for m in in_order(results)
        if (found := share_interval(results[m.name].get(ALL, {}).get("accuracy")))
    ]
    title = f"Accuracy over {summary.get('trajectories', '?')} trajectories (judge: {summary.get('judge', 'unknown')})"
    value_label = "agreement with the recorded outcome, 95 % interval"
    return {
        "chart": interval_chart(dots, digits=2, value_label=value_label, title=title) if dots else None,
        "short": sorted((summary.get("shorter_than_recording") or {}).items()),
        "groups": accuracy_table(results) if dots else None,
        "ranking": policy_ranking(summary["policies"]) if summary.get("policies") else None,
        "trust": trust_view(summary["trust"]) if summary.get("trust") else None,
    }


def accuracy_table(results: JsonObject) -> Table:
    """Accuracy by split and by task family, the confusion of outcomes, and unreadable answers of the judge."""
    found_groups = {group for values in results.values() for group in values if "/" not in group}
    groups = sorted(found_groups, key=lambda g: (g != ALL, g not in SPLIT_LABELS, g))

    def judged(right: str, wrong: str) -> Callable[[Method], str | None]:
        def counted(m: Method) -> str | None:
            counts = results[m.name].get(ALL, {}).get("confusion")
            return f"{counts[right]} of {counts[right] + counts[wrong]}" if counts else None

        return counted

    columns: dict[str, Callable[[Method], object]] = {
        words(SPLIT_LABELS.get(g, g)).capitalize(): lambda m, g=g: share_interval(
            results[m.name].get(g, {}).get("accuracy")
        )
        for g in groups
    }
    columns["Successes judged a success"] = judged("true_success", "false_failure")
    columns["Failures judged a failure"] = judged("true_failure", "false_success")
    columns["Unreadable answers"] = lambda m: results[m.name].get(ALL, {}).get("malformed_answers", 0)
    return method_table("Videos of", in_order(results), columns, "Accuracy by split and by task family, 95 % interval")


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

    def agreement(key: str) -> Callable[[Method], object]:
        def measured(m: Method) -> object:
            found = policies[m.name][ALL][key]
            bounds = found["over_starts_and_policies"]
            return found["value"] if not bounds else {"mean": found["value"], "low": bounds[0], "high": bounds[1]}

        return measured

    measures = {"Pearson r": "pearson", "Spearman rho": "spearman", "MMRV": "mmrv", "Error of rates": "rate_error"}
    caption = "Agreement over policies, 95 % interval over starts and policies"
    recorded = rates[methods[0].name]

    def predicted(policy: str) -> list[float | None]:
        return [rates[m.name].get(policy, {}).get("predicted") for m in methods]

    listed = [
        [name, recorded[name]["attempts"]]
        + [None if rate is None else number(float(rate)) for rate in (recorded[name]["recorded"], *predicted(name))]
        for name in sorted(recorded, key=lambda name: -recorded[name]["recorded"])
    ]
    headings = ["Policy", "Attempts", "Recorded", *[m.long_label for m in methods]]
    return {
        "chart": chart,
        "agreement": method_table("Videos of", methods, {name: agreement(k) for name, k in measures.items()}, caption),
        "table": Table(headings, listed, range(1, len(headings)), "Success rates by policy", dense=True),
    }


def trust_view(trust: JsonObject) -> dict[str, object]:
    """Detection of wrong verdicts by trust and by the marks."""
    methods = trust["methods"]
    known = [m for m in predicting(methods) if methods[m.name]["available"]]

    def measured(key: str) -> Callable[[Method], object]:
        def value_of(m: Method) -> object:
            found = methods[m.name][key]
            return found["value"] if found["low"] is None else {**found, "mean": found["value"]}

        return value_of

    figures = {
        "AUROC": "auroc", "Calibration error": "calibration_error", "Wrong": "error",
        "Wrong among marked": "error_of_marked", "Wrong among others": "error_of_others",
    }  # fmt: skip
    columns: dict[str, Callable[[Method], object]] = {
        "Verdicts": lambda m: methods[m.name]["verdicts"],
        "Marked": lambda m: methods[m.name]["marked"],
        **{heading: measured(key) for heading, key in figures.items()},
    }
    caption = "Detection of wrong verdicts by trust (AUROC, 0.5 is chance) and by the marks, 95 % interval over starts"
    return {
        "recordings": trust["training_recordings"],
        "within": percent(1.0 - trust["settings"]["novelty_level"]),
        "least": percent(trust["settings"]["least_trust"]),
        "unavailable": [(m.long_label, methods[m.name]["reason"]) for m in predicting(methods) if m not in known],
        "table": method_table("Verdicts on videos of", known, columns, caption) if known else None,
    }


def planning_evaluation(summary: JsonObject) -> dict[str, object]:
    """Values of one planning evaluation for the template."""
    methods = summary["methods"]
    budgets = sorted({int(n) for values in methods.values() for n in values["budgets"]})
    families = sorted({bank["task_family"] for bank in summary["banks"].values()})
    x = [float(n) for n in budgets]

    def success(m: Method, n: int) -> JsonObject | None:
        found = methods[m.name]["budgets"].get(str(n))
        return found and share_interval({"count": len(summary["banks"]), **found["success"]})

    series = [Series("direct execution", x, [summary["direct_execution"]["mean"]] * len(x), colour="c5", dashed=True)]
    for m in in_order(methods):
        found = {n: value for n in budgets if (value := success(m, n))}
        bounds = ("mean", "low", "high") if m.kind in MODELS else ("mean",)
        values = [[value[key] for value in found.values()] for key in bounds]
        series.append(Series(m.long_label, [*found], *values, colour=m.colour, dashed=m.group == "run", markers=True))
    chart = line_chart(
        series, title="Success of the chosen candidate, 95 % interval over banks", x_label="candidates N", y_label="success",
        log_x=True, x_ticks=x, in_percent=True, y_range=(0.0, 1.02),
    )  # fmt: skip

    def by_family(m: Method, family: str) -> float | None:
        values = methods[m.name]["by_family"].get(family)
        return float(values[max(values, key=int)]["success"]) if values else None

    most = f"N = {budgets[-1]}"
    columns: dict[str, Callable[[Method], object]] = {
        **{f"N = {n}": lambda m, n=n: (success(m, n) or {}).get("mean") for n in budgets[:-1]},
        most: lambda m: success(m, budgets[-1]),
        f"Gain at {most}": lambda m: interval(most_candidates(methods[m.name])["gain"], signed=True),
        **{f"{words(family)}, {most}": lambda m, family=family: by_family(m, family) for family in families},
    }
    caption = f"Success of the choice over {len(summary['banks'])} banks by number of candidates and by task, and gain over direct execution"
    return {
        "banks": len(summary["banks"]),
        "selector": summary.get("selector", "unknown"),
        "direct": summary["direct_execution"],
        "oracle": summary.get("oracle"),
        "chart": chart,
        "table": method_table("Chosen by videos of", in_order(methods), columns, caption),
    }


def most_candidates(values: JsonObject) -> JsonObject:
    """A method's result among the most candidates."""
    return values["budgets"][max(values["budgets"], key=int)]
