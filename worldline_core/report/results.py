"""Pages of the evaluations: "Video quality", and "Policy and planning"."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import median

from markupsafe import Markup

from worldline_core.evaluation.metric_registry import METRICS, ON_REQUEST, metric_of
from worldline_core.evaluation.paired import EVALUATIONS, collect_metrics
from worldline_core.evaluation.scores import TRUE_METHOD
from worldline_core.model.model_card import Measurement
from worldline_core.pages.charts import Dot, Series, interval_chart, line_chart
from worldline_core.pages.page import Table, interval, render, words
from worldline_core.report.context import (
    SPLIT_LABELS,
    ReportContext,
    Section,
    VideoScores,
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
            if rows := scores.along_time(group, m.name, metric.name):
                series.append(Series(m.long_label, *zip(*rows, strict=True), colour=m.colour, dashed=m.group == "run"))
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
    """Policy evaluations, then planning evaluations."""
    judged = [policy_evaluation(summary) for summary in context.summaries("evaluate_policy")]
    planned = [planning_evaluation(summary) for summary in context.summaries("evaluate_planning")]
    title = "Policy and planning"
    if not judged and not planned:
        return Section("decisions", title, missing="inputs evaluate_policy and evaluate_planning.")
    return context.section("decisions", title, judged=judged, planned=planned)


def policy_evaluation(summary: JsonObject) -> dict[str, object]:
    """Values of one policy evaluation for the template."""
    results, methods = summary["methods"], in_order(summary["methods"])
    accuracy = {
        m.name: {
            group: share_interval(found["accuracy"]) for group, found in results[m.name].items() if "/" not in group
        }
        for m in methods
    }
    found_groups = {group for own in accuracy.values() for group in own}
    groups = sorted(found_groups, key=lambda g: (g != ALL, g not in SPLIT_LABELS, g))
    dots = [
        Dot(m.long_label, found["mean"], found["low"], found["high"], m.colour)
        for m in methods if (found := accuracy[m.name].get(ALL))
    ]  # fmt: skip
    title = f"Accuracy over {summary.get('trajectories', '?')} trajectories (judge: {summary.get('judge', 'unknown')})"
    value_label = "agreement with the recorded outcome, 95 % interval"
    trust = summary.get("trust")
    return {
        "methods": methods,
        "results": results,
        "accuracy": accuracy,
        "groups": groups,
        "labels": [words(SPLIT_LABELS.get(group, group)).capitalize() for group in groups],
        "chart": interval_chart(dots, digits=2, value_label=value_label, title=title) if dots else None,
        "short": sorted((summary.get("shorter_than_recording") or {}).items()),
        "ranking": policy_ranking(summary["policies"]) if summary.get("policies") else None,
        "trust": trust
        and {**trust, "known": [m for m in predicting(trust["methods"]) if trust["methods"][m.name]["available"]]},
        "unjudged": [m for m in predicting(trust["methods"]) if not trust["methods"][m.name]["available"]]
        if trust
        else [],
    }


def policy_ranking(policies: JsonObject) -> JsonObject:
    """Agreement of recorded and predicted success rates of policies, and every policy's rates."""
    methods = in_order(policies)
    rates = {m.name: policies[m.name][ALL]["policies"] for m in methods}
    names = sorted(rates[methods[0].name], key=lambda name: -rates[methods[0].name][name]["recorded"])
    return {
        "methods": methods,
        "rates": rates,
        "names": names,
        "agreement": {m.name: policies[m.name][ALL] for m in methods},
    }


def planning_evaluation(summary: JsonObject) -> dict[str, object]:
    """Values of one planning evaluation for the template."""
    methods, order = summary["methods"], in_order(summary["methods"])
    budgets = sorted({int(n) for values in methods.values() for n in values["budgets"]})
    cases, x = {"count": len(summary["banks"])}, [float(n) for n in budgets]
    success = {
        m.name: {
            n: share_interval({**cases, **methods[m.name]["budgets"][str(n)]["success"]})
            for n in budgets if str(n) in methods[m.name]["budgets"]
        }
        for m in order
    }  # fmt: skip
    series = [Series("direct execution", x, [summary["direct_execution"]["mean"]] * len(x), colour="c5", dashed=True)]
    for m in order:
        mean, low, high = (
            [float((value or {})[key]) for value in success[m.name].values()] for key in ("mean", "low", "high")
        )
        bounds = (low, high) if m.kind in MODELS else (None, None)
        series.append(
            Series(m.long_label, [*success[m.name]], mean, *bounds, m.colour, dashed=m.group == "run", markers=True)
        )
    chart = line_chart(
        series, title="Success of the chosen candidate, 95 % interval over banks", x_label="candidates N", y_label="success",
        log_x=True, x_ticks=x, in_percent=True, y_range=(0.0, 1.02),
    )  # fmt: skip
    families = sorted({bank["task_family"] for bank in summary["banks"].values()})
    most = f"N = {budgets[-1]}"
    headings = (
        [f"N = {n}" for n in budgets]
        + [f"Gain at {most}", "over the best shortcut"]
        + [f"{words(family)}, {most}" for family in families]
    )
    return {
        "summary": summary,
        "methods": order,
        "success": success,
        "gain": {m.name: most_candidates(methods[m.name])["gain"] for m in order},
        "over_shortcut": {m.name: most_candidates(methods[m.name])["over_shortcut"]["gain"] for m in order},
        "families": families,
        "by_family": {
            m.name: {f: v[max(v, key=int)] for f, v in methods[m.name]["by_family"].items() if v} for m in order
        },
        "budgets": budgets,
        "headings": headings,
        "chart": chart,
    }


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
        key = f"{manifest.get('step')}/{manifest.get('key')}"
        values = collect_metrics({str(manifest.get("step")): folder})
        most = max((int(name.split("/")[1][2:]) for name in values if name.startswith("planning/")), default=0)
        for name, value in values.items():
            what, group, videos, metric = name.split("/", 3)
            metric, _, view = metric.partition("@")
            if what == "video" and (metric not in VIDEO_METRICS or view != "head"):
                continue
            if group not in SPLIT_LABELS and group not in ("all", f"N={most}"):
                continue
            rollout = linked_folder(folder, f"rollouts.{videos}")
            made_by = {} if rollout is None else read_manifest(rollout).get("inputs", {}).get("checkpoint", {})
            shown = method(videos)
            if made_by.get("digest") != digest or digest is None or shown.kind.endswith(("_zero", "_shuffled")):
                continue
            label = {"accuracy": "outcomes judged rightly", "success": f"plans that succeed, best of {most}"}.get(
                metric
            )
            label = label or f"{METRICS[metric].title}, head view"
            label += f", {shown.label}" if "steps" in videos else ""
            recordings = {"all": "all splits", f"N={most}": "candidate banks"}.get(group) or SPLIT_LABELS[group]
            bounds = {"mean": value.mean, "low": value.low, "high": value.high, "count": value.count}
            bounds = bounds if what == "video" else share_interval(bounds) or bounds
            found[label, recordings] = Measurement(label, recordings, **bounds, source=key)
    return [found[name] for name in sorted(found)]
