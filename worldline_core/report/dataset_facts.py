"""What a set of episodes holds, counted from its own tables: index, quarantine, findings, sources, sidecars."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from worldline_core.data.curation.recorded_episode import PRIMARY_VIEW_REASON
from worldline_core.data.curation.rules import CURATION_FILE
from worldline_core.data.curation.source_table import WEIGHTS_FILE, SourceFacts, read_source_table
from worldline_core.data.episodes.episode_index import (
    INDEX_FILE,
    EpisodeRow,
    QuarantineRow,
    read_index,
    read_quarantine,
)
from worldline_core.data.episodes.instructions import RAW_INSTRUCTION
from worldline_core.pages.page import duration
from worldline_core.store.artifact_files import JsonObject, linked_folder, read_json, read_rows, read_table

FINDINGS_FILE = "findings.parquet"
CALIBRATION_DETECTORS = ("calibration", "projection", "doctor", "time_alignment")
UNKNOWN = "unknown"


@dataclass(frozen=True)
class DatasetFacts:
    """A finished EpisodeSet, curated or filtered, with the set that it was filtered from.

    Attributes:
        rows: its episodes, or segments of episodes. curated: the same before the filters (`rows` itself where there were
            none).
        curation: curation.json. weights: source_weights.json.
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
        """From the folder of an EpisodeSet.

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
        """Recorded episodes that something was kept of."""
        return len({(row.dataset, row.episode_index) for row in self.rows})

    @property
    def summary(self) -> str:
        """One sentence of size, one of what outcomes are."""
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
        """Whether training and test share a scene: counted, not assumed."""
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
        """What is left after each step, in episodes, then in segments."""
        filtered = [("kept by the filters", self.num_episodes), ("segments of these", len(self.rows))]
        return [
            ("episodes found", len(self.curated) + len(self.refused_by_curation)),
            ("kept by curation", len(self.curated)),
            *(filtered if self.filtered else []),
            ("fit for Stage I", sum(row.stage1_ok for row in self.rows)),
            ("fit for Stage II", sum(row.stage2_ok for row in self.rows)),
        ]

    @property
    def reasons(self) -> list[tuple[str, str, int, str]]:
        """(step, reason, count, one example's detail) of everything that did not get through, the most frequent first."""
        stage2 = [(row.stage2_reason, "kept for Stage I only") for row in self.rows if row.stage2_reason is not None]
        found: list[tuple[str, str, int, str]] = []
        for step, refused in (
            ("curation", [(row.reason, row.detail) for row in self.refused_by_curation]),
            ("filters", [(row.reason, row.detail) for row in self.refused_by_filters]),
            ("Stage II", stage2),
        ):
            first = dict(reversed(refused))
            for reason, count in most_frequent(reason for reason, _ in refused):
                found.append((step, reason, count, first[reason].partition("\n")[0]))
        return found

    @property
    def names(self) -> list[str]:
        """Sources by name, those without a kept episode included."""
        unseen = [facts.label for facts in self.sources if not facts.names]
        return sorted({row.source for row in self.rows} | set(unseen))

    def source_facts(self, name: str) -> SourceFacts | None:
        """What the configuration said of the source of this name; None where it is not noted."""
        return next((facts for facts in self.sources if name in facts.names or name == facts.label), None)

    def licenses(self) -> dict[str, list[str]]:
        """Sources by licence; what is not declared is unknown."""
        found: dict[str, list[str]] = {}
        for name in self.names:
            facts = self.source_facts(name)
            found.setdefault(UNKNOWN if facts is None else facts.license, []).append(name)
        return dict(sorted(found.items()))

    def by_property(self, value_of: Callable[[EpisodeRow], str]) -> list[tuple[object, ...]]:
        """(value, scenes, rows, recorded time, successes, failures, unknown outcomes) of each value of a property of the rows."""
        groups: dict[str, list[EpisodeRow]] = {}
        for row in self.rows:
            groups.setdefault(value_of(row), []).append(row)
        table: list[tuple[object, ...]] = []
        for value, own in sorted(groups.items()):
            outcomes = Counter(row.outcome for row in own)
            counts = [outcomes[name] for name in ("success", "failure", "unknown")]
            table.append((value, len({row.scene for row in own}), len(own), recorded_time(own), *counts))
        return table

    @property
    def views(self) -> list[tuple[str, int, str, str, int]]:
        """(view, rows that have it, its sizes "640x480", its frame rates, rows whose primary view it is)."""
        contracts = {
            name: read_json(self.folder / name / "meta" / "worldline" / "contract.json").get("views", {})
            for name in {row.dataset for row in self.rows}
        }
        found: list[tuple[str, int, str, str, int]] = []
        for view in dict.fromkeys(view for row in self.rows for view in row.views):
            own = [row for row in self.rows if view in row.views]
            sizes = [contracts[name].get(view) for name in {row.dataset for row in own}]
            known = sorted({(int(size["height"]), int(size["width"])) for size in sizes if size})
            shown = ", ".join(f"{width}x{height}" for height, width in known) or UNKNOWN
            found.append((view, len(own), shown, frame_rates(own), sum(row.primary_view == view for row in own)))
        return found

    @cached_property
    def conventions(self) -> list[JsonObject]:
        """What each row notes of its source's declarations."""
        return [json.loads(row.conventions) for row in self.rows]

    @property
    def primary_views(self) -> list[tuple[tuple[str, str], int]]:
        """(primary view, why it is that one), and how many rows."""
        return most_frequent(
            (row.primary_view, str(noted.get(PRIMARY_VIEW_REASON, "source")))
            for row, noted in zip(self.rows, self.conventions, strict=True)
        )

    @property
    def rewritten_instructions(self) -> int:
        return sum(noted.get(RAW_INSTRUCTION) is not None for noted in self.conventions)

    @property
    def calibration(self) -> list[tuple[str, int, int]]:
        """(detector, episodes that passed, episodes that failed) of those that judge cameras, controls and clocks."""
        found: list[tuple[str, int, int]] = []
        for detector in CALIBRATION_DETECTORS:
            verdicts: dict[str, bool] = {}
            for row in self.findings:
                if row["detector"] == detector:
                    verdicts[row["episode_id"]] = verdicts.get(row["episode_id"], True) and bool(row["passed"])
            if verdicts:
                found.append((detector, sum(verdicts.values()), len(verdicts) - sum(verdicts.values())))
        return found

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

    def duplicates(self, reason: str) -> int:
        return sum(row.reason == reason for row in self.refused_by_curation)


def _origin(folder: Path, rows: Sequence[EpisodeRow]) -> Path | None:
    """The curated set that a filtered one was made from: as its manifest says, else where its datasets lie."""
    linked = linked_folder(folder, "episodes")
    if linked is None and rows:
        holder = (folder / rows[0].dataset).resolve().parents[1]
        linked = holder if (holder / INDEX_FILE).is_file() else None
    return linked


def most_frequent[T: Any](values: Iterable[T]) -> list[tuple[T, int]]:
    """Values and how often they occur, the most frequent first, of equals in their own order."""
    return sorted(Counter(values).items(), key=lambda item: (-item[1], item[0]))


def counted(count: int, noun: str) -> str:
    """A number and its noun."""
    return f"{count} {noun}" + ("" if count == 1 else "s")


def recorded_time(rows: Iterable[EpisodeRow]) -> str:
    """How long the images of some rows last, in words."""
    return duration(sum(row.video_frames / row.fps for row in rows))


def frame_rates(rows: Iterable[EpisodeRow]) -> str:
    """Every frame rate of some rows."""
    return ", ".join(sorted({f"{row.fps:g}" for row in rows}))
