"""Section "Training": loss curves of every stage, read from the lines that training wrote."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from worldline_core.report.charts import Dot, Series, interval_chart, line_chart
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.markup import Column, Html, code, element, join, notice, number, table
from worldline_core.store.artifact_files import JsonObject, read_json_lines

TITLE = "Training"
STAGES = {
    "train_tokenizer": "Video tokenizer",
    "train_stage1": "Stage I: action-free, text-conditioned",
    "train_stage2": "Stage II: action-driven, three views",
    "distill": "Distillation",
}
OPTIONAL_STAGES = frozenset({"train_tokenizer"})
PHASES = ("teacher_forcing", "trajectory_regression", "distribution_matching")
METRICS_FILE = "metrics.jsonl"
LOSSES = {
    "loss": "training",
    "validation/loss": "held-out scenes",
    "validation/loss_shuffled_actions": "held-out, shuffled actions",
    "validation/loss_no_actions": "held-out, no actions",
}
ERRORS = {
    "validation/sample_error": "squared error of the clean latents",
    "validation/rollout_error": "squared latent error of four-step rollouts",
}
CONDITIONS = {
    "": ("held-out scenes", "c0"),
    "_shuffled_actions": ("shuffled actions", "c3"),
    "_no_actions": ("no actions", "c4"),
    "_copy": ("copy first frame", "c5"),
}
NOT_A_PART = frozenset({"step", "learning_rate", "gradient_norm", "flow_matching", "scale_intra", "scale_cross"})
MOST_PARTS = 6

Curve = tuple[list[float], list[float]]


def training_section(context: ReportContext) -> Section:
    """Charts for every stage's losses and a table of what each stage did."""
    parts: list[Html] = []
    missing: list[str] = []
    summary: list[list[object]] = []
    for step, title in STAGES.items():
        variants = context.inputs.variants(step)
        if not variants and step not in OPTIONAL_STAGES:
            missing.append(title)
        for variant, folder in variants.items():
            name = f"{title} ({variant})" if variant else title
            phases = read_phases(folder)
            if not phases:
                missing.append(f"{name} (it has no {METRICS_FILE})")
            for phase, rows in phases.items():
                curves = read_curves(rows)
                parts += stage_charts(f"{name}, {phase.replace('_', ' ')}" if phase else name, curves)
                summary.append(stage_row(name, phase, curves))
    if not parts:
        return Section(
            "training", TITLE, missing="no training stage was given (inputs train_stage1, train_stage2, distill)."
        )
    columns = [
        Column("Stage"),
        *[Column(c, numeric=True) for c in ("Steps", "First loss", "Last loss", "Last held-out loss")],
    ]
    notes = [notice("Missing: ", ", ".join(missing), ".")] if missing else []
    lead = (
        "What this run's own minutes of training did, starting from the base model. Pale: every logged mean; strong: running mean."
        " Held-out losses always use the same clips, noise and noise levels, with the averaged weights."
    )
    return Section("training", TITLE, lead, join(notes, table(columns, summary), element("div", parts, class_="grid2")))


def read_phases(folder: Path) -> dict[str, list[JsonObject]]:
    """Logged rows by phase: a stage's own file, or one a phase in its subfolders (distillation), in the method's order."""
    found = {"" if path.parent == folder else path.parent.name: read_json_lines(path)
             for path in [folder / METRICS_FILE, *sorted(folder.glob(f"*/{METRICS_FILE}"))] if path.is_file()}  # fmt: skip
    order = {name: place for place, name in enumerate(PHASES)}
    return {
        name: found[name]
        for name in sorted(found, key=lambda n: (order.get(n, -1), n))
        if found[name] and name != "run"
    }


def read_curves(rows: Sequence[JsonObject]) -> dict[str, Curve]:
    """Steps and values of every logged number that is finite."""
    curves: dict[str, Curve] = {}
    for row in rows:
        for name, value in row.items():
            if not isinstance(value, bool) and isinstance(value, (int, float)) and math.isfinite(value):
                steps, values = curves.setdefault(name, ([], []))
                steps.append(float(row["step"]))
                values.append(float(value))
    return curves


