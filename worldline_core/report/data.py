"""Page "Data and filters": recorded episodes, what the filters did with each, and the controls over the pictures."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from PIL import Image

from worldline_core.actions.episode_tracks import ActionTracks, EpisodeTracks
from worldline_core.actions.overlays import OverlayStyle, draw_overlay, overlay_sheet
from worldline_core.data.episodes.episode_index import EpisodeRow, QuarantineRow, read_index, read_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.errors import DataError
from worldline_core.pages.charts import funnel_chart
from worldline_core.pages.page import Table, code, number, percent, with_note, words
from worldline_core.pictures import Picture, SheetRow, contact_sheet, evenly_spaced
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.dataset_card import DatasetFacts, choose_rows, sheet_rows
from worldline_core.store.artifact_files import JsonObject, read_json, read_rows

TITLE = "Data and filters"
SHEET_ROWS = 12
OVERLAYS = 4
MOMENTS = 5
SHOWN_HEIGHT = 128
QUARANTINED, NOT_STAGE2, CUT = EFFECTS = ("quarantined", "kept for Stage I only", "frames cut")
KEPT = "kept"
NUMBERS_SHOWN = 6
UNITS = {"_rad_s": " rad/s", "_deg": "°", "_rad": " rad", "_px": " px", "_s": " s", "_m": " m"}
"""Longest suffixes first."""
CAUSES = ("valid", "behind_camera", "outside_image", "invalid_calibration")


@dataclass(frozen=True)
class FilteredEpisode:
    """One curated episode after the filters.

    Attributes:
        dropped: the reason why it was dropped whole; None for a kept one.
        kept: its segments in the filtered set.
        findings: rows of findings.parquet, their numbers parsed.
    """

    episode_id: str
    dropped: QuarantineRow | None
    kept: Sequence[EpisodeRow]
    findings: Sequence[JsonObject]

    @property
    def stage2_reason(self) -> str | None:
        """The reason why a kept one is barred from Stage II."""
        return next((row.stage2_reason or "unfit for Stage II" for row in self.kept if not row.stage2_ok), None)

    @property
    def cut_by(self) -> Counter[str]:
        """Frames cut out of a kept episode, by reason."""
        counts: Counter[str] = Counter()
        for finding in self.findings if self.dropped is None else ():
            counts[finding["detector"]] += finding["cut_frames"]
        return +counts

    @property
    def reasons(self) -> list[str]:
        """Every reason that it is an example of; `kept` for one without any."""
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
    """One episode, the reason, its effect, and the numbers that show it; `view` is None where no single view is concerned."""

    step: str
    reason: str
    effect: str
    episode_id: str
    detail: str
    numbers: Mapping[str, Any] = field(default_factory=dict)
    view: str | None = None


def filter_refusals(episode: FilteredEpisode) -> list[Refusal]:
    """Refusals of one episode: dropped whole, barred from Stage II, frames cut."""
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


def data_section(context: ReportContext) -> Section:
    """Counts of the curated episodes, the way from source to training, reasons with examples, overlays."""
    curated, filtered = context.inputs.get("curate"), context.inputs.get("filter")
    folder = curated or filtered
    if folder is None:
        return Section("data", TITLE, missing="no EpisodeSet was given (inputs curate or filter).")
    facts = DatasetFacts.read(folder)
    rows, unreadable = sheet_rows(EpisodeSet.open(folder), choose_rows(facts.rows, range(len(facts.rows)), SHEET_ROWS))
    sheet = context.picture("contact_sheet", contact_sheet(rows), alt="Recorded episodes") if rows else None
    stages: list[tuple[str, int]] = []
    refusals: list[Refusal] = []
    kept = None
    if curated is not None:
        refused = read_quarantine(curated)
        stages = [("found in the sources", len(facts.rows) + len(refused)), ("readable and complete", len(facts.rows))]
        refusals += [Refusal("curate", r.reason, QUARANTINED, r.episode_id, r.detail, r.numbers) for r in refused]
    if filtered is not None:
        outcomes = read_outcomes(filtered).values()
        episodes = [episode.kept for episode in outcomes if episode.kept]
        stages.append(("kept, fit for Stage I", sum(segments[0].stage1_ok for segments in episodes)))
        stages.append(("fit for Stage II", sum(segments[0].stage2_ok for segments in episodes)))
        refusals += [refusal for episode in outcomes for refusal in filter_refusals(episode)]
        frames = sum(row.num_frames for segments in episodes for row in segments)
        kept = (len(episodes), sum(map(len, episodes)), frames)
    overlays, problems = overlay_pictures(context)
    return context.section(
        "data",
        TITLE,
        facts.summary,
        facts=facts,
        sheet=sheet,
        chart=funnel_chart(stages, title="Episodes from source to training"),
        kept=kept,
        reasons=reason_table(refusals),
        examples=examples(context, refusals),
        overlays=overlays,
        samples=sample_table(context),
        problems=[*(f"No picture of {line}" for line in unreadable), *problems],
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


def examples(context: ReportContext, refusals: Sequence[Refusal]) -> list[dict[str, object]]:
    """One picture for each reason whose episode can still be decoded."""
    cards: dict[str, dict[str, object]] = {}
    for item in sorted(refusals, key=lambda r: (EFFECTS.index(r.effect), r.reason, r.episode_id)):
        if item.reason in cards:
            continue
        picture = example_picture(context, item)
        if picture is not None:
            image = context.picture(f"refused_{safe_stem(item.reason)}", picture, alt=f"Example for {item.reason}")
            cards[item.reason] = {"image": image, "item": item, "numbers": numbers_text(item.numbers)}
    return list(cards.values())


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
    """A row of moments of a curated episode, with the projected tools where calibration or clocks are at fault.

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


