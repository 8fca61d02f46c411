"""The dataset card of an EpisodeSet: README.md as the Hugging Face hub reads it, and a contact sheet per source.

`DatasetFacts` counts the set's own tables; the report's page "Data and filters" shows the same tables as the card.
"""

from __future__ import annotations

import json
import re
from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from huggingface_hub import DatasetCard, DatasetCardData

from worldline_core.data.curation.rules import CURATION_FILE
from worldline_core.data.curation.source_table import WEIGHTS_FILE, SourceFacts, read_source_table
from worldline_core.data.episodes.episode_index import (
    INDEX_FILE,
    EpisodeRow,
    QuarantineRow,
    read_index,
    read_quarantine,
)
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.instructions import RAW_INSTRUCTION, mentions_outcome
from worldline_core.errors import DataError
from worldline_core.pages.page import Table, duration, render, words
from worldline_core.pictures import SheetRow, contact_sheet, evenly_spaced, jpeg_bytes
from worldline_core.store.artifact_files import JsonObject, linked_folder, read_json, read_rows, read_table
from worldline_core.store.atomic import write_bytes_atomic
from worldline_core.untrusted_text import cut, visible

FINDINGS_FILE = "findings.parquet"
CALIBRATION_DETECTORS = ("calibration", "projection", "doctor", "time_alignment")
UNKNOWN = "unknown"
PICTURES = "pictures"
ROWS_PER_SOURCE = 6
MOMENTS = 6
SHEET_WIDTH = 1180
MOST_INSTRUCTIONS = 15
MOST_LEAKS = 12
LONGEST_CELL = 300
"""Characters of one cell of a Markdown table."""

HUB_LICENSES = frozenset(
    [
        "apache-2.0",
        "mit",
        "bsd-2-clause",
        "bsd-3-clause",
        "cc0-1.0",
        "cc-by-2.0",
        "cc-by-2.5",
        "cc-by-3.0",
        "cc-by-4.0",
        "cc-by-sa-3.0",
        "cc-by-sa-4.0",
        "cc-by-nc-2.0",
        "cc-by-nc-3.0",
        "cc-by-nc-4.0",
        "cc-by-nd-4.0",
        "cc-by-nc-nd-3.0",
        "cc-by-nc-nd-4.0",
        "cc-by-nc-sa-2.0",
        "cc-by-nc-sa-3.0",
        "cc-by-nc-sa-4.0",
        "odc-by",
        "odbl",
        "pddl",
        "gpl-3.0",
        "lgpl-3.0",
        "agpl-3.0",
        "unknown",
    ]
)
"""Licences that the hub knows by name; every other one is "other" with its name beside it."""
_SIZES = ("n<1K", "1K<n<10K", "10K<n<100K", "100K<n<1M", "1M<n<10M", "10M<n<100M", "100M<n<1B", "1B<n<10B")
"""The hub's classes of size, a factor of ten each."""


