"""Pages of predicted videos, of their quality, policy and planning, training, and provenance with the models' cards. Episodes are
not picked by hand: the best, the median and the worst by a stated score are shown."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup, escape

from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.video.frames import VideoFrames
from worldline_core.distillation.distill_config import STEPS
from worldline_core.evaluation.metric_registry import METRICS, metric_of
from worldline_core.evaluation.paired import EVALUATIONS
from worldline_core.model.model_card import DESCRIPTIONS, Measurement, model_card, model_facts
from worldline_core.pages.page import Line, Table, interval, line_chart, render, words
from worldline_core.pictures import WrittenVideo, evenly_spaced, write_side_by_side
from worldline_core.report.context import (
    GROUPS,
    SPLIT_LABELS,
    Method,
    ReportContext,
    Section,
    VideoScores,
    headline_metrics,
    in_order,
    method,
    predicting,
    share_interval,
)
from worldline_core.store.artifact_files import (
    JsonObject,
    finished_artifacts,
    linked_folder,
    read_json,
    read_json_lines,
    read_manifest,
    verify_artifact,
)
from worldline_core.store.atomic import write_bytes_atomic
from worldline_core.training.training_state import PROBE_LOG

ALL = "all"

# Predicted videos: truth and predictions side by side, in each view
VIDEOS = "Predicted videos"
MOST_COLUMNS, IN_A_LINE = 6, 3
"""Width of one video: a phone shows three columns beside each other."""


class ChosenEpisode(NamedTuple):
    """An episode, the reason why it is shown, and its score."""

    episode_id: str
    reason: str
    score: float | None = None


def best_median_worst(values: Mapping[str, float], *, lower_is_better: bool = False) -> list[tuple[str, str, float]]:
    """(label, episode, value) of the median, best and worst of a score; ties by name."""
    ranked = sorted(values.items(), key=lambda item: (-item[1] if lower_is_better else item[1], item[0]))
    chosen: dict[tuple[str, float], str] = {}
    for label, place in (("median", (len(ranked) - 1) // 2), ("best", -1), ("worst", 0)) if ranked else ():
        chosen.setdefault(ranked[place], label)
    return [(label, *item) for item, label in chosen.items()]


def choose_episodes(scores: VideoScores, available: Sequence[str]) -> list[ChosenEpisode]:
    """Median, best and worst by the main method's headline of the first held-out group, and the median of every further one.

    ``available`` have predicted videos; without scores the first, middle and last of them are taken.
    """
    chosen: list[ChosenEpisode] = []
    for group in scores.groups:
        first = scores.primary(group)
        metric = first and scores.headline(group, first.name)
        if first is None or metric is None or group == "train":
            continue
        values = scores.series.get(f"video/{group}/{first.name}/{metric.name}@head", {})
        shown = {name: value for name, value in values.items() if name in available}
        ranked = best_median_worst(shown, lower_is_better=metric.lower_is_better)[: 1 if chosen else 3]
        where = f"of {len(values)} on {SPLIT_LABELS[group]}"
        chosen += [ChosenEpisode(episode, f"{label} {where}", value) for label, episode, value in ranked]
    ordered = sorted(available)
    return chosen or [
        ChosenEpisode(ordered[i], f"number {i + 1} of {len(ordered)} by name (no scores)")
        for i in evenly_spaced(len(ordered), 3)
    ]


def videos_section(context: ReportContext) -> Section:
    """A card for each chosen episode."""
    episodes, predicted = context.episodes, {n for rollout in context.rollouts.values() for n in rollout.episode_ids}
    known = predicted & {row.episode_id for row in episodes.rows} if episodes else set[str]()
    chosen = choose_episodes(context.video_scores, sorted(known)) if known else []
    if episodes is None or not chosen:
        missing = "no prediction of a given episode was given (inputs rollout.<method>, and filter or curate)."
        return Section("videos", VIDEOS, missing=missing)
    lead = "Every column starts from the same first frame; from there on a model sees only the controls."
    if any(item.score is not None for item in chosen):
        lead += (
            " The episodes are not chosen by hand: they are the median, the best and the worst by the first model's prediction of"
            " the robot."
        )
    cards = [card(context, episodes, *item) for item in enumerate(chosen)]
    context.first_card = next((found for found in cards if found["panels"]), None)
    return context.section("videos", VIDEOS, lead, cards=cards)


def methods_of_group(context: ReportContext, episode_id: str, group: str) -> list[Method]:
    """Methods with a prediction of this episode: those with the group's weights, then baselines without any."""
    methods = in_order([name for name, rollout in context.rollouts.items() if episode_id in rollout.episode_ids])
    own = [m for m in methods if m.group == group]
    return [*own, *[m for m in methods if m.group == "baseline"]][: MOST_COLUMNS - 1] if own else []


