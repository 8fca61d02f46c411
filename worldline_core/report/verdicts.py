"""What the single verdicts of a policy evaluation tell: confusion by task, what went wrong, and which to trust."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Sequence

from worldline_core.evaluation.policy.evidence import failure_kind
from worldline_core.pages.charts import Series, line_chart
from worldline_core.pages.page import Table, number, percent, with_note
from worldline_core.report.video_scores import TRUE_METHOD, Method, in_order, predicting
from worldline_core.store.artifact_files import JsonObject

DECISIONS_FILE = "decisions.parquet"


def task_confusion(verdicts: Sequence[JsonObject]) -> Table | None:
    """Of the recorded successes and failures of every task (the first word of the instruction), those judged rightly."""
    counts: Counter[tuple[str, str, str, bool]] = Counter()
    for row in (row for row in verdicts if row["outcome"] in ("success", "failure")):
        counts[row["method"], _task(row), row["outcome"], row["predicted"] == row["outcome"]] += 1
    tasks = sorted({task for _, task, _, _ in counts})
    if len(tasks) < 2:
        return None

    def cell(method: str, task: str, outcome: str) -> str | None:
        right, wrong = (counts[method, task, outcome, judged] for judged in (True, False))
        return f"{right} of {right + wrong}" if right + wrong else None

    rows = [
        [m.long_label, task, *[cell(m.name, task, outcome) for outcome in ("success", "failure")]]
        for m in in_order({method for method, _, _, _ in counts})
        for task in tasks
    ]
    headings = ["Videos of", "Task", "Successes judged rightly", "Failures judged rightly"]
    return Table(headings, rows, (2, 3), "Confusion by task", dense=True)


def failure_tables(verdicts: Sequence[JsonObject]) -> list[Table]:
    """Of every method: what its videos say went wrong (columns), beside what the recorded videos say (rows)."""
    kinds = {(row["method"], row["episode_id"]): _kind(row) for row in verdicts if row["method"] == TRUE_METHOD}
    counts: dict[str, Counter[tuple[str, str]]] = defaultdict(Counter)
    for row in verdicts:
        recorded = kinds.get((TRUE_METHOD, row["episode_id"]))
        if row["method"] != TRUE_METHOD and recorded is not None:
            counts[row["method"]][recorded, _kind(row)] += 1
    tables = []
    for m in predicting(counts):
        found = counts[m.name]
        order = sorted({kind for pair in found for kind in pair}, key=lambda kind: (kind != "success", kind))
        rows = [[kind, *[found[kind, other] for other in order]] for kind in order]
        tables.append(
            Table(
                ["Recorded video", *order],
                rows,
                range(1, len(order) + 1),
                f"What is seen in videos of {m.long_label}",
                dense=True,
            )
        )
    return tables


def _task(row: JsonObject) -> str:
    return (row["instruction"].split() or ["none"])[0].lower()


def _kind(row: JsonObject) -> str:
    """``success``, or what the last evidence that was stated says went wrong."""
    if row["predicted"] == "success":
        return "success"
    stated = [s for s in json.loads(row["evidence"]) if s["pass"] in ("first_pass", "verification")]
    return failure_kind(row["evidence_family"], stated[-1])


def trust_view(trust: JsonObject) -> dict[str, object]:
    """Reliability of trust, its detection of errors, and the marks."""
    methods = trust["methods"]
    known = [m for m in predicting(methods) if methods[m.name]["available"]]
    reliability = [
        Series(
            m.long_label, *[[b[key] for b in methods[m.name]["reliability"]] for key in ("trust", "value", "low", "high")],
            colour=m.colour, markers=True,
        )
        for m in known
    ]  # fmt: skip
    lowest = min((x for series in reliability for x in series.x), default=0.0)
    charts = [
        line_chart(
            [*reliability, Series("calibrated", [lowest, 1.0], [lowest, 1.0], colour="c5", dashed=True)],
            title="Are verdicts right as often as they say?", x_label="stated probability of a right verdict",
            y_label="share of right verdicts, 95 % interval", in_percent=True,
        ),
    ] if known else []  # fmt: skip
    return {
        "recordings": trust["training_recordings"],
        "within": percent(1.0 - trust["settings"]["novelty_level"]),
        "least": percent(trust["settings"]["least_trust"]),
        "unavailable": [(m.long_label, methods[m.name]["reason"]) for m in predicting(methods) if m not in known],
        "charts": charts,
        "tables": [
            _detection(methods, known),
            _marks(methods, known),
        ],
    }


def _told(found: JsonObject, bounds: tuple[str, str] = ("low", "high")) -> object:
    """A value with its interval; None where it is not defined."""
    if found["value"] is None:
        return None
    low, high = (found[key] for key in bounds)
    return with_note(number(found["value"]), "" if low is None else f"[{number(low)}, {number(high)}]")


def _detection(methods: JsonObject, known: Sequence[Method]) -> Table | None:
    """Detection of wrong verdicts by trust, and its calibration error."""
    rows: list[list[object]] = []
    for m in known:
        found = methods[m.name]
        rows.append([m.long_label, _told(found["auroc"]), _told(found["calibration_error"])])
    headings = ["Verdicts on videos of", "AUROC", "Calibration error"]
    caption = "How well trust detects wrong verdicts (AUROC, 0.5 is chance), 95 % interval over starts"
    return Table(headings, rows, range(1, len(headings)), caption, dense=True) if rows else None


def _marks(methods: JsonObject, known: Sequence[Method]) -> Table | None:
    """How many verdicts are marked, and how often marked ones and others are wrong."""
    rows: list[list[object]] = []
    for m in known:
        found = methods[m.name]
        errors = [found["error"], found["error_of_marked"], found["error_of_others"]]
        rows.append([m.long_label, found["verdicts"], found["marked"], *map(_told, errors)])
    headings = ["Verdicts on videos of", "Verdicts", "Marked", "Wrong", "Wrong among marked", "Wrong among others"]
    return (
        Table(headings, rows, range(1, 6), "What the marks leave out, 95 % interval over starts", dense=True)
        if rows
        else None
    )
