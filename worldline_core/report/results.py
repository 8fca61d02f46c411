"""Pages of the evaluations: "Video quality", and "Policy and planning"."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import median

from markupsafe import Markup

from worldline_core.data.episodes.episode import VIEWS
from worldline_core.evaluation.metric_registry import METRICS, ON_REQUEST, metric_of
from worldline_core.evaluation.paired import EVALUATIONS
from worldline_core.evaluation.scores import TRUE_METHOD
from worldline_core.model.model_card import Measurement
from worldline_core.pages.charts import Dot, Series, interval_chart, line_chart
from worldline_core.pages.page import Table, interval, render, words
from worldline_core.report.context import (
    SPLIT_LABELS,
    ReportContext,
    Section,
    VideoScores,
    headline_metrics,
    in_order,
    method,
    predicting,
    share_interval,
)
from worldline_core.store.artifact_files import (
    JsonObject,
    finished_artifacts,
    linked_folder,
    read_json,
    read_manifest,
    verify_artifact,
)

ALL = "all"
EDGE_BLOCKS = 5
MODELS = (TRUE_METHOD, "stage2", "causal", "other")
"""Kinds of methods with the true controls."""
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
    names = {name for group in scores.groups for found in scores.metrics[group].values() for name in found}
    measured = {metric.name for metric in map(metric_of, names) if metric}
    return context.section(
        "quality",
        "Video quality",
        QUALITY,
        instruments=[(s["description"], instrument_accuracy(scores, s)) for s in scores.summary["segmenters"]],
        unavailable=sorted(scores.summary["unavailable"].items()),
        asked=[METRICS[name] for name in ON_REQUEST if name in measured],
        groups=[
            {
                "title": SPLIT_LABELS[group].capitalize(),
                "tables": [table for view in VIEWS for table in metric_tables(scores, group, view)],
                "charts": quality_charts(scores, group),
            }
            for group in scores.groups
        ],
        cost=cost(context),
    )


def instrument_accuracy(scores: VideoScores, segmenter: JsonObject) -> list[tuple[str, Markup | None]]:
    """IoU of a segmenter's masks of true frames with the exact ones, by group."""
    known, metric = segmenter["accuracy_on_true_frames"], f"robot_iou_exact{segmenter['suffix']}@head"
    measured = [(group, known.get(group, {}).get(metric)) for group in scores.groups]
    return [(SPLIT_LABELS[group], interval(value, 3)) for group, value in measured if value is not None]


def metric_tables(scores: VideoScores, group: str, view: str) -> list[Table]:
    """Methods in rows, metrics of one view in columns, up to eight; the best of each column in bold."""
    names = {name.partition("@") for found in scores.metrics[group].values() for name in found if metric_of(name)}
    order = [*METRICS]
    measured = [name for name, _, of_view in names if of_view == view]
    shown = sorted(measured, key=lambda n: ("[" in n, order.index(n.partition("[")[0]), n))
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
    """The headline and SSIM of the head view: the main method beside every other, and the drift of predictions along time."""
    primary = scores.primary(group)
    if primary is None:
        return []
    differences, drifts = list[Markup](), list[Markup]()
    for metric in filter(None, (scores.headline(group, primary.name), METRICS["ssim"])):
        dots, series = list[Dot](), list[Series]()
        for m in scores.methods(group):
            if found := scores.difference(group, primary.name, m.name, f"{metric.name}@head"):
                dots.append(Dot(m.long_label, found["mean"], found["low"], found["high"], m.colour))
            key = m.name, group, "head", metric.name
            rows = [row for row in scores.by_frame if (row["method"], row["split"], row["view"], row["metric"]) == key]
            if points := sorted((row["frame"], row["mean"]) for row in rows):
                series.append(
                    Series(m.long_label, *zip(*points, strict=True), colour=m.colour, dashed=m.group == "run")
                )
        if dots:
            title = f"{primary.long_label} minus each other: {metric.title}"
            side = "left" if metric.lower_is_better else "right"
            value_label = f"paired difference, 95 % interval; {side} of zero, {primary.label} is better"
            differences.append(interval_chart(dots, title=title, value_label=value_label, zero_line=True, signed=True))
        if series:
            title = f"{metric.title} along the prediction"
            drifts.append(line_chart(series, title=title, x_label="frame (0 is given)", y_label=metric.title))
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
    timed = {name: read_json(path / "run" / "speed.json") for name, path in context.variants("rollout").items()}
    timed = {name: content for name, content in timed.items() if content.get("seconds_per_frame") is not None}
    rows = [(method(name), name.startswith("banks_"), content, block_costs(content)) for name, content in timed.items()]
    devices = sorted({str(content.get("device_name") or "unknown device") for content in timed.values()})
    table = render("report/cost.html", rows=rows, devices=devices, edge=EDGE_BLOCKS)
    return context.slot("cost", table, "Recorded when the report was made; see run/run.js.") if rows else None


# Policy and planning


def decisions_section(context: ReportContext) -> Section:
    """The policy evaluation, then the planning evaluation."""
    judged, planned = context.summary("evaluate_policy"), context.summary("evaluate_planning")
    title = "Policy and planning"
    if judged is None and planned is None:
        return Section("decisions", title, missing="inputs evaluate_policy and evaluate_planning.")
    policy, planning = judged and policy_evaluation(judged), planned and planning_evaluation(planned)
    return context.section("decisions", title, policy=policy, planning=planning)