def card(context: ReportContext, episodes: EpisodeSet, number: int, item: ChosenEpisode) -> dict[str, Any]:
    """One episode: its description, and by view the truth beside each group's predictions."""
    name, position = item.episode_id, episodes.position(item.episode_id)
    row = episodes.rows[position]

    def panel(view: str) -> tuple[str, list[tuple[WrittenVideo, str]]]:
        written: list[tuple[WrittenVideo, str]] = []
        for group in ("shipped", "run"):
            shown = [(m.label, context.rollouts[m.name]) for m in methods_of_group(context, name, group)]
            columns = {
                label: VideoFrames(videos.clip(name, view)) for label, videos in shown if view in videos.views(name)
            }
            if columns:
                columns = {"true": VideoFrames(episodes.clip(position, view)), **columns}
                path, height = context.media / f"episode{number}_{group}_{view}.mp4", context.config.tile_height
                made = write_side_by_side(path, columns, row.fps, tile_height=height, most=IN_A_LINE)
                written.append((made, f"{GROUPS[group].capitalize()} ({words(view)} view, {made.num_frames} frames)."))
        return view, written

    # The report runs last and alone; encoder and resizing let go of the interpreter, so threads use the other cores.
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        panels = [found for found in pool.map(panel, [view for view in VIEWS if view in row.views]) if found[1]]
    return {"item": item, "row": row, "number": number, "panels": panels}


# Video quality

QUALITY = (
    "Mean over time for each trajectory, then over trajectories, with 95\u202f% bootstrap intervals over trajectories. Robot IoU,"
    " exact: a segmenter's mask of the prediction against the recording's exact mask. Robot IoU, segmenter: the same segmenter"
    " masks the true and the predicted video independently of each other."
)


def quality_section(context: ReportContext) -> Section:
    """Tables and charts by split, and the cost of predictions."""
    scores = context.video_scores
    if not scores.groups:
        return Section("quality", "Video quality", missing="no video evaluation was given (input evaluate_video).")
    return context.section(
        "quality",
        "Video quality",
        QUALITY,
        instruments=[(s["description"], instrument_accuracy(scores, s)) for s in scores.summary["segmenters"]],
        unavailable=sorted(scores.summary["unavailable"].items()),
        groups=[
            (
                SPLIT_LABELS[group].capitalize(),
                [table for view in VIEWS for table in metric_tables(scores, group, view)],
                *beside_the_main_method(scores, group),
            )
            for group in scores.groups
        ],
        cost=cost(context),
    )


def instrument_accuracy(scores: VideoScores, segmenter: JsonObject) -> list[tuple[str, Markup | None]]:
    """IoU of a segmenter's masks of true frames with the exact ones, by group."""
    known, metric = segmenter["accuracy_on_true_frames"], f"robot_iou_exact{segmenter['suffix']}@head"
    measured = [(group, known.get(group, {}).get(metric)) for group in scores.groups]
    return [(SPLIT_LABELS[group], interval(value, 3)) for group, value in measured if value is not None]


def metric_tables(scores: VideoScores, group: str, view: str) -> list[Table]:
    """Methods in rows, metrics of one view in columns, up to eight; the best of each column in bold."""
    names = {name.partition("@") for found in scores.metrics[group].values() for name in found if metric_of(name)}
    order = [*METRICS]
    measured = [name for name, _, of_view in names if of_view == view]
    shown = sorted(measured, key=lambda n: ("[" in n, order.index(n.partition("[")[0]), n))
    methods, tables = scores.methods(group), list[Table]()
    for metrics in (shown[i : i + 8] for i in range(0, len(shown), 8)):
        rows: list[list[object]] = [[m.long_label] for m in methods]
        headings, counts = ["Method"], [0]
        for metric in metrics:
            base, _, variant = metric.partition("[")
            entry = METRICS[base]
            found = [scores.value(group, m.name, f"{metric}@{view}") for m in methods]
            best = (min if entry.lower_is_better else max)(value["mean"] for value in found if value)
            for row, value in zip(rows, found, strict=True):
                cell = interval(value, entry.digits)
                row.append(Markup("<strong>{}</strong>").format(cell) if value and value["mean"] == best else cell)
            headings.append(f"{entry.heading}, {variant.rstrip(']')}" if variant else entry.heading)
            counts += [value["count"] for value in found if value]
        caption = f"{words(view).capitalize()} view; trajectories: {max(counts)}. Best of each column in bold."
        tables.append(Table(headings, rows, range(1, len(headings)), caption, dense=True))
    return tables


