"""The recordings: counts of an EpisodeSet, its dataset card as the Hugging Face hub reads it, and the page "Data and filters"."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from huggingface_hub import DatasetCard, DatasetCardData
from PIL import Image

from worldline_core.data.curation.rules import CURATION_FILE
from worldline_core.data.curation.source_table import WEIGHTS_FILE, SourceFacts, read_source_table
from worldline_core.data.episodes.episode import mentions_outcome
from worldline_core.data.episodes.episode_index import (
    INDEX_FILE,
    EpisodeRow,
    QuarantineRow,
    read_index,
    read_quarantine,
)
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.pages.page import Table, duration, render, words
from worldline_core.pictures import SheetRow, contact_sheet, evenly_spaced
from worldline_core.report.context import ReportContext, Section
from worldline_core.store.artifact_files import JsonObject, linked_folder, read_json, read_rows, verify_artifact
from worldline_core.store.atomic import write_bytes_atomic
from worldline_core.untrusted_text import cut, visible

TITLE = "Data and filters"
FINDINGS_FILE = "findings.parquet"
UNKNOWN = "unknown"
PAGE_ROWS, MOMENTS, OVERLAYS, MOST_LEAKS = 12, 6, 4, 4
LONGEST_CELL = 300
"""Characters of one cell of a Markdown table."""
HUB_LICENSES = re.compile(
    r"apache-2\.0|mit|bsd-[23]-clause|cc0-1\.0|cc-by(-nc)?(-sa|-nd)?-[234]\.[05]|odc-by|odbl|unknown"
)
"""Licences that the hub knows by name; every other one is "other" with its name beside it."""


@dataclass(frozen=True)
class DatasetFacts:
    """Tables of a finished EpisodeSet, curated or filtered, and of the set that it was filtered from.

    Attributes:
        rows: its episodes, or segments of episodes; curated: the episodes before the filters.
        curation: curation.json; weights: source_weights.json.
    """

    rows: list[EpisodeRow]
    curated: list[EpisodeRow]
    refused_by_curation: list[QuarantineRow]
    refused_by_filters: list[QuarantineRow]
    filtered: bool
    sources: list[SourceFacts]
    curation: JsonObject
    weights: JsonObject
    findings: list[JsonObject]

    @classmethod
    def read(cls, folder: Path, curated: Path | None = None) -> DatasetFacts:
        """Read the tables of an EpisodeSet; ``curated`` is the set that it was filtered from (default: by its manifest).

        Raises: DataError when it is none; ArtifactError when a table is damaged.
        """
        rows, refused = read_index(folder), read_quarantine(folder)
        filtered = (folder / FINDINGS_FILE).is_file()
        origin = (curated or _origin(folder, rows)) if filtered else folder
        return cls(
            rows=rows,
            curated=read_index(origin) if filtered and origin else rows,
            refused_by_curation=read_quarantine(origin) if origin else [],
            refused_by_filters=refused if filtered else [],
            filtered=filtered,
            sources=read_source_table(origin) if origin else [],
            curation=read_json(origin / CURATION_FILE) if origin else {},
            weights=read_json(origin / WEIGHTS_FILE) if origin else {},
            findings=read_rows(folder / FINDINGS_FILE),
        )

    @property
    def num_episodes(self) -> int:
        """Recorded episodes of which something was kept."""
        return len({(row.dataset, row.episode_index) for row in self.rows})

    @property
    def summary(self) -> str:
        """A sentence about size, and one about outcomes."""
        counts = [len({getattr(row, name) for row in self.rows} - {""}) for name in ("scene", "instruction")]
        return (
            f"{recorded_time(self.rows)} in {self.num_episodes} episodes ({len(self.rows)} segments), {counts[0]} scenes,"
            f" {counts[1]} instructions. Outcomes are labels for evaluation and never reach a model."
        )

    @property
    def num_found(self) -> int:
        """Episodes that the sources held."""
        return len(self.curated) + len(self.refused_by_curation)

    @property
    def funnel(self) -> Table:
        """Numbers left after each step, in episodes, then in segments."""
        filtered = [("kept by the filters", self.num_episodes), ("segments of these", len(self.rows))]
        steps = [
            ("episodes found", self.num_found),
            ("kept by curation", len(self.curated)),
            *(filtered if self.filtered else []),
            ("fit for Stage I", sum(row.stage1_ok for row in self.rows)),
            ("fit for Stage II", sum(row.stage2_ok for row in self.rows)),
        ]
        return Table(("Step", "Number"), steps, [1])

    @property
    def reason_table(self) -> Table:
        """Step, reason, count and an example of everything that was refused, the most frequent first."""
        refused = [("curation", row.reason, f"{row.episode_id}: {row.detail}") for row in self.refused_by_curation]
        refused += [("filters", row.reason, f"{row.episode_id}: {row.detail}") for row in self.refused_by_filters]
        cut_rows = [row for row in self.findings if row["cut_frames"]]
        refused += [
            ("filters, frames cut", row["detector"], f"{row['episode_id']}: {row['cut_frames']} frames")
            for row in cut_rows
        ]
        barred = [row for row in self.rows if row.stage2_reason]
        refused += [("kept for Stage I only", row.stage2_reason, row.episode_id) for row in barred]
        example = {(step, reason): text.partition("\n")[0] for step, reason, text in reversed(refused)}
        counts = Counter((step, reason) for step, reason, _ in refused)
        order = sorted(counts, key=lambda key: (key[0], -counts[key], key[1]))
        return Table(("Step", "Reason", "Number", "For example"), [[*k, counts[k], example[k]] for k in order], [2])

    @cached_property
    def by_source(self) -> dict[str, SourceFacts | None]:
        """The configured source of every name, those without a kept episode included; None where it is not noted."""
        noted = {name: facts for facts in self.sources for name in (*facts.names, facts.label)}
        unseen = {facts.label for facts in self.sources if not facts.names}
        return {name: noted.get(name) for name in sorted({row.source for row in self.rows} | unseen)}

    @property
    def licenses(self) -> dict[str, list[str]]:
        """Sources by licence, "unknown" among them."""
        found: dict[str, list[str]] = defaultdict(list)
        for name, facts in self.by_source.items():
            found[UNKNOWN if facts is None else facts.license].append(name)
        return dict(sorted(found.items()))

    @property
    def source_table(self) -> Table:
        """Origin of the episodes, their numbers, and what their licences allow."""
        rows = []
        for name, noted in self.by_source.items():
            own, weight = [row for row in self.rows if row.source == name], self.weights.get(name)
            share = f"{100 * float(weight['share']):.1f} %" if weight else None
            rights = (UNKNOWN, UNKNOWN) if noted is None else (noted.license, noted.redistribution)
            kept = len({(row.dataset, row.episode_index) for row in own})
            rates = ", ".join(sorted({f"{row.fps:g}" for row in own})) or None
            rows.append([name, noted and noted.found, kept, recorded_time(own), rates, share, *rights])
        headings = "Source", "Found", "Kept", "Recorded", "fps", "Share in training", "Licence", "Redistribution"
        return Table(headings, rows, range(1, 6))

    @property
    def contents(self) -> list[tuple[str, Table]]:
        """Scenes, episodes, recorded time and outcomes by embodiment, task and split, each with a heading."""
        tables = []
        for title, name in (("Embodiments", "embodiment"), ("Tasks", "task_family"), ("Splits", "split")):
            rows: list[list[object]] = []
            for value in sorted({getattr(row, name) for row in self.rows}):
                own = [row for row in self.rows if getattr(row, name) == value]
                outcomes = Counter(row.outcome for row in own)
                counts = [outcomes[outcome] for outcome in ("success", "failure", "unknown")]
                rows.append([value, len({row.scene for row in own}), len(own), recorded_time(own), *counts])
            headings = (words(name).capitalize(), "Scenes", "Episodes", "Recorded", "Success", "Failure", "Unknown")
            tables.append((title, Table(headings, rows, range(1, 7))))
        return tables

    @property
    def leakage(self) -> str:
        """Scenes that both sides of the split share, or that look alike on them."""
        learnt = {row.scene for row in self.rows if row.split in ("train", "validation")}
        tested = {row.scene for row in self.rows if row.split in ("test", "ood_test")}
        notes = [f"None of the {len(tested)} test scenes is among the {len(learnt)} scenes of training and validation."]
        if shared := sorted(learnt & tested):
            notes = [f"Warning: {len(shared)} scenes are in training and in test ({', '.join(shared[:MOST_LEAKS])})."]
        if revealing := sum(mentions_outcome(row.instruction) for row in self.rows):
            notes.append(f"Warning: {revealing} instructions reveal the outcome, which models must not see.")
        leaks = self.curation.get("scene_leaks", [])
        pairs = [f"{leak['learning_scene']} and {leak['testing_scene']}" for leak in leaks[:MOST_LEAKS]]
        if self.curation.get("leakage_action", "off") == "off":
            notes.append("First images of scenes were not compared (curate.leakage.action).")
        else:
            named = f" ({'; '.join(pairs)})" if pairs else ""
            notes.append(f"{len(leaks)} pairs of scenes across the split look alike by their first images{named}.")
        return " ".join(notes)


def _origin(folder: Path, rows: Sequence[EpisodeRow]) -> Path | None:
    """The curated set that a filtered one was made from: by its manifest, else by the place of its datasets."""
    if (linked := linked_folder(folder, "episodes")) is not None or not rows:
        return linked
    holder = (folder / rows[0].dataset).resolve().parents[1]
    return holder if (holder / INDEX_FILE).is_file() else None


def recorded_time(rows: Iterable[EpisodeRow]) -> str:
    """Duration of the images of some rows."""
    return duration(sum(row.video_frames / row.fps for row in rows))


# Pictures


def choose_rows(rows: Sequence[EpisodeRow], positions: Iterable[int], most: int) -> list[int]:
    """Up to `most` positions, spread over embodiments, tasks and outcomes."""
    ordered = sorted(positions, key=lambda i: (rows[i].embodiment, rows[i].task_family, rows[i].outcome))
    return sorted(ordered[i] for i in evenly_spaced(len(ordered), most))


def sheet_rows(episodes: EpisodeSet, positions: Iterable[int]) -> tuple[list[SheetRow], list[str]]:
    """Six moments of each episode's primary view, titled; and a line on each one that could not be read."""
    shown: list[SheetRow] = []
    unreadable: list[str] = []
    for position in positions:
        row = episodes.rows[position]
        try:
            moments = evenly_spaced(row.video_frames, MOMENTS)
            frames = np.asarray(episodes.frames(position, row.primary_view, moments))
        except DataError as error:
            unreadable.append(f"No picture of {row.episode_id}: {error.what}")
            continue
        title = f"{row.embodiment}  ·  {row.instruction or '(no instruction)'}"
        note = f"{row.episode_id}  ·  {row.scene}  ·  {words(row.split)}  ·  {row.outcome}"
        shown.append(SheetRow(title, frames, note))
    return shown, unreadable


