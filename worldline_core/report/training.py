"""Page "Training": loss curves of every stage, read from the lines that training wrote."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from markupsafe import Markup

from worldline_core.pages.charts import Dot, Series, interval_chart, line_chart
from worldline_core.pages.page import Table, code, number, words
from worldline_core.report.context import ReportContext, Section
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
    "loss": ("training", "c0"),
    "validation/loss": ("held-out scenes", "c1"),
    "validation/loss_shuffled_actions": ("held-out, shuffled actions", "c3"),
    "validation/loss_no_actions": ("held-out, no actions", "c4"),
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
    charts: list[Markup] = []
    missing: list[str] = []
    rows: list[list[object]] = []
    for step, title in STAGES.items():
        variants = context.variants(step)
        if not variants and step not in OPTIONAL_STAGES:
            missing.append(title)
        for variant, folder in variants.items():
            name = f"{title} ({variant})" if variant else title
            phases = read_phases(folder)
            if not phases:
                missing.append(f"{name} (it has no {METRICS_FILE})")
            for phase, logged in phases.items():
                curves = read_curves(logged)
                charts += stage_charts(f"{name}, {words(phase)}" if phase else name, curves)
                rows.append(stage_row(name, phase, curves))
    if not charts:
        return Section(
            "training", TITLE, missing="no training stage was given (inputs train_stage1, train_stage2, distill)."
        )
    lead = (
        "What this run's own training did, starting from the base model. Pale: every logged mean; strong: running mean."
        " Held-out losses always use the same clips, noise and noise levels, with the averaged weights."
    )
    table = Table(("Stage", "Steps", "First loss", "Last loss", "Last held-out loss"), rows, range(1, 5))
    return context.section("training", TITLE, lead, missing=missing, table=table, charts=charts)


def read_phases(folder: Path) -> dict[str, list[JsonObject]]:
    """Logged rows by phase: a stage's own file, or one per phase in its subfolders (distillation), in the method's order."""
    paths = [folder / METRICS_FILE, *sorted(folder.glob(f"*/{METRICS_FILE}"))]
    found = {"" if p.parent == folder else p.parent.name: read_json_lines(p) for p in paths if p.is_file()}
    order = {name: place for place, name in enumerate(PHASES)}
    names = sorted(found, key=lambda n: (order.get(n, -1), n))
    return {name: found[name] for name in names if found[name] and name != "run"}


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


def stage_charts(title: str, curves: Mapping[str, Curve]) -> list[Markup]:
    """Loss; held-out error of the clean latents; the other parts of the loss."""
    series: list[Series] = []
    for name, (label, colour) in LOSSES.items():
        if name in curves:
            series += smooth(label, curves[name]) if name == "loss" else [marked(label, curves[name], colour)]
    errors = [error_chart(f"{title}: held-out error", what, name, curves) for name, what in ERRORS.items()]
    names = [n for n in curves if n not in NOT_A_PART and n not in LOSSES and not n.startswith("validation/")]
    parts = [s for i, n in enumerate(names[:MOST_PARTS]) for s in smooth(words(n), curves[n], f"c{i}")]
    found = [chart(title, "loss", series), *(made for made in errors if made)]
    return [*found, chart(f"{title}: parts of the loss", "value", parts)] if parts else found


def error_chart(title: str, what: str, name: str, curves: Mapping[str, Curve]) -> Markup | None:
    """A held-out error with the true controls, with others, and of copying; rows of dots where it was measured once."""
    found = [
        (label, curves[name + suffix], colour)
        for suffix, (label, colour) in CONDITIONS.items()
        if name + suffix in curves
    ]
    if not found:
        return None
    if all(len(steps) == 1 for _, (steps, _), _ in found):
        dots = [Dot(label, values[0], colour=colour) for label, (_, values), colour in found]
        return interval_chart(dots, title=title, value_label=f"{what}, at the last step", zero_line=True)
    return chart(title, what, [marked(label, curve, colour) for label, curve, colour in found])


def chart(title: str, y_label: str, series: Sequence[Series]) -> Markup:
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
    shown = [*(means[:1] or [None]), *(means[-1:] or [None]), *(held_out[-1:] or [None])]
    name = Markup("{} {}").format(title, code(phase)) if phase else title
    return [name, int(max(steps)) if steps else None, *[None if v is None else number(v, 4) for v in shown]]