def beside_the_main_method(scores: VideoScores, group: str) -> tuple[Table | None, list[Markup]]:
    """The head view's headline: the main method minus every other; and charts of headline and SSIM along time."""
    primary = scores.primary(group)
    metric = primary and scores.headline(group, primary.name)
    if primary is None:
        return None, []
    found = metric and {
        m: scores.difference(group, primary.name, m.name, f"{metric.name}@head") for m in scores.methods(group)
    }
    rows = [(m.long_label, interval(value, 3, signed=True)) for m, value in (found or {}).items() if value]
    headings = f"{primary.long_label} minus", metric.heading if metric else ""
    table = Table(headings, rows, [1], "Paired over trajectories, head view") if rows else None
    drifts = list[Markup]()
    for drifting in filter(None, (metric, METRICS["ssim"])):
        series = list[Line]()
        for m in scores.methods(group):
            key = m.name, group, "head", drifting.name
            shown = [row for row in scores.by_frame if (row["method"], row["split"], row["view"], row["metric"]) == key]
            if points := sorted((row["frame"], row["mean"]) for row in shown):
                series.append(Line(m.long_label, *zip(*points, strict=True), colour=m.colour, dashed=m.group == "run"))
        if series:
            title = f"{drifting.title} along the prediction"
            drifts.append(line_chart(series, title=title, x_label="frame (0 is given)", y_label=drifting.title))
    return table, drifts


def cost(context: ReportContext) -> Markup | None:
    """Time per frame; a slot, because times differ from run to run."""
    timed = {name: read_json(rollout.root / "run" / "speed.json") for name, rollout in context.rollouts.items()}
    timed = {name: content for name, content in timed.items() if content.get("seconds_per_frame") is not None}
    rows = [(method(name), name.startswith("banks_"), content) for name, content in timed.items()]
    devices = sorted({str(content.get("device_name") or "unknown device") for content in timed.values()})
    table = render("report/cost.html", rows=rows, devices=devices)
    return context.slot("cost", table, "Recorded when the report was made; see run/run.js.") if rows else None


# Policy and planning


def decisions_section(context: ReportContext) -> Section:
    """The policy evaluation, then the planning evaluation."""
    judged, planned = context.summary("evaluate_policy"), context.summary("evaluate_planning")
    title = "Policy and planning"
    if judged is None and planned is None:
        return Section("decisions", title, missing="inputs evaluate_policy and evaluate_planning.")
    policy, planning = judged and policy_evaluation(judged), planned and planning_evaluation(planned)
    return context.section("decisions", title, policy=policy, planning=planning)


def policy_evaluation(summary: JsonObject) -> dict[str, object]:
    """Values of a policy evaluation for the template."""
    results, methods = summary["methods"], in_order(summary["methods"])
    accuracy = {
        m.name: {
            group: share_interval(found["accuracy"]) for group, found in results[m.name].items() if "/" not in group
        }
        for m in methods
    }
    groups = {group for own in accuracy.values() for group in own}
    return {
        "summary": summary,
        "methods": methods,
        "accuracy": accuracy,
        "groups": {
            group: words(SPLIT_LABELS.get(group, group)).capitalize()
            for group in sorted(groups, key=lambda g: (g != ALL, g not in SPLIT_LABELS, g))
        },
        "undecided": any(results[m.name][ALL]["undecided"]["share"] for m in methods),
        "ranked": in_order(summary.get("policies", ())),
        "trusted": predicting(summary.get("trust", {}).get("methods", ())),
    }


