"""Page "Policy evaluation": outcomes judged from predicted videos against the recorded ones."""

from __future__ import annotations

from worldline_core.pages.charts import Dot, interval_chart
from worldline_core.pages.page import Table, interval, words
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.methods import TRUE_METHOD, method, without_truth
from worldline_core.report.video_scores import SPLIT_LABELS
from worldline_core.store.artifact_files import JsonObject

TITLE = "Policy evaluation"
STEP = "evaluate_policy"
ALL = "all"
CEILING = "recorded videos (ceiling)"


def policy_section(context: ReportContext) -> Section:
    """Accuracy by method, the judge's own ceiling, and confusions."""
    found = context.summaries(STEP)
    if not found:
        return Section("policy", TITLE, missing=f"no policy evaluation was given (input {STEP}).")
    lead = (
        "A judge that sees only a video extracts evidence in the task family's schema; fixed rules decide whether the episode"
        " succeeded. As many successes as failures are judged in every split and family, so guessing is right in half of the"
        " cases. Accuracy is agreement with the recorded outcome; on the recorded videos themselves it is the judge's own ceiling."
    )
    return context.section("policy", TITLE, lead, evaluations=[evaluation(summary) for summary in found])


def evaluation(summary: JsonObject) -> dict[str, object]:
    """What the page shows of one evaluation."""
    methods = summary["methods"]
    labels = ({TRUE_METHOD: CEILING} if TRUE_METHOD in methods else {}) | {
        m.name: m.long_label for m in without_truth(methods)
    }
    dots = [
        Dot(label, found["mean"], found["low"], found["high"], "c2" if name == TRUE_METHOD else method(name).colour)
        for name, label in labels.items()
        if (found := methods[name].get(ALL, {}).get("accuracy"))
    ]
    chart = interval_chart(
        dots, digits=2, value_label="agreement with the recorded outcome, 95 % interval",
        title=f"Accuracy over {summary.get('trajectories', '?')} trajectories (judge: {summary.get('judge', 'unknown')})",
    )  # fmt: skip
    shown = [name for name in labels if name == TRUE_METHOD or method(name).kind in ("stage2", "causal")]
    confusions = [(labels[name], rows) for name in shown if (rows := confusion(methods[name]))]
    short = sorted((summary.get("shorter_than_recording") or {}).items())
    return {"chart": chart, "confusions": confusions, "short": short, "groups": group_table(methods, labels)}


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


def group_table(methods: JsonObject, labels: dict[str, str]) -> Table:
    """Accuracy by split and by family."""
    found_groups = {g for values in methods.values() for g in values if "/" not in g}
    groups = sorted(found_groups, key=lambda g: (g != ALL, g not in SPLIT_LABELS, g))
    unreadable = {name: values.get(ALL, {}).get("malformed_answers", 0) for name, values in methods.items()}
    rows: list[list[object]] = []
    for name, label in labels.items():
        cells: list[object] = [interval(methods[name].get(group, {}).get("accuracy")) for group in groups]
        if any(unreadable.values()):
            cells.append(f"{unreadable[name]} of {methods[name].get(ALL, {}).get('answers', 0)}")
        rows.append([label, *cells])
    headings = ["Videos of", *[words(SPLIT_LABELS.get(g, g)).capitalize() for g in groups]]
    caption = "Accuracy by split and by task family"
    if any(unreadable.values()):
        headings.append("Unreadable answers")
    else:
        caption += ". Every answer of the judge could be read."
    return Table(headings, rows, range(1, len(headings)), caption, dense=True)
