"""What a set of episodes holds, counted from its own tables: index, quarantine, findings, sources, sidecars."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

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
        sizes: (height, width) by dataset folder and view.
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
    sizes: dict[str, dict[str, tuple[int, int]]] = field(default_factory=dict)

    @classmethod
    def read(cls, folder: Path) -> DatasetFacts:
        """From the folder of an EpisodeSet.

        Raises: DataError when it is none; ArtifactError when a table is damaged.
        """
        rows = read_index(folder)
        filtered = (folder / FINDINGS_FILE).is_file()
        origin = _origin(folder, rows) if filtered else folder
        refused = read_quarantine(folder)
        return cls(
            folder,
            rows,
            rows if origin is None or not filtered else read_index(origin),
            [] if origin is None else read_quarantine(origin),
            refused if filtered else [],
            filtered,
            [] if origin is None else read_source_table(origin),
            {} if origin is None else read_json(origin / CURATION_FILE),
            {} if origin is None else read_json(origin / WEIGHTS_FILE),
            read_rows(folder / FINDINGS_FILE) if filtered else [],
            {name: _image_sizes(folder / name) for name in sorted({row.dataset for row in rows})},
        )

    @property
    def hours(self) -> float:
        return hours_of(self.rows)

    @property
    def num_frames(self) -> int:
        return sum(row.video_frames for row in self.rows)

    @cached_property
    def num_episodes(self) -> int:
        """Recorded episodes that something was kept of."""
        return len({(row.dataset, row.episode_index) for row in self.rows})

    @property
    def funnel(self) -> list[tuple[str, int]]:
        """What is left after each step, in episodes, then in segments."""
        found = len(self.curated) + len(self.refused_by_curation)
        steps = [("episodes found", found), ("kept by curation", len(self.curated))]
        if self.filtered:
            steps += [("kept by the filters", self.num_episodes), ("segments of these", len(self.rows))]
        steps += [
            ("fit for Stage I", sum(row.stage1_ok for row in self.rows)),
            ("fit for Stage II", sum(row.stage2_ok for row in self.rows)),
        ]
        return steps

    @property
    def reasons(self) -> list[tuple[str, str, int, str]]:
        """(step, reason, count, one example's detail) of everything that did not get through, the most frequent first."""
        found: list[tuple[str, str, int, str]] = []
        for step, refused in (("curation", self.refused_by_curation), ("filters", self.refused_by_filters)):
            counts = Counter(row.reason for row in refused)
            for reason, count in sorted(counts.items(), key=lambda item: (-item[1], item[0])):
                example = next(row.detail for row in refused if row.reason == reason)
                found.append((step, reason, count, example.splitlines()[0] if example else ""))
        counts = Counter(row.stage2_reason for row in self.rows if row.stage2_reason is not None)
        for reason, count in sorted(counts.items(), key=lambda item: (-item[1], item[0])):
            found.append(("Stage II", reason, count, "kept for Stage I only"))
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

    def resolutions(self, rows: Sequence[EpisodeRow], view: str) -> list[str]:
        """Sizes "640x480" (width x height) of a view in some rows."""
        sizes = {self.sizes.get(row.dataset, {}).get(view) for row in rows if view in row.views}
        return [f"{size[1]}x{size[0]}" for size in sorted(size for size in sizes if size is not None)]

    @property
    def views(self) -> list[str]:
        seen: dict[str, None] = {}
        for row in self.rows:
            seen |= dict.fromkeys(row.views)
        return list(seen)

    def instructions(self, most: int) -> list[tuple[str, int]]:
        """The most frequent instructions; "" stands for none."""
        counts = Counter(row.instruction for row in self.rows)
        return sorted(counts.items(), key=lambda item: (-item[1], item[0]))[:most]

    def noted(self, key: str) -> Counter[str]:
        """Values that rows note under a key of their conventions."""
        values = (json.loads(row.conventions).get(key) for row in self.rows)
        return Counter(str(value) for value in values if value is not None)

    @property
    def primary_views(self) -> Counter[tuple[str, str]]:
        """Rows by (primary view, why it is that one)."""
        return Counter(
            (row.primary_view, str(json.loads(row.conventions).get(PRIMARY_VIEW_REASON, "source"))) for row in self.rows
        )

    @property
    def rewritten_instructions(self) -> int:
        return sum(self.noted(RAW_INSTRUCTION).values())

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
        known = {name: _calibrated_views(self.folder / name) for name in self.sizes}
        return sum(set(row.views) <= known[row.dataset].get(row.episode_index, set()) for row in self.rows)

    def duplicates(self, reason: str) -> int:
        return sum(row.reason == reason for row in self.refused_by_curation)


def _origin(folder: Path, rows: Sequence[EpisodeRow]) -> Path | None:
    """The curated set that a filtered one was made from: as its manifest says, else where its datasets lie."""
    linked = linked_folder(folder, "episodes")
    if linked is None and rows:
        holder = (folder / rows[0].dataset).resolve().parents[1]
        linked = holder if (holder / INDEX_FILE).is_file() else None
    return linked


def hours_of(rows: Iterable[EpisodeRow]) -> float:
    """Hours of images."""
    return sum(row.video_frames / row.fps for row in rows) / 3600


def _image_sizes(dataset: Path) -> dict[str, tuple[int, int]]:
    views = read_json(dataset / "meta" / "worldline" / "contract.json").get("views", {})
    return {view: (int(size["height"]), int(size["width"])) for view, size in views.items()}


def _calibrated_views(dataset: Path) -> dict[int, set[str]]:
    """Views with a calibration, by episode of a dataset."""
    found: dict[int, set[str]] = {}
    # Only the two names: the poses beside them may be large.
    table = read_table(dataset / "meta" / "worldline" / "cameras.parquet", columns=["episode_index", "view"])
    for row in [] if table is None else table.to_pylist():
        found.setdefault(int(row["episode_index"]), set()).add(str(row["view"]))
    return found