def planning_evaluation(summary: JsonObject) -> dict[str, object]:
    """Values of a planning evaluation for the template."""
    methods, order = summary["methods"], in_order(summary["methods"])
    budgets = sorted({int(n) for values in methods.values() for n in values["budgets"]})
    cases = {"count": len(summary["banks"])}
    success = {
        m.name: {
            int(n): share_interval({**cases, **found["success"]}) for n, found in methods[m.name]["budgets"].items()
        }
        for m in order
    }
    families = sorted({bank["task_family"] for bank in summary["banks"].values()})
    most = f"N = {budgets[-1]}"
    return {
        "summary": summary,
        "methods": order,
        "success": success,
        "budgets": budgets,
        "families": families,
        "areas": [
            *((m.long_label, summary["areas"]["methods"][m.name]) for m in order if m.name in summary["areas"]["methods"]),
            *((words(name), areas) for name, areas in summary["areas"]["shortcuts"].items()),
        ],
        "headings": [
            *(f"N = {n}" for n in budgets), f"Gain at {most}", "over the best shortcut",
            *(f"{words(family)}, {most}" for family in families),
        ],
    }  # fmt: skip


def most_candidates(values: JsonObject) -> JsonObject:
    """A method's result among the most candidates."""
    return values["budgets"][max(values["budgets"], key=int)]


# Training

STAGES = {
    "train_tokenizer": "Video tokenizer",
    "train_stage1": "Stage I: action-free, text-conditioned",
    "train_stage2": "Stage II: action-driven",
    "distill": "Distillation",
}
PHASES = ("", *STEPS)
METRICS_FILE = "metrics.jsonl"
PARTS = 60
"""A training loss is drawn as the means of so many parts of the run."""
CONDITIONS = {
    "": ("held-out", "c1"),
    "_shuffled_actions": ("held-out, shuffled actions", "c3"),
    "_no_actions": ("held-out, no actions", "c4"),
    "_copy": ("held-out, copy first frame", "c5"),
}
LOSSES = {"parts": ("training", "c0"), **{f"validation/loss{suffix}": shown for suffix, shown in CONDITIONS.items()}}
LATENT_ERRORS = {
    f"validation/{error}{suffix}": shown
    for error in ("sample_error", "rollout_error")
    for suffix, shown in CONDITIONS.items()
}
TOOL_ERRORS = {
    "tool_error_px": ("true controls", "c1"),
    "tool_error_px_shuffled": ("another clip's controls", "c3"),
    "tool_error_px_copy": ("copy first frame", "c5"),
}
"""Logged numbers of each chart, their labels and colours."""

Curves = dict[str, tuple[list[float], list[float]]]
"""Steps and values by name."""


def training_section(context: ReportContext) -> Section:
    """Charts of every stage's losses and held-out errors, and of the tool error as it was measured during training."""
    charts: list[Markup] = []
    given = {step: context.inputs[step] for step in STAGES if step in context.inputs}
    for step, folder in given.items():
        for phase in PHASES:
            title = f"{STAGES[step]}, {words(phase)}" if phase else STAGES[step]
            curves = read_curves(folder / phase / METRICS_FILE)
            if loss := curves.get("loss"):
                steps, values = (np.array_split(numbers, min(len(numbers), PARTS)) for numbers in loss)
                curves["parts"] = [float(part[-1]) for part in steps], [float(part.mean()) for part in values]
            charts += curve_chart(f"{title}: loss", "loss", curves, LOSSES)
            charts += curve_chart(f"{title}: squared latent error", "squared latent error", curves, LATENT_ERRORS)
            probed = read_curves((folder / "run" / phase if phase else folder) / PROBE_LOG)
            for chart in curve_chart(f"{title}: tool error after a second", "px", probed, TOOL_ERRORS):
                charts.append(context.slot(f"following-{step}-{phase}", chart, "See run/run.js."))
    if not charts:
        return Section(
            "training", "Training", missing="no training stage was given (inputs train_stage1, train_stage2, ...)."
        )
    lead = (
        f"This run's own training, from the base model on. Training loss: means of {PARTS} parts. Held-out losses always use"
        " the same clips, noise and noise levels, with the averaged weights. Tool error: how far the tools are from where the"
        " controls put them; a model that follows its controls is worse under another clip's."
    )
    return context.section("training", "Training", lead, charts=charts)


def read_curves(file: Path) -> Curves:
    """The curve of every logged number, finite values alone."""
    curves: Curves = {}
    for row in read_json_lines(file):
        for name, value in row.items():
            if isinstance(value, (int, float)) and math.isfinite(value):
                steps, values = curves.setdefault(name, ([], []))
                steps.append(float(row["step"]))
                values.append(float(value))
    return curves