# The dataset card


def write_card(folder: Path, output: Path, title: str | None = None) -> Path:
    """Write the card of a finished EpisodeSet as ``output/README.md``; equal sets give equal bytes.

    Raises: DataError when the folder is no EpisodeSet; ArtifactError when it is damaged.
    """
    verify_artifact(folder)
    facts, heading = DatasetFacts.read(folder), title or f"EpisodeSet {folder.resolve().name}"
    text = render("report/card.md", facts=facts, heading=heading, plain=plain, table=markdown_table)
    license_name = re.sub(r"[^a-z0-9.+-]+", "-", " and ".join(facts.licenses).lower()).strip("-") or UNKNOWN
    known = HUB_LICENSES.fullmatch(license_name)
    datasets = sorted({row.dataset for row in facts.rows if not row.dataset.startswith("..")})
    header = DatasetCardData(
        pretty_name=heading,
        license=license_name if known else "other",
        license_name=None if known else license_name,
        task_categories=["robotics"],
        tags=["LeRobot", "WorldLine", "robotics", *sorted({row.embodiment for row in facts.rows})],
        configs=[{"config_name": Path(d).name, "data_files": f"{d}/data/*/*.parquet"} for d in datasets] or None,
    )
    card = DatasetCard(f"---\n{header.to_yaml()}\n---\n\n{text}\n")
    write_bytes_atomic(output / "README.md", str(card).encode())
    return output / "README.md"


