"""Pages "Training" and "Provenance": loss curves of every stage; weights, digests, configurations and times of every artifact."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup, escape

from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.evaluation.paired import EVALUATIONS
from worldline_core.model.model_card import DESCRIPTIONS, model_card, model_facts
from worldline_core.pages.charts import Series, line_chart
from worldline_core.pages.page import Table, code, render, words
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.results import measurements
from worldline_core.store.artifact_files import JsonObject, read_json, read_json_lines
from worldline_core.store.atomic import write_bytes_atomic
from worldline_core.training.training_state import PROBE_LOG

STAGES = {
    "train_tokenizer": "Video tokenizer",
    "train_stage1": "Stage I: action-free, text-conditioned",
    "train_stage2": "Stage II: action-driven",
    "distill": "Distillation",
}
PHASES = ("", "teacher_forcing", "trajectory_regression", "distribution_matching")
METRICS_FILE = "metrics.jsonl"
MOST_POINTS = 400
CURVES = {
    "loss": ("validation/loss",),
    "squared latent error": ("validation/sample_error", "validation/rollout_error"),
}
"""Held-out values of each chart, by the label of its axis; their names with a condition's suffix are shown as well."""
CONDITIONS = (
    ("", "held-out", "c1"),
    ("_shuffled_actions", "held-out, shuffled actions", "c3"),
    ("_no_actions", "held-out, no actions", "c4"),
    ("_copy", "held-out, copy first frame", "c5"),
)

TOOL_ERRORS = {
    "tool_error_px": ("true controls", "c1"),
    "tool_error_px_shuffled": ("another clip's controls", "c3"),
    "tool_error_px_copy": ("copy first frame", "c5"),
}

Curve = tuple[list[float], list[float]]
"""Steps and values."""


def training_section(context: ReportContext) -> Section:
    """Charts of every stage's losses and held-out errors."""
    charts: list[Markup] = []
    missing: list[str] = []
    for step, title in STAGES.items():
        variants = context.variants(step)
        if not variants and step != "train_tokenizer":
            missing.append(title)
        for variant, folder in variants.items():
            for phase, logged in read_phases(folder).items():
                name = ", ".join(part for part in (title, variant, words(phase)) if part)
                charts += stage_charts(name, read_curves(logged))
                if (following := action_following_chart(name, folder / "run" / phase if phase else folder)) is not None:
                    charts.append(context.slot(f"following-{step}-{variant}-{phase}", following, "See run/run.js."))
    if not charts:
        return Section(
            "training", "Training", missing="no training stage was given (inputs train_stage1, train_stage2, ...)."
        )
    lead = (
        "This run's own training, from the base model on. Training loss: a running mean. Held-out losses always use"
        " the same clips, noise and noise levels, with the averaged weights. Tool error: how far the tools are from where the"
        " controls put them; a model that follows its controls is worse under another clip's."
    )
    return context.section("training", "Training", lead, missing=missing, charts=charts)


def read_phases(folder: Path) -> dict[str, list[JsonObject]]:
    """Logged rows by phase: a stage's own file, or one per phase in its subfolders (distillation), in the method's order."""
    found = {phase: read_json_lines(folder / phase / METRICS_FILE) for phase in PHASES}
    return {phase: rows for phase, rows in found.items() if rows}


def read_curves(rows: Sequence[JsonObject]) -> dict[str, Curve]:
    """The curve of every logged number, finite values alone."""
    curves: dict[str, Curve] = {}
    for row in rows:
        for name, value in row.items():
            if isinstance(value, (int, float)) and math.isfinite(value):
                steps, values = curves.setdefault(name, ([], []))
                steps.append(float(row["step"]))
                values.append(float(value))
    return curves


def stage_charts(title: str, curves: Mapping[str, Curve]) -> list[Markup]:
    """The loss with its held-out values, and held-out errors, logarithmic where all values are positive."""
    charts = []
    for label, names in CURVES.items():
        series = [Series("training", *smooth(*curves["loss"]))] if label == "loss" and "loss" in curves else []
        for name, (suffix, condition, colour) in ((name, found) for name in names for found in CONDITIONS):
            if name + suffix in curves:
                steps, values = curves[name + suffix]
                series.append(Series(condition, steps, values, colour=colour, markers=len(steps) < 40))
        if series:
            positive = all(value > 0 for item in series for value in item.y)
            charts.append(line_chart(series, title=f"{title}: {label}", x_label="step", y_label=label, log_y=positive))
    return charts


