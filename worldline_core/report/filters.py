"""Page "Filters": the funnel from found to trained on, each reason's count, and an example picture of each."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from worldline_core.actions.overlays import draw_overlay
from worldline_core.errors import DataError
from worldline_core.pages.charts import funnel_chart
from worldline_core.pages.page import Table, code
from worldline_core.pictures.contact_sheet import SheetRow, contact_sheet, evenly_spaced
from worldline_core.pictures.labels import Picture
from worldline_core.report.context import ReportContext, Section
from worldline_core.store.artifact_files import JsonObject, read_rows

TITLE = "Filters"
MOMENTS = 5
NUMBERS_SHOWN = 5
SHOWN_HEIGHT = 128
UNITS = {"_rad_s": " rad/s", "_deg": "°", "_rad": " rad", "_px": " px", "_s": " s", "_m": " m"}
"""Longest suffixes first."""
QUARANTINED = "quarantined"
NOT_STAGE2 = "kept for Stage I only"
CUT = "frames cut"
EFFECTS = (QUARANTINED, NOT_STAGE2, CUT)


@dataclass(frozen=True)
class Refusal:
    """One episode, the reason, what became of it, and the numbers that show it.

    `view` is where the finding was made, None when it concerns no single view.
    """

    step: str
    reason: str
    effect: str
    episode_id: str
    detail: str
    numbers: Mapping[str, Any] = field(default_factory=dict)
    view: str | None = None


def quarantine_refusals(step: str, folder: Path) -> list[Refusal]:
    """Rows of a step's quarantine."""
    findings = findings_by_episode(folder)
    refusals: list[Refusal] = []
    for row in read_rows(folder / "quarantine.parquet"):
        found = [f for f in findings.get(row["episode_id"], []) if f["detector"] == row["reason"]]
        view = found[0]["view"] if found else None
        numbers = evidence_of(row.get("evidence"))
        refusals.append(Refusal(step, row["reason"], QUARANTINED, row["episode_id"], row["detail"], numbers, view))
    return refusals


def filter_refusals(folder: Path) -> list[Refusal]:
    """Quarantine of the filters, kept episodes that Stage II cannot use, and kept episodes that lost frames."""
    refusals = quarantine_refusals("filter", folder)
    findings = findings_by_episode(folder)
    kept = read_rows(folder / "index.parquet")
    for row in first_of_each_episode(kept):
        if row.get("stage2_ok") is False:
            name = episode_of(row["episode_id"])
            failed = [f for f in findings.get(name, []) if not f["passed"] and f["stage"] == 2]
            detectors = ", ".join(dict.fromkeys(str(f["detector"]).replace("_", " ") for f in failed))
            reason = str(row.get("stage2_reason") or "unfit for Stage II")
            detail = f"found by {detectors}" if detectors else "see the step's findings"
            numbers = evidence_of(failed[0]["numbers"]) if failed else {}
            refusals.append(Refusal("filter", reason, NOT_STAGE2, name, detail, numbers, "head"))
    names = {episode_of(row["episode_id"]) for row in kept}
    for episode_id, rows in sorted(findings.items()):
        for row in rows:
            if row["cut_frames"] and episode_id in names:
                detail = f"{row['cut_frames']} frames cut"
                numbers = evidence_of(row["numbers"])
                refusals.append(Refusal("filter", row["detector"], CUT, episode_id, detail, numbers, row["view"]))
    return refusals


def findings_by_episode(folder: Path) -> dict[str, list[JsonObject]]:
    """Rows of the filters' findings by episode; a step without findings has none."""
    found: dict[str, list[JsonObject]] = {}
    for row in read_rows(folder / "findings.parquet"):
        found.setdefault(row["episode_id"], []).append(row)
    return found


def first_of_each_episode(rows: list[JsonObject]) -> list[JsonObject]:
    """One row per episode (an episode kept in several segments has several)."""
    return list({episode_of(row["episode_id"]): row for row in reversed(rows)}.values())[::-1]


def episode_of(name: str) -> str:
    """The episode that a kept row was cut from: `episode@00120` is a segment of `episode`."""
    episode, _, start = name.rpartition("@")
    return episode if episode and len(start) == 5 and start.isdigit() else name


def evidence_of(evidence: Any) -> JsonObject:
    """Evidence as an object; text that is not one gives an empty object."""
    if isinstance(evidence, dict):
        return evidence
    try:
        value = json.loads(evidence) if isinstance(evidence, str) else {}
    except json.JSONDecodeError:
        return {}
    return value if isinstance(value, dict) else {}


def filters_section(context: ReportContext) -> Section:
    """Found, curated, kept, fit for each stage; and why the others were not."""
    curated, filtered = context.inputs.get("curate"), context.inputs.get("filter")
    if curated is None and filtered is None:
        return Section("filters", TITLE, missing="neither the curated nor the filtered EpisodeSet was given.")
    stages: list[tuple[str, int]] = []
    refusals: list[Refusal] = []
    kept = None
    if curated is not None:
        readable, refused = read_rows(curated / "index.parquet"), read_rows(curated / "quarantine.parquet")
        stages += [("found in the sources", len(readable) + len(refused)), ("readable and complete", len(readable))]
        refusals += quarantine_refusals("curate", curated)
    if filtered is not None:
        segments = read_rows(filtered / "index.parquet")
        episodes = first_of_each_episode(segments)
        stages.append(("kept, fit for Stage I", sum(bool(row.get("stage1_ok", True)) for row in episodes)))
        stages.append(("fit for Stage II", sum(bool(row.get("stage2_ok", True)) for row in episodes)))
        refusals += filter_refusals(filtered)
        kept = (len(episodes), len(segments), sum(row["stop"] - row["start"] for row in segments))
    lead = (
        "Nothing is dropped silently: every input that did not get through is in quarantine with a reason code and the"
        " evidence; kept and quarantined together are what was found. Stage II needs three views, valid calibration,"
        " aligned clocks and a projection that agrees with the pictures; what fails only there stays for Stage I."
    )
    cards, without_picture = examples(context, refusals)
    return context.section(
        "filters",
        TITLE,
        lead,
        chart=funnel_chart(stages, title="Episodes from source to training"),
        kept=kept,
        reasons=reason_table(refusals),
        examples=cards,
        without_picture=without_picture,
    )