def plain(text: str) -> str:
    """Recorded text in Markdown without markup, entities or line breaks, cut to a readable length."""
    escaped = re.sub(r"([\\`*\[\]<>#|&])", r"\\\1", visible(cut(" ".join(text.split()))))
    return re.sub(r"(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])", r"\\_", escaped)  # within a word it is no markup


def markdown_table(table: Table) -> str:
    """A table in Markdown, or nothing where it has no rows."""
    numeric = set(table.numeric)
    rule = ["---:" if position in numeric else "---" for position in range(len(table.headings))]
    rows = [["-" if cell is None else plain(cut(str(cell), LONGEST_CELL)) for cell in row] for row in table.rows]
    lines = [[plain(heading) for heading in table.headings], rule, *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) if rows else ""


# The page "Data and filters"


def dataset_facts(context: ReportContext) -> DatasetFacts | None:
    """Facts of the run's filtered set, or of the curated one; None without either."""
    curated = context.inputs.get("curate")
    folder = context.inputs.get("filter") or curated
    return None if folder is None else DatasetFacts.read(folder, curated)


def data_section(context: ReportContext) -> Section:
    """Counts of the recordings, the way from source to training with its reasons, and controls over the pictures."""
    facts, episodes = dataset_facts(context), context.episodes
    if facts is None or episodes is None:
        return Section("data", TITLE, missing="no EpisodeSet was given (inputs curate or filter).")
    rows, problems = sheet_rows(episodes, choose_rows(facts.rows, range(len(facts.rows)), PAGE_ROWS))
    sheet = context.picture("contact_sheet", contact_sheet(rows), alt="Recorded episodes") if rows else None
    tracks = context.inputs.get("render_actions")
    previews = [] if tracks is None else sorted((tracks / "previews").glob("*.png"))[:OVERLAYS]
    controls = [
        context.picture(f"actions_{n}", np.asarray(Image.open(path).convert("RGB")), alt="Controls over an episode")
        for n, path in enumerate(previews)
    ]
    return context.section("data", TITLE, facts.summary, facts=facts, sheet=sheet, controls=controls, problems=problems)