def action_following_chart(title: str, work: Path) -> Markup | None:
    """Distance of the tools from their true places on held-out clips, as it was measured during training."""
    curves = read_curves(read_json_lines(work / PROBE_LOG))
    series = [
        Series(condition, *curves[name], colour=colour, markers=True)
        for name, (condition, colour) in TOOL_ERRORS.items()
        if name in curves
    ]
    if not series:
        return None
    return line_chart(series, title=f"{title}: tool error after a second", x_label="step", y_label="px")


def smooth(steps: Sequence[float], values: Sequence[float]) -> Curve:
    """Running mean over a twentieth of the curve, thinned."""
    window, every = max(1, len(values) // 20), math.ceil(len(values) / MOST_POINTS)
    sums = np.cumsum([0.0, *values])
    stops = np.arange(1, len(values) + 1)
    starts = np.maximum(0, stops - window)
    means = (sums[stops] - sums[starts]) / (stops - starts)
    return list(steps[::-every][::-1]), means[::-every][::-1].tolist()


def provenance_section(context: ReportContext) -> Section:
    """The models with their cards, and the origin of each artifact; times and versions are filled in when the page opens."""
    if not context.inputs:
        return Section("provenance", "Provenance", missing="no artifact was given.")
    manifests = {name: read_json(folder / "manifest.json") for name, folder in sorted(context.inputs.items())}
    rows: list[list[object]] = []
    for name, manifest in manifests.items():
        seeds = ", ".join(f"{key} {json.dumps(value)}" for key, value in sorted((manifest.get("seeds") or {}).items()))
        digest = code(str(manifest["digest"])[:16]) if manifest.get("digest") else None
        rows.append([name, digest, manifest.get("version"), seeds or None])
    models = models_of(context)
    facts = [model_facts(folder) for folder in models.values()]
    headings = [*dict.fromkeys(key for found in facts for key in found)]
    listed = [[name, *map(found.get, headings)] for name, found in zip(models, facts, strict=True)]
    return context.section(
        "provenance",
        "Provenance",
        "The same configuration on the same inputs gives the same digests.",
        models=Table(["Model", *map(str.capitalize, headings)], listed) if listed else None,
        artifacts=Table(("Artifact", "Digest", "Version", "Seeds"), rows, caption="Artifacts that this report shows"),
        machine=context.slot("machine", render("report/machine.html", manifests=manifests), "See run/run.js."),
        configs={
            name: escape(json.dumps(manifest["config"], indent=2, sort_keys=True, ensure_ascii=False))  # uncut
            for name, manifest in manifests.items()
            if manifest.get("config") is not None
        },
        cards={name: written_card(context, name, folder) for name, folder in models.items()},
    )


def models_of(context: ReportContext) -> dict[str, Path]:
    """The folders of the run's weights by name: its own models, then those that it was given."""
    found = {name.removeprefix("models."): path for name, path in context.inputs.items()}
    return {name: path for name, path in found.items() if any((path / file).is_file() for file in DESCRIPTIONS)}


def written_card(context: ReportContext, name: str, folder: Path) -> str:
    """The card that came with a model; else one from the run's artifacts, which is written to ``cards/<name>.md``."""
    given = folder / "MODEL_CARD.md"
    if given.is_file() or not (folder / DESCRIPTIONS[0]).is_file():
        return (
            given.read_text(encoding="utf-8", errors="replace") if given.is_file() else "No card came with this model."
        )
    evaluations = [path for step in EVALUATIONS for path in context.variants(step).values()]
    text = model_card(folder, measurements(folder, evaluations))
    write_bytes_atomic(context.output / "cards" / f"{safe_stem(name)}.md", text.encode())
    return text.partition("\n---\n")[2]