def episode_overlay(
    episodes: EpisodeSet, index: int, tracks: EpisodeTracks, sigma_px_ref: float, title: str | None = None
) -> Picture:
    """Four moments of an episode in every view, with its tracks drawn over them.

    Raises:
        DataError: the episode has no view with a track, or its frames cannot be decoded.
    """
    row = episodes.rows[index]
    chosen = evenly_spaced(min(tracks.num_frames, row.video_frames), 4)
    frames = {view: np.asarray(episodes.frames(index, view, chosen)) for view in tracks.views if view in row.views}
    return overlay_sheet(frames, tracks, chosen, style=OverlayStyle(sigma_px_ref), title=title)


def overlay_pictures(context: ReportContext) -> tuple[list[tuple[Markup, EpisodeRow]], list[str]]:
    """The controls over one episode of each embodiment, held-out scenes preferred; and a line on each unreadable one."""
    folder, episodes = context.inputs.get("render_actions"), context.episodes
    if folder is None or episodes is None:
        return [], ["No action tracks were given (input render_actions)."]
    tracks = ActionTracks.open(folder)
    first: dict[str, int] = {}
    order = sorted(range(len(episodes)), key=lambda i: episodes.rows[i].episode_id)
    for index in sorted(order, key=lambda i: episodes.rows[i].split not in ("test", "ood_test")):
        row = episodes.rows[index]
        if row.bank is None and len(row.views) > 1:
            first.setdefault(row.embodiment, index)
    shown: list[tuple[Markup, EpisodeRow]] = []
    unreadable: list[str] = []
    for _, index in sorted(first.items())[:OVERLAYS]:
        row = episodes.rows[index]
        if row.episode_id not in tracks:
            continue
        try:
            picture = episode_overlay(episodes, index, tracks.tracks(row.episode_id), tracks.sigma_px_ref)
        except DataError as error:
            unreadable.append(f"No overlay of {row.episode_id}: {error.what}")
            continue
        alt = f"Action maps over {row.episode_id}"
        shown.append((context.picture(f"actions_{len(shown)}", picture, alt=alt), row))
    return shown, unreadable


def sample_table(context: ReportContext) -> Table | None:
    """Valid samples (frame, view, arm) of the action tracks, and the causes of the others, by embodiment."""
    folder = context.inputs.get("render_actions")
    counts = {} if folder is None else read_json(folder / "summary.json").get("by_embodiment", {})
    causes = [cause for cause in CAUSES if any(cause in numbers for numbers in counts.values())]
    rows = []
    for name, numbers in sorted(counts.items()):
        found = [numbers.get(cause, 0) for cause in causes]
        total = sum(found) or 1
        shares = [with_note(number(count), percent(count / total)) for count in found]
        rows.append([name, numbers.get("episodes"), *shares])
    headings = ["Embodiment", "Episodes", *[words(cause).capitalize() for cause in causes]]
    caption = "Samples of the action maps (one per frame, view and arm). Only valid ones are drawn; the others are masked to zero."
    return Table(headings, rows, range(1, len(headings)), caption) if causes else None
