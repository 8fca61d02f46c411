"""Page "Policy and planning": verdicts and choices made from predicted videos, held against what was recorded."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Sequence

from worldline_core.evaluation.policy.evidence import failure_kind
from worldline_core.evaluation.scores import TRUE_METHOD
from worldline_core.pages.charts import Dot, Series, interval_chart, line_chart
from worldline_core.pages.page import Table, interval, number, percent, with_note, words
from worldline_core.report.context import SPLIT_LABELS, ReportContext, Section, in_order, predicting
from worldline_core.store.artifact_files import JsonObject, read_json, read_rows

TITLE = "Policy and planning"
ALL = "all"


def decisions_section(context: ReportContext) -> Section:
    """Policy evaluations, then planning evaluations."""
    judged = [
        policy_evaluation(summary, read_rows(folder / "decisions.parquet"))
        for folder in context.variants("evaluate_policy").values()
        if (summary := read_json(folder / "summary.json")).get("methods")
    ]
    planned = [planning_evaluation(summary) for summary in context.summaries("evaluate_planning")]
    if not judged and not planned:
        return Section("decisions", TITLE, missing="inputs evaluate_policy and evaluate_planning.")
    return context.section("decisions", TITLE, judged=judged, planned=planned)


def policy_evaluation(summary: JsonObject, verdicts: Sequence[JsonObject] = ()) -> dict[str, object]:
    """Values of one policy evaluation for the template; ``verdicts`` are the rows of its decisions.parquet."""
    results = summary["methods"]
    methods = in_order(results)
    dots = [
        Dot(m.long_label, found["mean"], found["low"], found["high"], m.colour)
        for m in methods
        if (found := results[m.name].get(ALL, {}).get("accuracy"))
    ]
    chart = interval_chart(
        dots, digits=2, value_label="agreement with the recorded outcome, 95 % interval",
        title=f"Accuracy over {summary.get('trajectories', '?')} trajectories (judge: {summary.get('judge', 'unknown')})",
    ) if dots else None  # fmt: skip
    shown = [m for m in methods if m.kind in (TRUE_METHOD, "stage2", "causal")]
    return {
        "chart": chart,
        "confusions": [(m.long_label, rows) for m in shown if (rows := confusion(results[m.name]))],
        "short": sorted((summary.get("shorter_than_recording") or {}).items()),
        "groups": accuracy_table(results) if dots else None,
        "ranking": policy_ranking(summary["policies"]) if summary.get("policies") else None,
        "trust": trust_view(summary["trust"]) if summary.get("trust") else None,
        "failures": failure_tables(verdicts),
    }


def confusion(groups: JsonObject) -> list[tuple[str, list[tuple[int, float]]]]:
    """(recorded outcome, (count, share of the row) of those judged a success and of those judged a failure)."""
    counts = groups.get(ALL, {}).get("confusion")
    if not counts:
        return []
    rows = {
        "success": (counts["true_success"], counts["false_failure"]),
        "failure": (counts["false_success"], counts["true_failure"]),
    }
    return [(name, [(count, count / (sum(row) or 1)) for count in row]) for name, row in rows.items()]


def accuracy_table(results: JsonObject) -> Table:
    """Accuracy by split and by task family, and unreadable answers of the judge."""
    found_groups = {group for values in results.values() for group in values if "/" not in group}
    groups = sorted(found_groups, key=lambda g: (g != ALL, g not in SPLIT_LABELS, g))
    headings = ["Videos of", *[words(SPLIT_LABELS.get(g, g)).capitalize() for g in groups], "Unreadable answers"]
    rows: list[list[object]] = []
    for m in in_order(results):
        cells = [interval(results[m.name].get(g, {}).get("accuracy")) for g in groups]
        total = results[m.name].get(ALL, {})
        unreadable = f"{total.get('malformed_answers', 0)} of {total.get('answers', 0)}"
        rows.append([m.long_label, *cells, unreadable])
    return Table(
        headings, rows, range(1, len(headings)), "Accuracy by split and by task family, 95 % interval", dense=True
    )


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
        for m in methods if m.kind in (TRUE_METHOD, "stage2", "causal", "other")
    ]  # fmt: skip
    chart = line_chart(
        [*points, Series("equal", [0.0, 1.0], [0.0, 1.0], colour="c5", dashed=True)],
        title="Success rate of every policy", x_label="as recorded", y_label="as predicted", y_range=(0.0, 1.02),
        x_ticks=[0.0, 0.25, 0.5, 0.75, 1.0],
    )  # fmt: skip

    def shown(found: JsonObject) -> str | None:
        if found["value"] is None:
            return None
        bounds = found["over_starts_and_policies"]
        return number(found["value"]) + ("" if bounds is None else f" ({number(bounds[0])} to {number(bounds[1])})")

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
        + [share(rates[m.name][name]["predicted"]) if name in rates[m.name] else None for m in methods]
        for name in sorted(recorded, key=lambda name: -recorded[name]["recorded"])
    ]
    headings = ["Policy", "Attempts", "Recorded", *[m.long_label for m in methods]]
    table = Table(headings, listed, range(1, len(headings)), "Success rates by policy", dense=True)
    return {"chart": chart, "agreement": agreement, "table": table}


def trust_view(trust: JsonObject) -> dict[str, object]:
    """Reliability of trust, its detection of errors, and the marks."""
    methods = trust["methods"]
    known = [m for m in predicting(methods) if methods[m.name]["available"]]
    lines = [
        Series(
            m.long_label, *[[b[key] for b in methods[m.name]["reliability"]] for key in ("trust", "value", "low", "high")],
            colour=m.colour, markers=True,
        )
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

    rows: list[list[object]] = []
    for m in known:
        found = methods[m.name]
        figures = ("auroc", "calibration_error", "error", "error_of_marked", "error_of_others")
        rows.append([m.long_label, found["verdicts"], found["marked"], *[measured(found[name]) for name in figures]])
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
    methods = in_order(summary["methods"])
    budgets = sorted({int(n) for values in summary["methods"].values() for n in values["budgets"]})
    x = [float(n) for n in budgets]
    direct = Series("direct execution", x, [summary["direct_execution"]["mean"]] * len(x), colour="c5", dashed=True)
    axes = {"x_label": "candidates N", "log_x": True, "x_ticks": x, "in_percent": True}
    success = line_chart(
        [*_curves(summary, "success", band=False), direct],
        title="Success of the chosen candidate", y_label="success", y_range=(0.0, 1.02), **axes,
    )  # fmt: skip
    gain = line_chart(
        _curves(summary, "gain", band=True), title="Gain over direct execution, 95 % interval over banks",
        y_label="gain", **axes,
    )  # fmt: skip
    rows: list[list[object]] = []
    for m in methods:
        by_budget = summary["methods"][m.name]["budgets"]
        most = most_candidates(summary["methods"][m.name])
        cells = [share(by_budget.get(str(n), {}).get("success", {}).get("mean")) for n in budgets]
        rows.append([m.long_label, *cells, interval(most["gain"], signed=True)])
    headings = ["Chosen by videos of", *[f"N = {n}" for n in budgets], f"Gain at N = {budgets[-1]}"]
    caption = "Success of the choice by number of candidates, and gain over direct execution of the same banks"
    return {
        "banks": len(summary["banks"]),
        "selector": summary.get("selector", "unknown"),
        "direct": summary["direct_execution"],
        "oracle": summary.get("oracle"),
        "charts": [success, gain],
        "budgets": Table(headings, rows, range(1, len(headings)), caption),
        "families": family_table(summary),
    }


def most_candidates(values: JsonObject) -> JsonObject:
    """A method's result among the most candidates."""
    return values["budgets"][max(values["budgets"], key=int)]


