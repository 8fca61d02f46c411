"""Section "In short": the run's headline numbers."""

from __future__ import annotations

from worldline_core.report.context import ReportContext, Section
from worldline_core.report.markup import element, join, notice, number
from worldline_core.report.methods import GROUP_LABELS, Method
from worldline_core.report.sections.efficiency import efficiency_tile
from worldline_core.report.sections.planning import planning_tiles
from worldline_core.report.sections.policy import policy_tiles
from worldline_core.report.tiles import Tile, bounds, render_tile
from worldline_core.report.video_scores import SPLIT_LABELS, VideoScores
from worldline_core.store.artifact_files import read_rows

TITLE = "In short"


def summary_section(context: ReportContext) -> Section:
    """Tiles for whatever was measured."""
    tiles = [*video_tiles(context), *planning_tiles(context), *policy_tiles(context), *data_tiles(context)]
    slot = context.slot("efficiency_tile", efficiency_tile(context), fallback=None)
    if not tiles:
        return Section(
            "summary", TITLE, body=notice("Nothing was measured yet: the sections below show what there is.")
        )
    return Section("summary", TITLE, body=join(element("div", [render_tile(t) for t in tiles], class_="tiles"), slot))


def video_tiles(context: ReportContext) -> list[Tile]:
    """Robot IoU of the main method, what the controls are worth, and what the causal model keeps of it."""
    scores = context.video_scores
    group = scores.groups[0] if scores.groups else None
    primary = scores.primary(group, context.config.primary_method) if group else None
    metric = scores.iou_metric(group, primary.name) if group and primary else None
    if group is None or primary is None or metric is None:
        return []
    where = SPLIT_LABELS.get(group, group)
    found = scores.value(group, primary.name, f"{metric}@head")
    tiles: list[Tile] = []
    if found is not None:
        how = f"{where}, head view, {found['count']} trajectories; {bounds(found['low'], found['high'])}"
        tiles.append(Tile(number(float(found["mean"]), 2), f"robot IoU, {primary.long_label}", how))
    tiles += comparison_tiles(scores, group, primary, metric)
    causal = next((m for m in scores.methods(group) if m.kind == "causal" and m.group == primary.group), None)
    kept = scores.value(group, causal.name, f"{metric}@head") if causal else None
    if found is not None and kept is not None and causal is not None and found["mean"]:
        share = kept["mean"] / found["mean"]
        how = f"IoU {kept['mean']:.3f} in 4 steps a block against {found['mean']:.3f}"
        tiles.append(
            Tile(
                f"{100 * share:.0f}\u202f%",
                "of its robot IoU kept by the causal model",
                how,
                "good" if share >= 0.85 else "bad",
            )
        )
    other = next((m for m in scores.methods(group) if m.kind == primary.kind and m.group != primary.group), None)
    beside = scores.value(group, other.name, f"{metric}@head") if other else None
    if other is not None and beside is not None:
        how = f"minutes of training; {bounds(beside['low'], beside['high'])}"
        tiles.append(
            Tile(number(float(beside["mean"]), 2), f"robot IoU, {other.label} of {GROUP_LABELS[other.group]}", how)
        )
    return tiles


def comparison_tiles(scores: VideoScores, group: str, primary: Method, metric: str) -> list[Tile]:
    """Gaps to shuffled actions and to copying the first frame."""
    tiles: list[Tile] = []
    for kind, what in (
        (f"{primary.kind}_shuffled", "IoU over the same weights with shuffled actions"),
        ("copy", "IoU over copying the first frame"),
    ):
        other = next(
            (m for m in scores.methods(group) if m.kind == kind and m.group in (primary.group, "baseline")), None
        )
        found = scores.difference(group, primary.name, other.name, f"{metric}@head") if other else None
        if found is not None:
            sign = "+" if found["mean"] > 0 else ""
            mood = "good" if found["low"] > 0 else "bad" if found["high"] < 0 else ""
            tiles.append(
                Tile(
                    sign + number(float(found["mean"]), 2),
                    what,
                    f"paired; {bounds(found['low'], found['high'], signed=True)}",
                    mood,
                )
            )
    return tiles


def data_tiles(context: ReportContext) -> list[Tile]:
    """Episodes kept of those found."""
    curated, kept = context.inputs.get("curate"), context.inputs.get("filter")
    if curated is None:
        return []
    rows, refused = read_rows(curated / "index.parquet"), read_rows(curated / "quarantine.parquet")
    count = len(rows) if kept is None else len({row["episode_id"] for row in read_rows(kept / "index.parquet")})
    robots = len({row["embodiment"] for row in rows})
    how = f"{robots} robots, {len({row['scene'] for row in rows})} scenes; the rest is in quarantine with its reason"
    return [Tile(number(count), f"of {number(len(rows) + len(refused))} episodes kept", how)]
