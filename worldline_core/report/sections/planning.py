"""Section "Planning": success of the chosen candidate against the number of candidates."""

from __future__ import annotations

from worldline_core.report.charts import Series, line_chart
from worldline_core.report.context import ReportContext, Section, evaluation_section
from worldline_core.report.markup import Column, Html, element, interval, join, number, paragraph, table
from worldline_core.report.methods import TRUE_METHOD, Method, in_order, without_truth
from worldline_core.report.tiles import Tile, bounds
from worldline_core.store.artifact_files import JsonObject

TITLE = "Planning"
STEP = "evaluate_planning"
DIRECT = "direct_execution"


def planning_section(context: ReportContext) -> Section:
    """Success against N for every method, direct execution, the selector's ceiling, and gains."""
    lead = (
        "From each bank of candidate control sequences one is chosen by its predicted video, in brackets of four; the label of the"
        " choice is opened only after all choices are made. Direct execution takes a candidate blindly. The same selector on the"
        " recorded true videos is its own ceiling."
    )
    return evaluation_section(context, STEP, "planning", TITLE, lead, evaluation)


def evaluation(summary: JsonObject) -> Html:
    """One evaluation: two charts and tables."""
    methods = summary["methods"]
    order = without_truth(methods)
    charts = element("div", success_chart(summary, order), gain_chart(summary, order), class_="grid2")
    oracle = summary.get("oracle")
    reach = f" In {100 * oracle['mean']:.0f}\u202f% of the banks at least one candidate succeeds." if oracle else ""
    direct = summary[DIRECT]
    note = paragraph(
        f"{len(summary['banks'])} banks, selector: {summary.get('selector', 'unknown')}. Direct execution succeeds in ",
        interval(direct["mean"], direct["low"], direct["high"]), " of the cases on average over the banks.", reach,
    )  # fmt: skip
    return join(note, charts, budget_table(summary, order), family_table(summary, order), bank_table(summary))


def success_chart(summary: JsonObject, order: list[Method]) -> Html:
    """Success of the choice against the number of candidates."""
    methods = summary["methods"]
    budgets = sorted({int(n) for values in methods.values() for n in values["budgets"]})
    series = [curve(methods[m.name], "success", m.long_label, m.colour, dashed=m.group == "run") for m in order]
    if TRUE_METHOD in methods:
        series.insert(0, curve(methods[TRUE_METHOD], "success", "recorded videos (selector's ceiling)", "c2"))
    direct = summary[DIRECT]["mean"]
    x = [float(n) for n in budgets]
    series.append(Series("direct execution", x, [direct] * len(x), colour="c5", dashed=True))
    return line_chart(
        series, title="Success of the chosen candidate", x_label="candidates N", y_label="success", log_x=True, x_ticks=x,
        y_range=(0.0, 1.02), percent=True,
    )  # fmt: skip


def gain_chart(summary: JsonObject, order: list[Method]) -> Html:
    """Gain over direct execution with intervals over banks."""
    methods = summary["methods"]
    main = [m for m in order if m.kind in ("stage2", "causal", "other")] or order
    series = [curve(methods[m.name], "gain", m.long_label, m.colour, dashed=m.group == "run", band=True) for m in main]
    if TRUE_METHOD in methods:
        series.insert(0, curve(methods[TRUE_METHOD], "gain", "recorded videos (selector's ceiling)", "c2", band=True))
    ticks = sorted({x for s in series for x in s.x})
    return line_chart(
        series, title="Gain over direct execution, 95 % interval over banks", x_label="candidates N", y_label="gain", log_x=True,
        x_ticks=ticks, percent=True,
    )  # fmt: skip


def curve(values: JsonObject, key: str, label: str, colour: str, *, dashed: bool = False, band: bool = False) -> Series:
    """One method's success or gain by budget."""
    rows = [(float(n), found[key]) for n, found in sorted(values["budgets"].items(), key=lambda item: int(item[0]))]
    x, means = [n for n, _ in rows], [row["mean"] for _, row in rows]
    low, high = ([row[bound] for _, row in rows] for bound in ("low", "high"))
    return Series(label, x, means, low if band else None, high if band else None, colour, dashed=dashed, markers=True)