def policy_evaluation(summary: JsonObject) -> dict[str, object]:
    """Values of a policy evaluation for the template."""
    results, methods = summary["methods"], in_order(summary["methods"])
    accuracy = {
        m.name: {
            group: share_interval(found["accuracy"]) for group, found in results[m.name].items() if "/" not in group
        }
        for m in methods
    }
    groups = {group for own in accuracy.values() for group in own}
    means = [(m, accuracy[m.name][ALL]) for m in methods]
    dots = [Dot(m.long_label, found["mean"], found["low"], found["high"], m.colour) for m, found in means]
    title = f"Accuracy over {summary['trajectories']} trajectories (judge: {summary['judge']})"
    value_label = "agreement with the recorded outcome, 95 % interval"
    return {
        "summary": summary,
        "methods": methods,
        "accuracy": accuracy,
        "groups": {
            group: words(SPLIT_LABELS.get(group, group)).capitalize()
            for group in sorted(groups, key=lambda g: (g != ALL, g not in SPLIT_LABELS, g))
        },
        "chart": interval_chart(dots, digits=2, value_label=value_label, title=title),
        "ranked": in_order(summary.get("policies", ())),
        "trusted": predicting(summary.get("trust", {}).get("methods", ())),
    }


def planning_evaluation(summary: JsonObject) -> dict[str, object]:
    """Values of a planning evaluation for the template."""
    methods, order = summary["methods"], in_order(summary["methods"])
    budgets = sorted({int(n) for values in methods.values() for n in values["budgets"]})
    cases, x = {"count": len(summary["banks"])}, [float(n) for n in budgets]
    success = {
        m.name: {
            int(n): share_interval({**cases, **found["success"]}) for n, found in methods[m.name]["budgets"].items()
        }
        for m in order
    }
    series = [Series("direct execution", x, [summary["direct_execution"]["mean"]] * len(x), colour="c5", dashed=True)]
    for m in order:
        points = [(n, found["mean"], found["low"], found["high"]) for n, found in sorted(success[m.name].items())]
        own, mean, low, high = zip(*points, strict=True)
        bounds = (low, high) if m.kind in MODELS else (None, None)
        series.append(Series(m.long_label, own, mean, *bounds, m.colour, dashed=m.group == "run", markers=True))
    chart = line_chart(
        series, title="Success of the chosen candidate, 95 % interval over banks", x_label="candidates N", y_label="success",
        log_x=True, x_ticks=x, shares=True,
    )  # fmt: skip
    families = sorted({bank["task_family"] for bank in summary["banks"].values()})
    most = f"N = {budgets[-1]}"
    return {
        "summary": summary,
        "methods": order,
        "success": success,
        "budgets": budgets,
        "families": families,
        "headings": [
            *(f"N = {n}" for n in budgets), f"Gain at {most}", "over the best shortcut",
            *(f"{words(family)}, {most}" for family in families),
        ],
        "chart": chart,
    }  # fmt: skip


def most_candidates(values: JsonObject) -> JsonObject:
    """A method's result among the most candidates."""
    return values["budgets"][max(values["budgets"], key=int)]


VIDEO_METRICS = ("robot_iou_exact", "robot_iou", "object_iou_exact", "ssim", "psnr", "lpips")


def evaluations_of_store(store: Path) -> list[Path]:
    """Finished evaluations of a store, the oldest first."""
    found = [folder for folder in finished_artifacts(store) if folder.parent.name in EVALUATIONS]
    return sorted(found, key=lambda folder: str(read_manifest(folder).get("finished_at")))


def measurements(model: Path, evaluations: Iterable[Path]) -> Sequence[Measurement]:
    """Headline figures of a model: of the rollouts whose manifest names its digest, with the recorded controls.

    Args:
        evaluations: finished ones; a later one counts where two measured the same.

    Raises:
        ArtifactError: an evaluation is damaged.
    """
    digest, found = read_manifest(model).get("digest"), dict[tuple[str, str], Measurement]()
    for folder in evaluations:
        verify_artifact(folder)
        manifest = read_manifest(folder)
        for what, group, videos, metric, value in headline_metrics(manifest.get("step", ""), folder):
            rollout, shown = linked_folder(folder, f"rollouts.{videos}"), method(videos)
            made_by = {} if rollout is None else read_manifest(rollout).get("inputs", {}).get("checkpoint", {})
            if digest is None or made_by.get("digest") != digest or shown.kind.endswith(("_zero", "_shuffled")):
                continue
            metric, _, view = metric.partition("@")
            if what == "video" and (metric not in VIDEO_METRICS or view != "head"):
                continue
            labels = {"policy": "outcomes judged rightly", "planning": f"plans that succeed, best of {group[2:]}"}
            label = labels.get(what) or f"{METRICS[metric].title}, head view"
            label += f", {shown.label}" if "steps" in videos else ""
            recordings = {"policy": "all splits", **SPLIT_LABELS}.get(
                what if group == ALL else group, "candidate banks"
            )
            bounds = asdict(value) if what == "video" else share_interval(asdict(value))
            source = f"{manifest.get('step')}/{manifest.get('key')}"
            found[label, recordings] = Measurement(label, recordings, **bounds, source=source)
    return [found[name] for name in sorted(found)]