@dataclass(frozen=True)
class DatasetFacts:
    """Tables of a finished EpisodeSet, curated or filtered, and of the set that it was filtered from.

    Attributes:
        rows: its episodes, or segments of episodes; curated: the episodes before the filters.
        curation: curation.json; weights: source_weights.json.
    """

    folder: Path
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
    def read(cls, folder: Path) -> DatasetFacts:
        """Read the tables of an EpisodeSet.

        Raises: DataError when it is none; ArtifactError when a table is damaged.
        """
        rows, refused = read_index(folder), read_quarantine(folder)
        filtered = (folder / FINDINGS_FILE).is_file()
        origin = _origin(folder, rows) if filtered else folder
        return cls(
            folder=folder,
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
    def num_frames(self) -> int:
        return sum(row.video_frames for row in self.rows)

    @cached_property
    def num_episodes(self) -> int:
        """Recorded episodes of which something was kept."""
        return len({(row.dataset, row.episode_index) for row in self.rows})

    @property
    def summary(self) -> str:
        """Two sentences about size and outcomes."""
        rows = self.rows
        segments = f" ({len(rows)} segments)" if len(rows) != self.num_episodes else ""
        kinds = (
            counted(len({row.embodiment for row in rows}), "embodiment"),
            counted(len({row.scene for row in rows}), "scene"),
            counted(len({row.instruction for row in rows if row.instruction}), "instruction"),
        )
        outcomes = Counter(row.outcome for row in rows)
        return (
            f"{recorded_time(rows)} in {self.num_episodes} episodes{segments}, {self.num_frames} frames per view;"
            f" {', '.join(kinds)}. Outcomes: {outcomes['success']} successes, {outcomes['failure']} failures,"
            f" {outcomes['unknown']} unknown; they are labels for evaluation and never reach a model."
        )

    @property
    def split_note(self) -> str:
        """Scenes that training and test share, counted."""
        learnt = {row.scene for row in self.rows if row.split in ("train", "validation")}
        tested = {row.scene for row in self.rows if row.split in ("test", "ood_test")}
        if not learnt or not tested:
            return "Only one side of the split is in this set, so no scene can be on both."
        shared = sorted(learnt & tested)
        if shared:
            return f"Warning: {len(shared)} scenes are in training and in test ({', '.join(shared[:4])})."
        return f"None of the {len(tested)} test scenes is among the {len(learnt)} scenes of training and validation."

    @property
    def funnel(self) -> list[tuple[str, int]]:
        """Numbers left after each step, in episodes, then in segments."""
        filtered = [("kept by the filters", self.num_episodes), ("segments of these", len(self.rows))]
        return [
            ("episodes found", len(self.curated) + len(self.refused_by_curation)),
            ("kept by curation", len(self.curated)),
            *(filtered if self.filtered else []),
            ("fit for Stage I", sum(row.stage1_ok for row in self.rows)),
            ("fit for Stage II", sum(row.stage2_ok for row in self.rows)),
        ]

    @property
    def funnel_table(self) -> Table:
        return Table(("Step", "Number"), self.funnel, [1])

    @property
    def reason_table(self) -> Table:
        """Step, reason, count and an example's detail of everything that was refused, the most frequent first."""
        stage2 = [(row.stage2_reason, "kept for Stage I only") for row in self.rows if row.stage2_reason is not None]
        rows: list[list[object]] = []
        for step, refused in (
            ("curation", [(row.reason, row.detail) for row in self.refused_by_curation]),
            ("filters", [(row.reason, row.detail) for row in self.refused_by_filters]),
            ("Stage II", stage2),
        ):
            first = dict(reversed(refused))
            for reason, count in most_frequent(reason for reason, _ in refused):
                rows.append([step, reason, count, first[reason].partition("\n")[0]])
        return Table(("Step", "Reason", "Episodes", "For example"), rows, [2])

    @property
    def convention_table(self) -> Table:
        """Departures from the contract that sources declare."""
        declared = [(s.label, name, value) for s in self.sources for name, value in sorted(s.conventions.items())]
        return Table(("Source", "Convention", "As recorded"), declared)

    @property
    def names(self) -> list[str]:
        """Sources by name, those without a kept episode included."""
        unseen = [facts.label for facts in self.sources if not facts.names]
        return sorted({row.source for row in self.rows} | set(unseen))

    def source_facts(self, name: str) -> SourceFacts | None:
        """The configured source of this name; None where it is not noted."""
        return next((facts for facts in self.sources if name in facts.names or name == facts.label), None)

    def licenses(self) -> dict[str, list[str]]:
        """Sources by licence, "unknown" among them."""
        found: dict[str, list[str]] = {}
        for name in self.names:
            facts = self.source_facts(name)
            found.setdefault(UNKNOWN if facts is None else facts.license, []).append(name)
        return dict(sorted(found.items()))

    @property
    def source_table(self) -> Table:
        """Origin of the episodes, their numbers, and what their licences allow."""
        rows = []
        for name in self.names:
            own = [row for row in self.rows if row.source == name]
            noted, weight = self.source_facts(name), self.weights.get(name)
            share = f"{100 * float(weight['share']):.1f} %" if isinstance(weight, dict) else None
            kind, found = (None, None) if noted is None else (noted.kind, noted.found)
            kept = len({(row.dataset, row.episode_index) for row in own})
            rights = (UNKNOWN, UNKNOWN) if noted is None else (noted.license, noted.redistribution)
            rows.append([name, kind, found, kept, recorded_time(own), frame_rates(own) or None, share, *rights])
        headings = (
            "Source", "Kind", "Found", "Kept", "Recorded", "fps", "Share in training", "Licence", "Redistribution",
        )  # fmt: skip
        return Table(headings, rows, range(2, 7))

    def count_table(self, heading: str, value_of: Callable[[EpisodeRow], str]) -> Table:
        """Scenes, episodes, recorded time and outcomes by a property of the rows."""
        groups: dict[str, list[EpisodeRow]] = defaultdict(list)
        for row in self.rows:
            groups[value_of(row)].append(row)
        rows: list[list[object]] = []
        for value, own in sorted(groups.items()):
            outcomes = Counter(row.outcome for row in own)
            counts = [outcomes[name] for name in ("success", "failure", "unknown")]
            rows.append([value, len({row.scene for row in own}), len(own), recorded_time(own), *counts])
        headings = (heading, "Scenes", "Episodes", "Recorded", "Success", "Failure", "Unknown")
        return Table(headings, rows, range(1, 7))

    @property
    def contents(self) -> list[tuple[str, Table]]:
        """Counts by embodiment, task and split, each with a heading."""
        return [
            ("Embodiments", self.count_table("Embodiment", lambda row: row.embodiment)),
            ("Tasks", self.count_table("Task family", lambda row: words(row.task_family))),
            ("Splits", self.count_table("Split", lambda row: words(row.split))),
        ]

    @property
    def view_table(self) -> Table:
        """Rows that have each view, its sizes and frame rates, and rows whose primary view it is."""
        contracts = {
            name: read_json(self.folder / name / "meta" / "worldline" / "contract.json").get("views", {})
            for name in {row.dataset for row in self.rows}
        }
        rows: list[list[object]] = []
        for view in dict.fromkeys(view for row in self.rows for view in row.views):
            own = [row for row in self.rows if view in row.views]
            sizes = [contracts[name].get(view) for name in {row.dataset for row in own}]
            known = sorted({(int(size["height"]), int(size["width"])) for size in sizes if size})
            shown = ", ".join(f"{width}x{height}" for height, width in known) or UNKNOWN
            rows.append([view, len(own), shown, frame_rates(own), sum(row.primary_view == view for row in own)])
        return Table(("View", "Episodes", "Width x height", "fps", "Primary in"), rows, [1, 4])

    @property
    def instructions(self) -> tuple[Table, str]:
        """The most frequent instructions, and notes on them."""
        found = most_frequent(row.instruction for row in self.rows)
        rows = [(text or "(none)", count) for text, count in found[:MOST_INSTRUCTIONS]]
        rewritten = sum(json.loads(row.conventions).get(RAW_INSTRUCTION) is not None for row in self.rows)
        telling = sum(mentions_outcome(row.instruction) for row in self.rows)
        notes = {
            f"The {MOST_INSTRUCTIONS} most frequent of {len(found)}.": len(found) > MOST_INSTRUCTIONS,
            f"{rewritten} were brought to one spelling; their raw texts are kept in the index (conventions, raw_instruction).": rewritten,
            f"Warning: the instruction of {counted(telling, 'episode')} reveals the outcome, which models must not see.": telling,
        }
        return Table(("Instruction", "Episodes"), rows, [1]), " ".join(note for note, holds in notes.items() if holds)

    @property
    def detector_table(self) -> Table:
        """Episodes that passed and failed the detectors of cameras, controls and clocks."""
        rows: list[list[object]] = []
        for detector in CALIBRATION_DETECTORS:
            verdicts: dict[str, bool] = {}
            for row in self.findings:
                if row["detector"] == detector:
                    verdicts[row["episode_id"]] = verdicts.get(row["episode_id"], True) and bool(row["passed"])
            if verdicts:
                passed = sum(verdicts.values())
                rows.append([words(detector), passed, len(verdicts) - passed])
        return Table(("Detector", "Episodes passed", "Episodes failed"), rows, [1, 2])

    @property
    def calibrated(self) -> int:
        """Rows whose every view has a calibration."""
        known: dict[tuple[str, int], set[str]] = {}
        for name in {row.dataset for row in self.rows}:
            # Only the two columns: the poses beside them may be large.
            path = self.folder / name / "meta" / "worldline" / "cameras.parquet"
            table = read_table(path, columns=["episode_index", "view"])
            for row in [] if table is None else table.to_pylist():
                known.setdefault((name, int(row["episode_index"])), set()).add(str(row["view"]))
        return sum(set(row.views) <= known.get((row.dataset, row.episode_index), set()) for row in self.rows)

    @property
    def duplicates(self) -> str:
        """Episodes that curation took out as copies or leaks."""
        count = Counter(row.reason for row in self.refused_by_curation)
        return (
            f"Taken out: {count['duplicate']} exact duplicates, {count['near_duplicate']} near duplicates (encoded or cut another"
            f" way), {count['duplicate_id']} repeated ids, {count['scene_leak']} episodes of scenes that are tested on under another"
            " name."
        )

    @property
    def leakage(self) -> tuple[str, Table]:
        """Scenes on both sides of the split that look alike, in words and as a table."""
        leaks = self.curation.get("scene_leaks", [])
        rows = [(leak["learning_scene"], leak["testing_scene"], leak["distance"]) for leak in leaks[:MOST_LEAKS]]
        if not self.curation:
            text = "Leakage was not looked for: this set does not come from curation."
        elif self.curation.get("leakage_action") == "off":
            text = "Leakage was not looked for: curate.leakage.action is off."
        elif not leaks:
            text = "No two differently named scenes on both sides of the split look alike."
        else:
            text = f"{counted(len(leaks), 'pair')} of scenes across the split look alike (first images; bits of 256):"
        return text, Table(("Learnt from", "Tested on", "Differing bits"), rows, [2])


def _origin(folder: Path, rows: Sequence[EpisodeRow]) -> Path | None:
    """The curated set that a filtered one was made from: by its manifest, else by the place of its datasets."""
    linked = linked_folder(folder, "episodes")
    if linked is None and rows:
        holder = (folder / rows[0].dataset).resolve().parents[1]
        linked = holder if (holder / INDEX_FILE).is_file() else None
    return linked


def most_frequent[T: Any](values: Iterable[T]) -> list[tuple[T, int]]:
    """Values and their counts, the most frequent first, ties in their own order."""
    return sorted(Counter(values).items(), key=lambda item: (-item[1], item[0]))


def counted(count: int, noun: str) -> str:
    """A number and its noun."""
    return f"{count} {noun}" + ("" if count == 1 else "s")


def recorded_time(rows: Iterable[EpisodeRow]) -> str:
    """Duration of the images of some rows."""
    return duration(sum(row.video_frames / row.fps for row in rows))


def frame_rates(rows: Iterable[EpisodeRow]) -> str:
    """Every frame rate of some rows."""
    return ", ".join(sorted({f"{row.fps:g}" for row in rows}))


def choose_rows(rows: Sequence[EpisodeRow], positions: Iterable[int], most: int) -> list[int]:
    """Up to `most` positions, taken in turn from every pair of embodiment and task; failures and successes in turn come first."""
    groups: dict[tuple[str, str], list[int]] = defaultdict(list)
    for position in positions:
        groups[rows[position].embodiment, rows[position].task_family].append(position)
    ordered = [
        sorted(group, key=lambda i: (rows[i].outcome != ("failure" if turn % 2 else "success"), rows[i].episode_id))
        for turn, (_, group) in enumerate(sorted(groups.items()))
    ]
    if len(ordered) > most:
        return sorted(ordered[i][0] for i in evenly_spaced(len(ordered), most))
    depths = range(max(map(len, ordered), default=0))
    return sorted([group[depth] for depth in depths for group in ordered if depth < len(group)][:most])


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
            unreadable.append(f"{row.episode_id}: {error.what}")
            continue
        title = f"{row.embodiment}  ·  {row.instruction or '(no instruction)'}"
        note = f"{row.episode_id}  ·  {row.scene}  ·  {words(row.split)}  ·  {row.outcome}"
        shown.append(SheetRow(title, frames, note))
    return shown, unreadable


def write_card(folder: Path, output: Path, title: str | None = None) -> list[Path]:
    """Write the card of a finished EpisodeSet; equal sets give equal bytes.

    Args:
        output: gets README.md and pictures/.
        title: default: "EpisodeSet" and the folder's name.

    Returns: the files written.

    Raises: DataError when the folder is no EpisodeSet; ArtifactError when one of its tables is damaged.
    """
    facts = DatasetFacts.read(folder)
    heading = title or f"EpisodeSet {folder.resolve().name}"
    episodes = EpisodeSet.open(folder)
    pictures: list[tuple[str, Path, int]] = []
    for number, name in enumerate(facts.names):
        own = [i for i, row in enumerate(facts.rows) if row.source == name and row.primary_view in row.views]
        rows, _ = sheet_rows(episodes, choose_rows(facts.rows, own, ROWS_PER_SOURCE))
        if rows:
            path = output / PICTURES / f"source_{number:02d}.jpg"
            write_bytes_atomic(path, jpeg_bytes(contact_sheet(rows, min_width=SHEET_WIDTH)))
            pictures.append((name, path, len(rows)))
    text = render("report/card.md", facts=facts, heading=heading, pictures=pictures, plain=plain, table=markdown_table)
    card = DatasetCard(f"---\n{hub_metadata(facts, heading).to_yaml()}\n---\n\n{text}\n")
    write_bytes_atomic(output / "README.md", str(card).encode())
    return [output / "README.md", *(path for _, path, _ in pictures)]


def hub_metadata(facts: DatasetFacts, title: str) -> DatasetCardData:
    """The header for the hub's dataset pages and searches."""
    licenses = list(facts.licenses())
    known = len(licenses) == 1 and licenses[0].lower() in HUB_LICENSES
    name = re.sub(r"[^a-z0-9.+-]+", "-", " and ".join(licenses).lower()).strip("-") or UNKNOWN
    return DatasetCardData(
        pretty_name=title,
        license=licenses[0].lower() if known else "other",
        license_name=None if known else name,
        task_categories=["robotics"],
        tags=["LeRobot", "WorldLine", "robotics", *sorted({row.embodiment for row in facts.rows})],
        size_categories=[_SIZES[bisect_right([10**power for power in range(3, 10)], facts.num_frames)]],
        configs=[
            {"config_name": Path(dataset).name, "data_files": f"{dataset}/data/*/*.parquet"}
            for dataset in sorted({row.dataset for row in facts.rows})
            if not dataset.startswith("..")
        ]
        or None,
    )


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
