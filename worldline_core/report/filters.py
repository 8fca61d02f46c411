"""What the filters did with each episode, and the page "Filters": the funnel, each reason's count, and an example of each."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.actions.overlays import draw_overlay
from worldline_core.data.episodes.episode_index import EpisodeRow, QuarantineRow, read_index, read_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.pages.charts import funnel_chart
from worldline_core.pages.page import Table, code
from worldline_core.pictures import Picture, SheetRow, contact_sheet, evenly_spaced
from worldline_core.report.context import ReportContext, Section
from worldline_core.store.artifact_files import JsonObject, read_rows

TITLE = "Filters"
MOMENTS = 5
SHOWN_HEIGHT = 128
QUARANTINED, NOT_STAGE2, CUT = EFFECTS = ("quarantined", "kept for Stage I only", "frames cut")

KEPT = "kept"
NUMBERS_SHOWN = 6
UNITS = {"_rad_s": " rad/s", "_deg": "°", "_rad": " rad", "_px": " px", "_s": " s", "_m": " m"}
"""Longest suffixes first."""


@dataclass(frozen=True)
class FilteredEpisode:
    """One curated episode and what became of it.

    Attributes:
        dropped: why it was dropped whole; None for a kept one.
        kept: its segments in the filtered set.
        findings: rows of findings.parquet, their numbers parsed.
    """

    episode_id: str
    dropped: QuarantineRow | None
    kept: Sequence[EpisodeRow]
    findings: Sequence[JsonObject]

    @property
    def stage2_reason(self) -> str | None:
        """Why a kept one is barred from Stage II."""
        return next((row.stage2_reason or "unfit for Stage II" for row in self.kept if not row.stage2_ok), None)

    @property
    def cut_by(self) -> Counter[str]:
        """Reasons that cut frames out of a kept episode, and how many."""
        counts: Counter[str] = Counter()
        for finding in self.findings if self.dropped is None else ():
            counts[finding["detector"]] += finding["cut_frames"]
        return +counts

    @property
    def reasons(self) -> list[str]:
        """Every reason that it is an example of; `kept` for one that nothing happened to."""
        if self.dropped is not None:
            return [self.dropped.reason]
        return list(dict.fromkeys([*self.cut_by, *filter(None, [self.stage2_reason])])) or [KEPT]


def read_outcomes(folder: Path) -> dict[str, FilteredEpisode]:
    """Every episode that a filter step has judged, by id.

    Raises: DataError, ArtifactError: a table of the step is missing or damaged.
    """
    dropped = {row.episode_id: row for row in read_quarantine(folder)}
    kept: dict[str, list[EpisodeRow]] = {}
    for row in read_index(folder):
        kept.setdefault(episode_of(row.episode_id), []).append(row)
    findings: dict[str, list[JsonObject]] = {}
    for row in read_rows(folder / "findings.parquet"):
        findings.setdefault(row["episode_id"], []).append(row | {"numbers": json.loads(row["numbers"])})
    return {
        name: FilteredEpisode(name, dropped.get(name), kept.get(name, ()), findings.get(name, ()))
        for name in sorted({*dropped, *kept, *findings})
    }


def episode_of(name: str) -> str:
    """The episode that a kept row was cut from: `episode@00120` is a segment of `episode`."""
    episode, _, start = name.rpartition("@")
    return episode if episode and len(start) == 5 and start.isdigit() else name


def numbers_text(numbers: Mapping[str, Any]) -> str:
    """The first measured values in one line, each with its unit."""
    shown = [
        with_unit(key, value)
        for key, value in numbers.items()
        if isinstance(value, (int, float, str)) and not isinstance(value, bool) and key != "picture"
    ]
    return " · ".join(shown[:NUMBERS_SHOWN])


def with_unit(key: str, value: float | str) -> str:
    """`longest_still_s: 2.1` as `longest still 2.1 s`: names end in their unit."""
    suffix, unit = next(((end, unit) for end, unit in UNITS.items() if key.endswith(end)), ("", ""))
    shown = f"{value:.3g}" if isinstance(value, float) else str(value)
    return f"{key.removesuffix(suffix).replace('_', ' ')} {shown}{unit}"


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


def filter_refusals(episode: FilteredEpisode) -> list[Refusal]:
    """That the filters dropped an episode, or barred it from Stage II and cut frames out of it."""
    name, dropped = episode.episode_id, episode.dropped
    if dropped is not None:
        view = next((f["view"] for f in episode.findings if f["detector"] == dropped.reason), None)
        return [Refusal("filter", dropped.reason, QUARANTINED, name, dropped.detail, dropped.numbers, view)]
    found: list[Refusal] = []
    if episode.stage2_reason is not None:
        failed = [f for f in episode.findings if not f["passed"] and f["stage"] == 2]
        detectors = ", ".join(dict.fromkeys(str(f["detector"]).replace("_", " ") for f in failed))
        detail = f"found by {detectors}" if detectors else "see the step's findings"
        numbers = failed[0]["numbers"] if failed else {}
        found.append(Refusal("filter", episode.stage2_reason, NOT_STAGE2, name, detail, numbers, "head"))
    for f in episode.findings:
        if f["cut_frames"]:
            detail = f"{f['cut_frames']} frames cut"
            found.append(Refusal("filter", f["detector"], CUT, name, detail, f["numbers"], f["view"]))
    return found


def filters_section(context: ReportContext) -> Section:
    """Found, curated, kept, fit for each stage; and why the others were not."""
    curated, filtered = context.inputs.get("curate"), context.inputs.get("filter")
    if curated is None and filtered is None:
        return Section("filters", TITLE, missing="neither the curated nor the filtered EpisodeSet was given.")
    stages: list[tuple[str, int]] = []
    refusals: list[Refusal] = []
    kept = None
    if curated is not None:
        readable, refused = read_index(curated), read_quarantine(curated)
        stages += [("found in the sources", len(readable) + len(refused)), ("readable and complete", len(readable))]
        refusals += [Refusal("curate", r.reason, QUARANTINED, r.episode_id, r.detail, r.numbers) for r in refused]
    if filtered is not None:
        outcomes = read_outcomes(filtered).values()
        episodes = [episode.kept for episode in outcomes if episode.kept]
        stages.append(("kept, fit for Stage I", sum(rows[0].stage1_ok for rows in episodes)))
        stages.append(("fit for Stage II", sum(rows[0].stage2_ok for rows in episodes)))
        refusals += [refusal for episode in outcomes for refusal in filter_refusals(episode)]
        kept = (len(episodes), sum(map(len, episodes)), sum(row.num_frames for rows in episodes for row in rows))
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
        cards[item.reason] = {"image": image, "item": item, "numbers": numbers_text(item.numbers)}
    return list(cards.values()), sorted(unseen - set(cards))


def example_picture(context: ReportContext, item: Refusal) -> Picture | None:
    """The picture kept as evidence, or moments of the episode; None where nothing can be decoded."""
    folder = context.inputs.get(item.step)
    kept = item.numbers.get("picture")
    if folder is not None and isinstance(kept, str):
        path = (folder / kept).resolve()
        if path.is_file() and path.is_relative_to(folder.resolve()):
            with Image.open(path) as image:
                return np.asarray(image.convert("RGB"), dtype=np.uint8)
    if item.step != "filter" or "curate" not in context.inputs:
        return None
    try:
        return moments(context, item)
    except DataError:
        return None


def moments(context: ReportContext, item: Refusal) -> Picture:
    """A row of moments of a curated episode.

    Where calibration or clocks are at fault, the projected tools are drawn: that is where the fault shows.

    Raises:
        DataError: the set does not hold the episode, or cannot decode it.
    """
    episodes = EpisodeSet.open(context.inputs["curate"])
    index = episodes.position(item.episode_id)
    row = episodes.rows[index]
    view = item.view if item.view in row.views else row.primary_view
    chosen = evenly_spaced(row.video_frames, MOMENTS)
    frames = np.asarray(episodes.frames(index, view, chosen))
    if item.effect == NOT_STAGE2 and "render_actions" in context.inputs:
        tracks = ActionTracks.open(context.inputs["render_actions"])
        if item.episode_id in tracks:
            found = tracks.tracks(item.episode_id)
            if view in found.views and max(chosen) < found.num_frames:
                drawn = zip(frames, chosen, strict=True)
                frames = np.stack([draw_overlay(f, found, n, view, tile_height=SHOWN_HEIGHT) for f, n in drawn])
    return contact_sheet([SheetRow("", frames)], tile_height=SHOWN_HEIGHT, column_titles=[f"frame {i}" for i in chosen])
