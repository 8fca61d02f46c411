"""Pages "Policy evaluation" and "Planning": what judges and selectors decide from predicted videos, and how rightly."""

from __future__ import annotations

from collections.abc import Sequence

from worldline_core.pages.charts import Dot, Series, interval_chart, line_chart
from worldline_core.pages.page import Table, interval, number, percent, words
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.verdicts import DECISIONS_FILE, failure_tables, task_confusion, trust_view
from worldline_core.report.video_scores import SPLIT_LABELS, TRUE_METHOD, in_order
from worldline_core.store.artifact_files import JsonObject, read_json, read_rows

ALL = "all"


def policy_section(context: ReportContext) -> Section:
    """Accuracy by method, the judge's own ceiling, and confusions."""
    title = "Policy evaluation"
    found = context.summaries("evaluate_policy")
    if not found:
        return Section("policy", title, missing="no policy evaluation was given (input evaluate_policy).")
    lead = (
        "A judge that sees only a video extracts evidence in the task family's schema; fixed rules decide whether the episode"
        " succeeded. As many successes as failures are judged in every split and family, so guessing is right in half of the"
        " cases. Accuracy is agreement with the recorded outcome; on the recorded videos themselves it is the judge's own ceiling."
    )
    folders = [
        path for path in context.variants("evaluate_policy").values() if read_json(path / "summary.json").get("methods")
    ]
    evaluations = [
        policy_evaluation(summary, read_rows(folder / DECISIONS_FILE))
        for summary, folder in zip(found, folders, strict=True)
    ]
    return context.section("policy", title, lead, evaluations=evaluations)


def policy_evaluation(summary: JsonObject, verdicts: Sequence[JsonObject] = ()) -> dict[str, object]:
    """What the page shows of one evaluation; ``verdicts`` are the rows of its decisions.parquet."""
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
    unknown = [
        [m.long_label, found["count"], interval(found)]
        for m in methods
        if (found := results[m.name].get(ALL, {}).get("predicted_success"))
    ]
    headings = ["Videos of", "Recordings", "Judged a success"]
    confusions = [(m.long_label, rows) for m in shown if (rows := confusion(results[m.name]))]
    short = sorted((summary.get("shorter_than_recording") or {}).items())
    ranking = policy_ranking(summary["policies"]) if summary.get("policies") else None
    groups = group_table(results) if dots else None
    trust = trust_view(summary["trust"]) if summary.get("trust") else None
    return {
        "chart": chart, "confusions": confusions, "short": short, "groups": groups, "ranking": ranking, "trust": trust,
        "tasks": task_confusion(verdicts), "failures": failure_tables(verdicts),
        "unknown": Table(headings, unknown, (1, 2), "Recordings whose outcome is not known", dense=True) if unknown else None,
    }  # fmt: skip


