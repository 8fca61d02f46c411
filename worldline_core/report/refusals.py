"""What did not get through whole, and why: quarantined episodes, episodes unfit for Stage II, and cut frames."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from worldline_core.store.artifact_files import JsonObject, read_rows

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
        numbers = parsed(row.get("evidence"))
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
            numbers = parsed(failed[0]["numbers"]) if failed else {}
            refusals.append(Refusal("filter", reason, NOT_STAGE2, name, detail, numbers, "head"))
    names = {episode_of(row["episode_id"]) for row in kept}
    for episode_id, rows in sorted(findings.items()):
        for row in rows:
            if row["cut_frames"] and episode_id in names:
                detail = f"{row['cut_frames']} frames cut"
                numbers = parsed(row["numbers"])
                refusals.append(Refusal("filter", row["detector"], CUT, episode_id, detail, numbers, row["view"]))
    return refusals


def findings_by_episode(folder: Path) -> dict[str, list[JsonObject]]:
    """Rows of the filters' findings by episode; a step without findings has none."""
    found: dict[str, list[JsonObject]] = {}
    for row in read_rows(folder / "findings.parquet"):
        found.setdefault(row["episode_id"], []).append(row)
    return found


def first_of_each_episode(rows: list[JsonObject]) -> list[JsonObject]:
    """One row an episode (an episode kept in several segments has several)."""
    return list({episode_of(row["episode_id"]): row for row in reversed(rows)}.values())[::-1]


def episode_of(name: str) -> str:
    """The episode that a kept row was cut from: `episode@00120` is a segment of `episode`."""
    episode, _, start = name.rpartition("@")
    return episode if episode and len(start) == 5 and start.isdigit() else name


def parsed(evidence: Any) -> JsonObject:
    """Evidence as an object; text that is not one gives an empty object."""
    if isinstance(evidence, dict):
        return evidence
    try:
        value = json.loads(evidence) if isinstance(evidence, str) else {}
    except json.JSONDecodeError:
        return {}
    return value if isinstance(value, dict) else {}