def _curves(summary: JsonObject, key: str, *, band: bool) -> list[Series]:
    """Success or gain of every method by number of candidates; with a band, of the models with the true controls."""
    series = []
    for m in in_order(summary["methods"]):
        if band and m.kind not in (TRUE_METHOD, "stage2", "causal", "other"):
            continue
        found = sorted((int(n), values[key]) for n, values in summary["methods"][m.name]["budgets"].items())
        mean, low, high = ([values[bound] for _, values in found] for bound in ("mean", "low", "high"))
        bounds = (low, high) if band else (None, None)
        x = [float(n) for n, _ in found]
        series.append(Series(m.long_label, x, mean, *bounds, m.colour, dashed=m.group == "run", markers=True))
    return series


def family_table(summary: JsonObject) -> Table:
    """Success among the most candidates by task family, beside direct execution."""
    methods = in_order(summary["methods"])
    direct: dict[str, list[float]] = defaultdict(list)
    for bank in summary["banks"].values():
        direct[bank["task_family"]].append(float(bank["direct_success"]))
    rows: list[list[object]] = []
    for family, values in sorted(direct.items()):
        found = [summary["methods"][m.name]["by_family"].get(family) for m in methods]
        cells = [share(by_budget[max(by_budget, key=int)]["success"]) if by_budget else None for by_budget in found]
        rows.append([words(family), len(values), share(sum(values) / len(values)), *cells])
    headings = ["Task", "Banks", "Direct", *[m.long_label for m in methods]]
    return Table(headings, rows, range(1, len(headings)), "Success of the choice among the most candidates, by task")


def share(value: float | None) -> str | None:
    """A share with two digits; None stays None."""
    return None if value is None else number(float(value))