def policy_ranking(policies: JsonObject) -> dict[str, object]:
    """Recorded against predicted success rates of policies: the figure, how they agree, and every policy's rates."""
    methods = in_order(policies)
    rates = {m.name: policies[m.name][ALL]["policies"] for m in methods}
    shown = [m for m in methods if m.kind in (TRUE_METHOD, "stage2", "causal", "other")]
    points = [
        Series(
            m.long_label, [p["recorded"] for p in rates[m.name].values()],
            [p["predicted"] for p in rates[m.name].values()], colour=m.colour, scatter=True, names=list(rates[m.name]),
        )
        for m in shown
    ]  # fmt: skip
    chart = line_chart(
        [*points, Series("equal", [0.0, 1.0], [0.0, 1.0], colour="c5", dashed=True)],
        title="Success rate of every policy", x_label="as recorded", y_label="as predicted", y_range=(0.0, 1.02),
        x_ticks=[0.0, 0.25, 0.5, 0.75, 1.0],
    )  # fmt: skip

    def told(found: JsonObject) -> str | None:
        if found["value"] is None:
            return None
        bounds = found["over_starts_and_policies"]
        return number(found["value"]) + ("" if bounds is None else f" ({number(bounds[0])} to {number(bounds[1])})")

    names = ("pearson", "spearman", "mmrv", "rate_error")
    rows = [
        [m.long_label, words(task), *[told(found[name]) for name in names]]
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


def group_table(results: JsonObject) -> Table:
    """Accuracy by split and by family."""
    found_groups = {group for values in results.values() for group in values if "/" not in group}
    groups = sorted(found_groups, key=lambda g: (g != ALL, g not in SPLIT_LABELS, g))
    headings = ["Videos of", *[words(SPLIT_LABELS.get(g, g)).capitalize() for g in groups]]
    rows = [
        [m.long_label, *[interval(results[m.name].get(g, {}).get("accuracy")) for g in groups]]
        for m in in_order(results)
    ]
    totals = [results[m.name].get(ALL, {}) for m in in_order(results)]
    caption = "Accuracy by split and by task family"
    if any(total.get("malformed_answers") for total in totals):
        headings.append("Unreadable answers")
        for row, total in zip(rows, totals, strict=True):
            row.append(f"{total.get('malformed_answers', 0)} of {total.get('answers', 0)}")
    else:
        caption += ". Every answer of the judge could be read."
    return Table(headings, rows, range(1, len(headings)), caption, dense=True)


def planning_section(context: ReportContext) -> Section:
    """Success against N for every method, direct execution, the selector's ceiling, and gains."""
    found = context.summaries("evaluate_planning")
    if not found:
        return Section("planning", "Planning", missing="no planning evaluation was given (input evaluate_planning).")
    lead = (
        "From each bank of candidate control sequences one is chosen by its predicted video, in brackets of four; the label of"
        " the choice is opened only after all choices are made. Direct execution takes a candidate blindly. The same selector"
        " on the recorded true videos is its own ceiling."
    )
    return context.section("planning", "Planning", lead, evaluations=[planning_evaluation(s) for s in found])


def planning_evaluation(summary: JsonObject) -> dict[str, object]:
    """What the page shows of one evaluation."""
    budgets = sorted({int(n) for values in summary["methods"].values() for n in values["budgets"]})
    x = [float(n) for n in budgets]
    direct = Series("direct execution", x, [summary["direct_execution"]["mean"]] * len(x), colour="c5", dashed=True)
    success = line_chart(
        [*curves(summary, "success", band=False), direct], title="Success of the chosen candidate",
        x_label="candidates N", y_label="success", log_x=True, x_ticks=x, y_range=(0.0, 1.02), in_percent=True,
    )  # fmt: skip
    gain = line_chart(
        curves(summary, "gain", band=True), title="Gain over direct execution, 95 % interval over banks",
        x_label="candidates N", y_label="gain", log_x=True, x_ticks=x, in_percent=True,
    )  # fmt: skip
    return {
        "banks": len(summary["banks"]),
        "selector": summary.get("selector", "unknown"),
        "direct": summary["direct_execution"],
        "oracle": summary.get("oracle"),
        "falling": falling(summary),
        "charts": [success, gain],
        "budgets": budget_table(summary, budgets),
        "families": family_table(summary),
        "bank_table": bank_table(summary),
    }


def most_candidates(values: JsonObject) -> JsonObject:
    """A method's result among the most candidates."""
    return values["budgets"][max(values["budgets"], key=int)]


def falling(summary: JsonObject) -> list[str]:
    """Methods that choose worse among the most candidates than among the fewest, in words."""
    found = []
    for m in in_order(summary["methods"]):
        by_budget = summary["methods"][m.name]["budgets"]
        fewest, most = min(by_budget, key=int), max(by_budget, key=int)
        first, last = (by_budget[n]["success"]["mean"] for n in (fewest, most))
        if last < first:
            found.append(f"{m.long_label}: {percent(first)} at N = {fewest}, {percent(last)} at N = {most}")
    return found


def curves(summary: JsonObject, key: str, *, band: bool) -> list[Series]:
    """Success or gain of every method by number of candidates; with a band, of the models with the true controls."""
    series = []
    for m in in_order(summary["methods"]):
        if band and m.kind not in (TRUE_METHOD, "stage2", "causal", "other"):
            continue
        rows = sorted(
            ((int(n), found[key]) for n, found in summary["methods"][m.name]["budgets"].items()), key=lambda r: r[0]
        )
        mean, low, high = ([row[bound] for _, row in rows] for bound in ("mean", "low", "high"))
        bounds = (low, high) if band else (None, None)
        x, dashed = [float(n) for n, _ in rows], m.group == "run"
        series.append(Series(m.long_label, x, mean, *bounds, m.colour, dashed=dashed, markers=True))
    return series


def budget_table(summary: JsonObject, budgets: list[int]) -> Table:
    """Success by number of candidates, and the gain among the most."""
    rows: list[list[object]] = []
    for m in in_order(summary["methods"]):
        by_budget = summary["methods"][m.name]["budgets"]
        most = most_candidates(summary["methods"][m.name])
        cells = [share(by_budget.get(str(n), {}).get("success", {}).get("mean")) for n in budgets]
        spread = share(most["success"].get("std_over_banks", 0.0))
        rows.append([m.long_label, *cells, interval(most["gain"], signed=True), spread])
    headings = ["Chosen by videos of", *[f"N = {n}" for n in budgets], f"Gain at N = {budgets[-1]}", "s.d. over banks"]
    caption = "Success of the choice by number of candidates; gain is over direct execution of the same banks"
    return Table(headings, rows, range(1, len(headings)), caption)


def family_table(summary: JsonObject) -> Table:
    """Success among the most candidates by task family, beside direct execution."""
    methods = in_order(summary["methods"])
    direct: dict[str, list[float]] = {}
    for bank in summary["banks"].values():
        direct.setdefault(bank["task_family"], []).append(float(bank["direct_success"]))
    rows: list[list[object]] = []
    for family, values in sorted(direct.items()):
        found = [summary["methods"][m.name]["by_family"].get(family) for m in methods]
        cells = [share(by_budget[max(by_budget, key=int)]["success"]) if by_budget else None for by_budget in found]
        rows.append([words(family), len(values), share(sum(values) / len(values)), *cells])
    headings = ["Task", "Banks", "Direct", *[m.long_label for m in methods]]
    caption = "Success of the choice among the most candidates, by task"
    return Table(headings, rows, range(1, len(headings)), caption)


def bank_table(summary: JsonObject) -> Table:
    """Every bank: the share of runs (orders of its candidates) whose choice succeeds."""
    methods = in_order(summary["methods"])
    rows: list[list[object]] = []
    for bank, facts in sorted(summary["banks"].items()):
        chosen = [most_candidates(summary["methods"][m.name]).get("banks", {}).get(bank) for m in methods]
        known = [facts[key] for key in ("embodiment", "instruction", "candidates")]
        rows.append([bank, *known, share(facts["direct_success"]), *map(share, chosen)])
    headings = ["Bank", "Embodiment", "Instruction", "N", "Direct", *[m.long_label for m in methods]]
    return Table(headings, rows, range(3, len(headings)))


def share(value: float | None) -> str | None:
    """A share with two digits; None where there is none."""
    return None if value is None else number(float(value))