def budget_table(summary: JsonObject, order: list[Method]) -> Html:
    """Success by budget, and the gain at the largest."""
    methods = summary["methods"]
    budgets = sorted({int(n) for values in methods.values() for n in values["budgets"]})
    named = [(TRUE_METHOD, "recorded videos (selector's ceiling)")] if TRUE_METHOD in methods else []
    rows: list[list[object]] = []
    for name, label in [*named, *[(m.name, m.long_label) for m in order]]:
        by_budget = methods[name]["budgets"]
        cells = [
            number(float(by_budget[str(n)]["success"]["mean"]), 2) if str(n) in by_budget else None for n in budgets
        ]
        most = by_budget[max(by_budget, key=int)]
        gain = most["gain"]
        spread = number(float(most["success"].get("std_over_banks", 0.0)), 2)
        rows.append([label, *cells, interval(gain["mean"], gain["low"], gain["high"], signed=True), spread])
    columns = [Column("Chosen by videos of"), *[Column(f"N = {n}", numeric=True) for n in budgets]]
    columns += [Column(f"Gain at N = {budgets[-1]}", numeric=True), Column("s.d. over banks", numeric=True)]
    return table(
        columns,
        rows,
        caption="Success of the choice by number of candidates; gain is over direct execution of the same banks",
    )


def family_table(summary: JsonObject, order: list[Method]) -> Html:
    """Success among the most candidates by task family, beside direct execution."""
    methods = summary["methods"]
    shown = [(TRUE_METHOD, "recorded videos")] if TRUE_METHOD in methods else []
    shown += [(method.name, method.long_label) for method in order]
    direct: dict[str, list[float]] = {}
    for bank in summary["banks"].values():
        direct.setdefault(bank["task_family"], []).append(float(bank["direct_success"]))
    rows: list[list[object]] = []
    for family, values in sorted(direct.items()):
        cells = []
        for name, _ in shown:
            by_budget = methods[name]["by_family"].get(family, {})
            cells.append(number(float(by_budget[max(by_budget, key=int)]["success"]), 2) if by_budget else None)
        rows.append([family.replace("_", " "), len(values), number(sum(values) / len(values), 2), *cells])
    columns = [Column("Task"), Column("Banks", numeric=True), Column("Direct", numeric=True)]
    columns += [Column(label, numeric=True) for _, label in shown]
    return table(columns, rows, caption="Success of the choice among the most candidates, by task")


def bank_table(summary: JsonObject) -> Html:
    """Every bank, folded away: the share of runs (orders of its candidates) whose choice succeeds."""
    methods = summary["methods"]
    order = [name for name in (TRUE_METHOD, *[m.name for m in without_truth(methods)]) if name in methods]
    rows: list[list[object]] = []
    for bank, facts in sorted(summary["banks"].items()):
        chosen = []
        for name in order:
            by_budget = methods[name]["budgets"]
            value = by_budget[max(by_budget, key=int)].get("banks", {}).get(bank)
            chosen.append(None if value is None else number(float(value), 2))
        rows.append(
            [
                bank,
                facts["embodiment"],
                facts["instruction"],
                facts["candidates"],
                number(float(facts["direct_success"]), 2),
                *chosen,
            ]
        )
    columns = [
        Column("Bank"),
        Column("Embodiment"),
        Column("Instruction"),
        Column("N", numeric=True),
        Column("Direct", numeric=True),
    ]
    labels = {m.name: m.long_label for m in in_order(order)} | {TRUE_METHOD: "recorded videos"}
    columns += [Column(labels[name], numeric=True) for name in order]
    return element(
        "details",
        element(
            "summary", f"All {len(rows)} banks: share of runs in which the choice among the most candidates succeeds"
        ),
        table(columns, rows),
    )


def planning_tiles(context: ReportContext) -> list[Tile]:
    """Success of the choice among the most candidates beside direct execution."""
    tiles: list[Tile] = []
    for summary in context.summaries(STEP)[:1]:
        methods = summary["methods"]
        order = without_truth(methods)
        if not order:
            continue
        first = order[0]
        budget = max(methods[first.name]["budgets"], key=int)
        found = methods[first.name]["budgets"][budget]
        gain = found["gain"]
        ceiling = methods.get(TRUE_METHOD, {}).get("budgets", {}).get(budget)
        beside = f"; ceiling on true videos {100 * ceiling['success']['mean']:.0f}\u202f%" if ceiling else ""
        how = f"direct {100 * summary[DIRECT]['mean']:.0f}\u202f%{beside}; gain {bounds(gain['low'], gain['high'], signed=True)}"
        mood = "good" if gain["low"] > 0 else "bad" if gain["high"] < 0 else ""
        what = f"success of the choice among {budget} by videos of {first.long_label}"
        tiles.append(Tile(f"{100 * found['success']['mean']:.0f}\u202f%", what, how, mood))
    return tiles