def stage_charts(title: str, curves: Mapping[str, Curve]) -> list[Html]:
    """Loss; held-out error of the clean latents; the other parts of the loss."""
    series: list[Series] = []
    for index, (name, label) in enumerate(LOSSES.items()):
        if name in curves:
            series += (
                smooth(label, curves[name])
                if name == "loss"
                else [marked(label, curves[name], ("c0", "c1", "c3", "c4")[index])]
            )
    charts = [chart(title, "loss", series)]
    charts += [error_chart(f"{title}: held-out error", what, name, curves) for name, what in ERRORS.items()]
    names = [n for n in curves if n not in NOT_A_PART and n not in LOSSES and not n.startswith("validation/")]
    pieces = [
        item
        for index, n in enumerate(names[:MOST_PARTS])
        for item in smooth(n.replace("_", " "), curves[n], f"c{index}")
    ]
    if pieces:
        charts.append(chart(f"{title}: parts of the loss", "value", pieces))
    return [made for made in charts if made]


def error_chart(title: str, what: str, name: str, curves: Mapping[str, Curve]) -> Html:
    """A held-out error with the true controls, with others, and of copying; rows of dots where it was measured once."""
    found = [
        (label, curves[name + suffix], colour)
        for suffix, (label, colour) in CONDITIONS.items()
        if name + suffix in curves
    ]
    if not found:
        return Html("")
    if all(len(steps) == 1 for _, (steps, _), _ in found):
        dots = [Dot(label, values[0], colour=colour) for label, (_, values), colour in found]
        return interval_chart(dots, title=title, value_label=f"{what}, at the last step", zero_line=True)
    return chart(title, what, [marked(label, curve, colour) for label, curve, colour in found])


def chart(title: str, y_label: str, series: Sequence[Series]) -> Html:
    """A chart over steps, logarithmic where all values are positive."""
    positive = all(value > 0 for item in series for value in item.y)
    return line_chart(series, title=title, x_label="step", y_label=y_label, log_y=positive)


def smooth(label: str, curve: Curve, colour: str = "c0") -> list[Series]:
    """The curve in pale and its running mean."""
    steps, values = thin(*curve)
    return [
        Series(label, steps, values, colour=colour, faint=True),
        Series(label, steps, running_mean(values), colour=colour),
    ]


def marked(label: str, curve: Curve, colour: str) -> Series:
    """A curve of few points."""
    steps, values = curve
    return Series(label, steps, values, colour=colour, markers=len(steps) < 40)


def thin(steps: Sequence[float], values: Sequence[float], most: int = 400) -> Curve:
    """At most `most` points: means over equal stretches."""
    width = max(1, math.ceil(len(values) / most))
    starts = range(0, len(values), width)
    means = [sum(values[i : i + width]) / len(values[i : i + width]) for i in starts]
    return [steps[min(i + width, len(steps)) - 1] for i in starts], means


def running_mean(values: Sequence[float]) -> list[float]:
    """Mean over the latest twentieth of the curve at each point."""
    window = max(1, len(values) // 20)
    parts = (values[max(0, i + 1 - window) : i + 1] for i in range(len(values)))
    return [sum(part) / len(part) for part in parts]


def stage_row(title: str, phase: str, curves: Mapping[str, Curve]) -> list[object]:
    """Name, number of steps, first and last smoothed loss, last held-out loss."""
    steps, values = curves.get("loss", ([], []))
    _, held_out = curves.get("validation/loss", ([], []))
    means = running_mean(values)
    name = join(title, " ", code(phase)) if phase else title
    shown = [
        number(v, 4) if v is not None else None
        for v in (means[0] if means else None, means[-1] if means else None, held_out[-1] if held_out else None)
    ]
    return [name, int(max(steps)) if steps else None, *shown]