def curve_chart(title: str, y_label: str, curves: Curves, shown: Mapping[str, tuple[str, str]]) -> list[Markup]:
    """A chart of some curves, logarithmic where all values are positive; nothing where none was logged."""
    series = [
        Line(label, *curves[name], colour=colour, markers=len(curves[name][0]) < 40)
        for name, (label, colour) in shown.items()
        if name in curves
    ]
    positive = all(value > 0 for item in series for value in item.y)
    return [line_chart(series, title=title, x_label="step", y_label=y_label, log_y=positive)] if series else []


# Models and their cards

VIDEO_METRICS = ("robot_iou_exact", "robot_iou", "object_iou_exact", "ssim", "psnr", "lpips")


def evaluations_of_store(store: Path) -> list[Path]:
    """Finished evaluations of a store, the oldest first."""
    found = [folder for folder in finished_artifacts(store) if folder.parent.name in EVALUATIONS]
    return sorted(found, key=lambda folder: str(read_manifest(folder).get("finished_at")))


def measurements(model: Path, evaluations: Iterable[Path]) -> Sequence[Measurement]:
    """Headline figures of a model: of the rollouts whose manifest names its digest, with the recorded controls.

    Args:
        evaluations: finished ones; a later one counts where two measured the same.

    Raises: ArtifactError: an evaluation is damaged.
    """
    digest, found = read_manifest(model).get("digest"), dict[tuple[str, str], Measurement]()
    for folder in evaluations:
        verify_artifact(folder)
        manifest = read_manifest(folder)
        for what, group, videos, metric, value in headline_metrics(manifest.get("step", ""), folder):
            rollout, shown = linked_folder(folder, f"rollouts.{videos}"), method(videos)
            made_by = {} if rollout is None else read_manifest(rollout).get("inputs", {}).get("checkpoint", {})
            if digest is None or made_by.get("digest") != digest or shown.kind.endswith(("_zero", "_shuffled")):
                continue
            metric, _, view = metric.partition("@")
            if what == "video" and (metric not in VIDEO_METRICS or view != "head"):
                continue
            labels = {"policy": "outcomes judged rightly", "planning": f"plans that succeed, best of {group[2:]}"}
            label = labels.get(what) or f"{METRICS[metric].title}, head view"
            label += f", {shown.label}" if "steps" in videos else ""
            recordings = {"policy": "all splits", **SPLIT_LABELS}.get(
                what if group == ALL else group, "candidate banks"
            )
            bounds = asdict(value) if what == "video" else share_interval(asdict(value))
            source = f"{manifest.get('step')}/{manifest.get('key')}"
            found[label, recordings] = Measurement(label, recordings, **bounds, source=source)
    return [found[name] for name in sorted(found)]


def provenance_section(context: ReportContext) -> Section:
    """The models with their cards, and the origin of each artifact; times and versions are filled in when the page opens."""
    if not context.inputs:
        return Section("provenance", "Provenance", missing="no artifact was given.")
    manifests = {name: read_json(folder / "manifest.json") for name, folder in sorted(context.inputs.items())}
    rows: list[list[object]] = []
    for name, manifest in manifests.items():
        seeds = ", ".join(f"{key} {json.dumps(value)}" for key, value in sorted((manifest.get("seeds") or {}).items()))
        digest = Markup("<code>{}</code>").format(str(manifest["digest"])[:16]) if manifest.get("digest") else None
        rows.append([name, digest, manifest.get("version"), seeds or None])
    folders = {name.removeprefix("models."): path for name, path in context.inputs.items()}
    models = {n: path for n, path in folders.items() if any((path / file).is_file() for file in DESCRIPTIONS)}
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


def written_card(context: ReportContext, name: str, folder: Path) -> str | None:
    """``cards/<name>.md``: the card that came with a model, or one from the run's artifacts; None for a tokenizer without one."""
    given, file = folder / "MODEL_CARD.md", f"cards/{safe_stem(name)}.md"
    if not given.is_file() and not (folder / DESCRIPTIONS[0]).is_file():
        return None
    evaluations = [context.inputs[step] for step in EVALUATIONS if step in context.inputs]
    made = None if given.is_file() else model_card(folder, measurements(folder, evaluations)).encode()
    write_bytes_atomic(context.output / file, given.read_bytes() if made is None else made)
    return file