def reason_table(refusals: Sequence[Refusal]) -> Table | None:
    """Counts by reason and effect, with one detail each."""
    counted = Counter((item.effect, item.step, item.reason) for item in refusals)
    rows: list[list[object]] = []
    order = sorted(counted.items(), key=lambda entry: (EFFECTS.index(entry[0][0]), -entry[1], entry[0]))
    for (effect, step, reason), count in order:
        first = next(item for item in refusals if (item.effect, item.step, item.reason) == (effect, step, reason))
        rows.append([code(reason), step, effect, count, f"{first.episode_id}: {first.detail}"])
    return Table(("Reason", "Step", "Effect", "Episodes", "For example"), rows, [3], "Reasons") if rows else None


def examples(context: ReportContext, refusals: Sequence[Refusal]) -> tuple[list[dict[str, object]], list[str]]:
    """One picture for each reason whose episode can still be shown; and the reasons without one."""
    cards: dict[str, dict[str, object]] = {}
    unseen: set[str] = set()
    for item in sorted(refusals, key=lambda r: (EFFECTS.index(r.effect), r.reason, r.episode_id)):
        if item.reason in cards:
            continue
        picture = example_picture(context, item)
        if picture is None:
            unseen.add(item.reason)
            continue
        name = f"refused_{''.join(c if c.isalnum() else '_' for c in item.reason)}"
        image = context.picture(name, picture, alt=f"Example for {item.reason}", photo=True)
        cards[item.reason] = {"image": image, "item": item, "numbers": numbers_of(item)}
    return list(cards.values()), sorted(unseen - set(cards))


def example_picture(context: ReportContext, item: Refusal) -> Picture | None:
    """The picture kept as evidence, or moments of the episode; None where nothing can be decoded.

    Where calibration or clocks are at fault, the projected tools are drawn: that is where the fault shows.
    """
    folder = context.inputs.get(item.step)
    kept = item.numbers.get("picture")
    if folder is not None and isinstance(kept, str):
        path = (folder / kept).resolve()
        if path.is_file() and path.is_relative_to(folder.resolve()):
            from PIL import Image

            with Image.open(path) as image:
                return np.asarray(image.convert("RGB"), dtype=np.uint8)
    curated = context.inputs.get("curate")
    if item.step != "filter" or curated is None:
        return None
    try:
        return moments(context, curated, item)
    except DataError:
        return None


def moments(context: ReportContext, curated: Path, item: Refusal) -> Picture:
    """A row of moments of a curated episode.

    Raises:
        DataError: the set does not hold the episode, or cannot decode it.
    """
    from worldline_core.data.episodes.episode_set import EpisodeSet

    episodes = EpisodeSet.open(curated)
    index = episodes.position(item.episode_id)
    row = episodes.rows[index]
    view = item.view if item.view in row.views else row.primary_view
    chosen = evenly_spaced(row.video_frames, MOMENTS)
    frames = np.asarray(episodes.frames(index, view, chosen))
    if item.effect == NOT_STAGE2:
        frames = with_tools(context, item.episode_id, view, frames, chosen)
    return contact_sheet([SheetRow("", frames)], tile_height=SHOWN_HEIGHT, column_titles=[f"frame {i}" for i in chosen])


def with_tools(
    context: ReportContext, episode_id: str, view: str, frames: np.ndarray, chosen: Sequence[int]
) -> np.ndarray:
    """The frames with projected tools, enlarged; unchanged where there are no tracks of the episode."""
    from worldline_core.actions.episode_tracks import ActionTracks

    folder = context.inputs.get("render_actions")
    tracks = ActionTracks.open(folder) if folder is not None else None
    if tracks is None or episode_id not in tracks:
        return frames
    found = tracks.tracks(episode_id)
    if view not in found.views or max(chosen) >= found.num_frames:
        return frames
    drawn = [
        draw_overlay(frame, found, n, view, tile_height=SHOWN_HEIGHT) for frame, n in zip(frames, chosen, strict=True)
    ]
    return np.stack(drawn)


def numbers_of(item: Refusal) -> str:
    """The first numbers of the evidence."""
    facts = [
        with_unit(key, value)
        for key, value in sorted(item.numbers.items())
        if isinstance(value, (int, float)) and not isinstance(value, bool)
    ]
    return " · ".join(facts[:NUMBERS_SHOWN])


def with_unit(key: str, value: float) -> str:
    """`longest_still_s: 2.1` as `longest still 2.1 s`: names end in their unit."""
    suffix, unit = next(((end, unit) for end, unit in UNITS.items() if key.endswith(end)), ("", ""))
    shown = f"{value:.3g}" if isinstance(value, float) else str(value)
    return f"{key.removesuffix(suffix).replace('_', ' ')} {shown}{unit}"
