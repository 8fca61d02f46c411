"""Pages "Training" and "Provenance": loss curves of every stage; weights, digests, configurations and times of every artifact."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup, escape

from worldline_core.pages.charts import Series, line_chart
from worldline_core.pages.page import Table, code, number, render, words
from worldline_core.report.context import ReportContext, Section
from worldline_core.store.artifact_files import JsonObject, read_json, read_json_lines

STAGES = {
    "train_tokenizer": "Video tokenizer",
    "train_stage1": "Stage I: action-free, text-conditioned",
    "train_stage2": "Stage II: action-driven, three views",
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
CONDITIONS = {
    "": ("held-out scenes", "c1"),
    "_shuffled_actions": ("held-out, shuffled actions", "c3"),
    "_no_actions": ("held-out, no actions", "c4"),
    "_copy": ("held-out, copy first frame", "c5"),
}

Curve = tuple[list[float], list[float]]
"""Steps and values."""


def training_section(context: ReportContext) -> Section:
    """Charts of every stage's losses and held-out errors, and a table of its first and last."""
    charts: list[Markup] = []
    missing: list[str] = []
    rows: list[list[object]] = []
    for step, title in STAGES.items():
        variants = context.variants(step)
        if not variants and step != "train_tokenizer":
            missing.append(title)
        for variant, folder in variants.items():
            for phase, logged in read_phases(folder).items():
                name = ", ".join(part for part in (title, variant, words(phase)) if part)
                curves = read_curves(logged)
                charts += stage_charts(name, curves)
                rows.append(stage_row(name, curves))
    if not charts:
        return Section(
            "training", "Training", missing="no training stage was given (inputs train_stage1, train_stage2, ...)."
        )
    lead = (
        "This run's own training, from the base model on. Pale: every logged mean; strong: running mean. Held-out losses always use"
        " the same clips, noise and noise levels, with the averaged weights."
    )
    table = Table(("Stage", "Steps", "First loss", "Last loss", "Last held-out loss"), rows, range(1, 5))
    return context.section("training", "Training", lead, missing=missing, table=table, charts=charts)


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
        series = smooth(*curves["loss"]) if label == "loss" and "loss" in curves else []
        for name in names:
            for suffix, (condition, colour) in CONDITIONS.items():
                if name + suffix in curves:
                    steps, values = curves[name + suffix]
                    series.append(Series(condition, steps, values, colour=colour, markers=len(steps) < 40))
        if series:
            positive = all(value > 0 for item in series for value in item.y)
            charts.append(line_chart(series, title=f"{title}: {label}", x_label="step", y_label=label, log_y=positive))
    return charts


def smooth(steps: Sequence[float], values: Sequence[float]) -> list[Series]:
    """The curve in pale, thinned to means over equal stretches, and its running mean over a twentieth of it."""
    width = math.ceil(len(values) / MOST_POINTS)
    starts = range(0, len(values), width)
    means = [float(np.mean(values[i : i + width])) for i in starts]
    at = [steps[min(i + width, len(steps)) - 1] for i in starts]
    window = max(1, len(means) // 20)
    running = [float(np.mean(means[max(0, i + 1 - window) : i + 1])) for i in range(len(means))]
    return [Series("training", at, means, faint=True), Series("training", at, running)]


def stage_row(title: str, curves: Mapping[str, Curve]) -> list[object]:
    """Name, number of steps, first and last smoothed loss, last held-out loss."""
    steps, values = curves.get("loss", ([], []))
    _, held_out = curves.get("validation/loss", ([], []))
    means = smooth(steps, values)[1].y if values else []
    shown = [*(means[:1] or [None]), *(means[-1:] or [None]), *(held_out[-1:] or [None])]
    return [title, int(max(steps)) if steps else None, *[None if v is None else number(v, 4) for v in shown]]


def provenance_section(context: ReportContext) -> Section:
    """The weights with their cards, and the origin of each artifact; times and versions are filled in when the page opens."""
    if not context.inputs:
        return Section("provenance", "Provenance", missing="no artifact was given.")
    manifests = {name: read_json(folder / "manifest.json") for name, folder in sorted(context.inputs.items())}
    cards = {
        name: path.read_text(encoding="utf-8", errors="replace")
        for name, folder in context.variants("models").items()
        if (path := folder / "MODEL_CARD.md").is_file()
    }
    rows: list[list[object]] = []
    for name, manifest in manifests.items():
        seeds = ", ".join(f"{key} {json.dumps(value)}" for key, value in sorted((manifest.get("seeds") or {}).items()))
        digest = code(str(manifest["digest"])[:16]) if manifest.get("digest") else None
        rows.append([name, digest, manifest.get("version"), seeds or None])
    return context.section(
        "provenance",
        "Provenance",
        "The same configuration on the same inputs gives the same digests.",
        artifacts=Table(("Artifact", "Digest", "Version", "Seeds"), rows, caption="Artifacts that this report shows"),
        machine=context.slot("machine", render("report/machine.html", **machine_facts(manifests)), "See run/run.js."),
        configs={
            name: escape(json.dumps(manifest["config"], indent=2, sort_keys=True, ensure_ascii=False))  # uncut
            for name, manifest in manifests.items()
            if manifest.get("config") is not None
        },
        cards=cards,
    )


def machine_facts(manifests: Mapping[str, JsonObject]) -> dict[str, object]:
    """Machines, packages, and wall time and commit by artifact."""
    machines: set[str] = set()
    packages: set[str] = set()
    rows: list[list[object]] = []
    for name, manifest in manifests.items():
        environment = manifest.get("environment") or {}
        packages |= {f"{package} {version}" for package, version in (environment.get("packages") or {}).items()}
        machines |= {
            ", ".join(f"{key} {environment[key]}" for key in ("platform", "cpu_count", "python") if key in environment)
        }
        seconds, commit = manifest.get("wall_seconds"), environment.get("git_commit")
        shown = None if seconds is None else number(float(seconds), 1)
        rows.append([name, shown, manifest.get("finished_at"), code(commit) if commit else None])
    return {
        "machines": "; ".join(sorted(machines - {""})),
        "packages": ", ".join(sorted(packages)),
        "times": Table(("Artifact", "Seconds", "Finished", "Commit"), rows, [1]),
    }
