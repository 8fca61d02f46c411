"""Section "Policy evaluation": outcomes judged from predicted videos against the recorded ones."""

from __future__ import annotations

from worldline_core.report.charts import Dot, interval_chart
from worldline_core.report.context import ReportContext, Section, evaluation_section
from worldline_core.report.markup import Column, Html, element, interval, join, notice, number, table
from worldline_core.report.methods import TRUE_METHOD, Method, without_truth
from worldline_core.report.tiles import Tile, bounds
from worldline_core.report.video_scores import SPLIT_LABELS
from worldline_core.store.artifact_files import JsonObject

TITLE = "Policy evaluation"
STEP = "evaluate_policy"
ALL = "all"


def policy_section(context: ReportContext) -> Section:
    """Accuracy by method, the judge's own ceiling, and confusions."""
    lead = (
        "A judge that sees only a video extracts evidence in the task family's schema; fixed rules decide whether the episode"
        " succeeded. As many successes as failures are judged in every split and family. Accuracy is agreement with the recorded"
        " outcome; on the recorded videos themselves it is the judge's own ceiling."
    )
    return evaluation_section(context, STEP, "policy", TITLE, lead, evaluation)


def evaluation(summary: JsonObject) -> Html:
    """One evaluation: chart, table by group, confusions."""
    methods = summary["methods"]
    order = without_truth(methods)
    dots = [dot(m.long_label, methods[m.name], m.colour) for m in order]
    if TRUE_METHOD in methods:
        dots.insert(0, dot("recorded videos (ceiling)", methods[TRUE_METHOD], "c2"))
    chart = interval_chart(
        [d for d in dots if d is not None],
        title=f"Accuracy over {summary.get('trajectories', '?')} trajectories (judge: {summary.get('judge', 'unknown')})",
        value_label="agreement with the recorded outcome, 95 % interval",
        digits=2,
    )
    confusions = [confusion("recorded videos", methods[TRUE_METHOD])] if TRUE_METHOD in methods else []
    confusions += [confusion(m.long_label, methods[m.name]) for m in order if m.kind in ("stage2", "causal")]
    short = summary.get("shorter_than_recording") or {}
    note = notice("Predictions shorter than their recording are not judged, because the outcome may lie after their end: ",
                  ", ".join(f"{name} {count}" for name, count in sorted(short.items())), ".") if short else None  # fmt: skip
    heading = element("div", "Recorded (rows) against judged outcome (columns)", class_="chart-title")
    box = element("div", heading, element("div", confusions, class_="confusions"), class_="chart-box")
    return join(note, element("div", chart, box, class_="grid2"), group_table(methods, order))


def dot(label: str, groups: JsonObject, colour: str) -> Dot | None:
    """The accuracy over all trajectories as a chart's row."""
    found = groups.get(ALL, {}).get("accuracy")
    return None if found is None else Dot(label, found["mean"], found["low"], found["high"], colour)


def group_table(methods: JsonObject, order: list[Method]) -> Html:
    """Accuracy by split and by family."""
    found_groups = {g for values in methods.values() for g in values if "/" not in g}
    groups = sorted(found_groups, key=lambda g: (g != ALL, g not in SPLIT_LABELS, g))
    unreadable = {name: values.get(ALL, {}).get("malformed_answers", 0) for name, values in methods.items()}
    rows: list[list[object]] = []
    names = [(TRUE_METHOD, "recorded videos (ceiling)")] if TRUE_METHOD in methods else []
    for name, label in [*names, *[(m.name, m.long_label) for m in order]]:
        cells: list[object] = []
        for group in groups:
            found = methods[name].get(group, {}).get("accuracy")
            cells.append(interval(found["mean"], found["low"], found["high"]) if found else None)
        if any(unreadable.values()):
            cells.append(f"{unreadable[name]} of {methods[name].get(ALL, {}).get('answers', 0)}")
        rows.append([label, *cells])
    columns = [
        Column("Videos of"),
        *[Column(str(SPLIT_LABELS.get(g, g)).replace("_", " ").capitalize(), numeric=True) for g in groups],
    ]
    caption = "Accuracy by split and by task family"
    if any(unreadable.values()):
        columns.append(Column("Unreadable answers", numeric=True))
    else:
        caption += ". Every answer of the judge could be read."
    return table(columns, rows, caption=caption, dense=True)


def confusion(label: str, groups: JsonObject) -> Html:
    """Recorded against judged outcomes; shade by share of the row."""
    counts = groups.get(ALL, {}).get("confusion")
    if not counts:
        return Html("")
    rows = []
    for recorded, right, wrong in (
        ("success", "true_success", "false_failure"),
        ("failure", "true_failure", "false_success"),
    ):
        total = counts[right] + counts[wrong] or 1
        cells = [counts[right], counts[wrong]] if recorded == "success" else [counts[wrong], counts[right]]
        shown = [element("td", number(count), style=f"--share: {0.06 + 0.5 * count / total:.2f}") for count in cells]
        rows.append(element("tr", element("th", recorded, scope="row"), shown))
    head = element(
        "tr", element("th", ""), element("th", "success", scope="col"), element("th", "failure", scope="col")
    )
    return element(
        "table", element("caption", label), element("thead", head), element("tbody", rows), class_="confusion"
    )


def policy_tiles(context: ReportContext) -> list[Tile]:
    """Accuracy of the first model's videos beside the judge's ceiling."""
    tiles: list[Tile] = []
    for summary in context.summaries(STEP)[:1]:
        methods = summary["methods"]
        order = without_truth(methods)
        first = next((m for m in order if m.kind == "stage2"), order[0] if order else None)
        found = methods[first.name].get(ALL, {}).get("accuracy") if first else None
        if first is None or found is None:
            continue
        ceiling = methods.get(TRUE_METHOD, {}).get(ALL, {}).get("accuracy")
        beside = f"judge's own ceiling {100 * ceiling['mean']:.0f}\u202f%; " if ceiling else ""
        figure = f"{100 * found['mean']:.0f}\u202f%"
        tiles.append(
            Tile(
                figure,
                f"outcomes judged rightly from videos of {first.long_label}",
                beside + bounds(found["low"], found["high"]),
            )
        )
    return tiles
