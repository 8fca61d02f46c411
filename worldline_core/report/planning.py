"""Page "Planning": success of the chosen candidate against the number of candidates."""

from __future__ import annotations

from worldline_core.pages.charts import Series, line_chart
from worldline_core.pages.page import Table, interval, number, percent, words
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.methods import TRUE_METHOD, method, without_truth
from worldline_core.store.artifact_files import JsonObject

TITLE = "Planning"
STEP = "evaluate_planning"
CEILING = "recorded videos (selector's ceiling)"


def planning_section(context: ReportContext) -> Section:
    """Success against N for every method, direct execution, the selector's ceiling, and gains."""
    found = context.summaries(STEP)
    if not found:
        return Section("planning", TITLE, missing=f"no planning evaluation was given (input {STEP}).")
    lead = (
        "From each bank of candidate control sequences one is chosen by its predicted video, in brackets of four; the label of"
        " the choice is opened only after all choices are made. Direct execution takes a candidate blindly. The same selector"
        " on the recorded true videos is its own ceiling."
    )
    return context.section("planning", TITLE, lead, evaluations=[evaluation(summary) for summary in found])


def evaluation(summary: JsonObject) -> dict[str, object]:
    """What the page shows of one evaluation."""
    return {
        "banks": len(summary["banks"]),
        "selector": summary.get("selector", "unknown"),
        "direct": summary["direct_execution"],
        "oracle": summary.get("oracle"),
        "falling": falling(summary),
        "charts": [success_chart(summary), gain_chart(summary)],
        "budgets": budget_table(summary),
        "families": family_table(summary),
        "bank_table": bank_table(summary),
    }


def labels(summary: JsonObject) -> dict[str, str]:
    """How each method is called, the recorded videos first."""
    named = {m.name: m.long_label for m in without_truth(summary["methods"])}
    return ({TRUE_METHOD: CEILING} if TRUE_METHOD in summary["methods"] else {}) | named


def budgets_of(summary: JsonObject) -> list[int]:
    """Numbers of candidates that were evaluated."""
    return sorted({int(n) for values in summary["methods"].values() for n in values["budgets"]})


def most_candidates(values: JsonObject) -> JsonObject:
    """A method's result among the most candidates."""
    return values["budgets"][max(values["budgets"], key=int)]


def falling(summary: JsonObject) -> list[str]:
    """Methods that choose worse among the most candidates than among the fewest, in words."""
    found = []
    for name, label in labels(summary).items():
        by_budget = summary["methods"][name]["budgets"]
        fewest, most = min(by_budget, key=int), max(by_budget, key=int)
        first, last = (by_budget[n]["success"]["mean"] for n in (fewest, most))
        if last < first:
            found.append(f"{label}: {percent(first)} at N = {fewest}, {percent(last)} at N = {most}")
    return found


def curves(summary: JsonObject, key: str, *, band: bool) -> list[Series]:
    """Success or gain of every method by number of candidates."""
    series = []
    for name, label in labels(summary).items():
        if band and name != TRUE_METHOD and method(name).kind not in ("stage2", "causal", "other"):
            continue
        rows = [(int(n), found[key]) for n, found in summary["methods"][name]["budgets"].items()]
        rows.sort(key=lambda row: row[0])
        mean, low, high = ([row[bound] for _, row in rows] for bound in ("mean", "low", "high"))
        colour, dashed = ("c2", False) if name == TRUE_METHOD else (method(name).colour, method(name).group == "run")
        bounds = (low, high) if band else (None, None)
        series.append(Series(label, [float(n) for n, _ in rows], mean, *bounds, colour, dashed=dashed, markers=True))
    return series


def success_chart(summary: JsonObject) -> object:
    """Success of the choice against the number of candidates."""
    x = [float(n) for n in budgets_of(summary)]
    direct = Series("direct execution", x, [summary["direct_execution"]["mean"]] * len(x), colour="c5", dashed=True)
    return line_chart(
        [*curves(summary, "success", band=False), direct], title="Success of the chosen candidate",
        x_label="candidates N", y_label="success", log_x=True, x_ticks=x, y_range=(0.0, 1.02), in_percent=True,
    )  # fmt: skip


def gain_chart(summary: JsonObject) -> object:
    """Gain over direct execution with intervals over banks."""
    return line_chart(
        curves(summary, "gain", band=True), title="Gain over direct execution, 95 % interval over banks",
        x_label="candidates N", y_label="gain", log_x=True, x_ticks=[float(n) for n in budgets_of(summary)], in_percent=True,
    )  # fmt: skip


def budget_table(summary: JsonObject) -> Table:
    """Success by number of candidates, and the gain among the most."""
    budgets = budgets_of(summary)
    rows = []
    for name, label in labels(summary).items():
        by_budget = summary["methods"][name]["budgets"]
        cells = [number(float(by_budget[str(n)]["success"]["mean"])) if str(n) in by_budget else None for n in budgets]
        most = most_candidates(summary["methods"][name])
        spread = number(float(most["success"].get("std_over_banks", 0.0)))
        rows.append([label, *cells, interval(most["gain"], signed=True), spread])
    headings = ["Chosen by videos of", *[f"N = {n}" for n in budgets], f"Gain at N = {budgets[-1]}", "s.d. over banks"]
    caption = "Success of the choice by number of candidates; gain is over direct execution of the same banks"
    return Table(headings, rows, range(1, len(headings)), caption)


def family_table(summary: JsonObject) -> Table:
    """Success among the most candidates by task family, beside direct execution."""
    direct: dict[str, list[float]] = {}
    for bank in summary["banks"].values():
        direct.setdefault(bank["task_family"], []).append(float(bank["direct_success"]))
    rows = []
    for family, values in sorted(direct.items()):
        cells = []
        for name in labels(summary):
            by_budget = summary["methods"][name]["by_family"].get(family, {})
            cells.append(number(float(by_budget[max(by_budget, key=int)]["success"])) if by_budget else None)
        rows.append([words(family), len(values), number(sum(values) / len(values)), *cells])
    headings = ["Task", "Banks", "Direct", *labels(summary).values()]
    caption = "Success of the choice among the most candidates, by task"
    return Table(headings, rows, range(1, len(headings)), caption)


def bank_table(summary: JsonObject) -> Table:
    """Every bank: the share of runs (orders of its candidates) whose choice succeeds."""
    rows = []
    for bank, facts in sorted(summary["banks"].items()):
        chosen = [most_candidates(summary["methods"][name]).get("banks", {}).get(bank) for name in labels(summary)]
        rows.append(
            [
                *[bank, facts["embodiment"], facts["instruction"], facts["candidates"]],
                number(float(facts["direct_success"])),
                *[None if value is None else number(float(value)) for value in chosen],
            ]
        )
    headings = ["Bank", "Embodiment", "Instruction", "N", "Direct", *labels(summary).values()]
    return Table(headings, rows, range(3, len(headings)))
