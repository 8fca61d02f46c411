"""Pages "Training" and "Provenance": loss curves of every stage; weights, digests, configurations and times of every artifact."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from markupsafe import Markup, escape

from worldline_core.pages.charts import Dot, Series, interval_chart, line_chart
from worldline_core.pages.page import Table, code, number, render, words
from worldline_core.report.context import ReportContext, Section
from worldline_core.store.artifact_files import JsonObject, read_json, read_json_lines

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
MOST_PARTS, MOST_POINTS = 6, 400

Curve = tuple[list[float], list[float]]
"""Steps and values."""


def training_section(context: ReportContext) -> Section:
    """Charts of every stage's losses and a table of its first and last."""
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
        "This run's own training, from the base model on. Pale: every logged mean; strong: running mean. Held-out losses always use"
        " the same clips, noise and noise levels, with the averaged weights."
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
    """The curve of every logged number, finite values alone."""
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
    """The curve in pale, thinned to means over equal stretches, and its running mean."""
    steps, values = curve
    width = max(1, math.ceil(len(values) / MOST_POINTS))
    starts = range(0, len(values), width)
    means = [sum(values[i : i + width]) / len(values[i : i + width]) for i in starts]
    at = [steps[min(i + width, len(steps)) - 1] for i in starts]
    return [
        Series(label, at, means, colour=colour, faint=True),
        Series(label, at, running_mean(means), colour=colour),
    ]


def marked(label: str, curve: Curve, colour: str) -> Series:
    """A curve, with markers where its points are few."""
    steps, values = curve
    return Series(label, steps, values, colour=colour, markers=len(steps) < 40)


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


def provenance_section(context: ReportContext) -> Section:
    """The weights with their cards, and the origin of each artifact; times and versions are filled in when the page opens."""
    if not context.inputs:
        return Section("provenance", "Provenance", missing="no artifact was given.")
    manifests = {name: read_json(folder / "manifest.json") for name, folder in sorted(context.inputs.items())}
    models = {name: folder for name, folder in context.variants("models").items() if name}
    cards = {
        name: path.read_text(encoding="utf-8", errors="replace")
        for name, folder in models.items()
        if (path := folder / "MODEL_CARD.md").is_file()
    }
    weights = [
        [name, number(sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) / 1e6, 1), "yes" if name in cards else "no"]
        for name, folder in models.items()
    ]  # fmt: skip
    rows: list[list[object]] = []
    for name, manifest in manifests.items():
        seeds = ", ".join(f"{key} {json.dumps(value)}" for key, value in sorted((manifest.get("seeds") or {}).items()))
        digest = code(str(manifest["digest"])[:16]) if manifest.get("digest") else None
        rows.append([name, digest, str(manifest.get("version", "")) or None, seeds or None])
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
        weights=Table(("Weights", "Size, MB", "Card"), weights, [1]) if weights else None,
        cards=cards,
    )


def machine_facts(manifests: Mapping[str, JsonObject]) -> dict[str, object]:
    """Machines, packages, and wall time and commit by artifact."""
    rows: list[list[object]] = []
    packages: dict[str, set[str]] = {}
    machines: set[str] = set()
    for name, manifest in manifests.items():
        if not manifest:
            continue
        environment = manifest.get("environment") or {}
        for package, version in (environment.get("packages") or {}).items():
            packages.setdefault(package, set()).add(str(version))
        if environment:
            known = {key: environment.get(key, "?") for key in ("platform", "cpu_count", "python")}
            machines.add("{platform}, {cpu_count} cores, Python {python}".format(**known))
        seconds, commit = manifest.get("wall_seconds"), environment.get("git_commit")
        shown = number(float(seconds), 1) if isinstance(seconds, (int, float)) else None
        resumed = "yes" if manifest.get("resumed") else "no"
        rows.append([name, shown, resumed, manifest.get("finished_at"), code(commit) if commit else None])
    return {
        "machines": "; ".join(sorted(machines)) or "not recorded",
        "packages": ", ".join(f"{n} {'/'.join(sorted(v))}" for n, v in sorted(packages.items())) or "not recorded",
        "times": Table(("Artifact", "Seconds", "Resumed", "Finished", "Commit"), rows, [1]) if rows else None,
    }
