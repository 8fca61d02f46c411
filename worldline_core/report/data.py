"""Page "Data": what was recorded, by embodiment, scene and outcome, with a contact sheet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.pages.page import Table, number, words
from worldline_core.pictures.contact_sheet import contact_sheet
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.dataset_card import card_part
from worldline_core.report.dataset_facts import DatasetFacts
from worldline_core.report.episode_sheet import episode_rows, one_of_each
from worldline_core.store.artifact_files import JsonObject, read_rows

TITLE = "Data"
OUTCOMES = ("Success", "Failure", "Unknown")


def data_section(context: ReportContext) -> Section:
    """Counts of the curated episodes (before filters) and pictures of some."""
    folder = context.inputs.get("curate") or context.inputs.get("filter") or context.inputs.get("episodes")
    if folder is None:
        return Section("data", TITLE, missing="no EpisodeSet was given (inputs curate or filter).")
    rows = read_rows(folder / "index.parquet")
    if not rows:
        return Section("data", TITLE, missing="the EpisodeSet holds no episode.")
    lead = (
        f"{number(len(rows))} episodes, {number(sum(row['num_frames'] for row in rows))} time steps"
        f" ({seconds_of(rows) / 60:.1f} minutes), {len({row['embodiment'] for row in rows})} embodiments,"
        f" {len({row['scene'] for row in rows})} scenes, {len({row['task_family'] for row in rows})} task families."
        f" {split_note(rows)} Outcomes are labels for evaluation and never reach the model."
    )
    facts = DatasetFacts.read(folder)
    sheet, unreadable = contact_sheet_of(context, folder)
    return context.section(
        "data",
        TITLE,
        lead,
        embodiments=embodiment_table(rows),
        tasks=count_table(rows, "task_family", "Task"),
        splits=count_table(rows, "split", "Split"),
        scenes=scene_table(rows),
        sources=card_part("sources", facts) + card_part("duplicates", facts) if facts.sources else None,
        sheet=sheet,
        unreadable=unreadable,
    )


def seconds_of(rows: Sequence[JsonObject]) -> float:
    """Recorded seconds."""
    return sum(row["num_frames"] / row["fps"] for row in rows if row["fps"])


def split_note(rows: Sequence[JsonObject]) -> str:
    """Whether training and test share a scene, checked, not assumed."""
    trained = {row["scene"] for row in rows if row["split"] == "train"}
    held_out = {row["scene"] for row in rows if row["split"] in ("test", "ood_test")}
    if not trained or not held_out:
        return ""
    shared = sorted(trained & held_out)
    if shared:
        return f"Warning: training and test share {len(shared)} scenes ({', '.join(shared[:4])})."
    return (
        f"The split is by scene: none of the {len(held_out)} test scenes is among the {len(trained)} training scenes."
    )


def outcome_counts(rows: Sequence[JsonObject]) -> list[int]:
    """Numbers of successes, failures, and episodes without a label."""
    counted = Counter(row["outcome"] for row in rows)
    return [counted["success"], counted["failure"], len(rows) - counted["success"] - counted["failure"]]


def splits_of(rows: Sequence[JsonObject]) -> str:
    """Names of the splits that some rows are in."""
    return ", ".join(sorted({words(row["split"]) for row in rows}))


def embodiment_table(rows: Sequence[JsonObject]) -> Table:
    """Episodes, scenes, seconds and outcomes of each embodiment."""
    groups = [(name, [r for r in rows if r["embodiment"] == name]) for name in sorted({r["embodiment"] for r in rows})]
    body = []
    for name, own in [*groups, ("all", list(rows))]:
        splits = "" if name == "all" else splits_of(own)
        scenes = len({row["scene"] for row in own})
        body.append([name, splits, scenes, len(own), f"{seconds_of(own):.0f}", *outcome_counts(own)])
    headings = ("Embodiment", "Splits", "Scenes", "Episodes", "Seconds", *OUTCOMES)
    return Table(headings, body, range(2, 8), "Episodes by embodiment", emphasise=[len(body) - 1])


def count_table(rows: Sequence[JsonObject], key: str, heading: str) -> Table:
    """Episodes and outcomes by one column of the index."""
    body = []
    for value in sorted({str(row[key]) for row in rows}):
        own = [row for row in rows if str(row[key]) == value]
        body.append([words(value), len(own), *outcome_counts(own)])
    return Table((heading, "Episodes", *OUTCOMES), body, range(1, 5), f"Episodes by {heading.lower()}")


def scene_table(rows: Sequence[JsonObject]) -> Table:
    """Every scene with its split."""
    body = []
    for scene in sorted({row["scene"] for row in rows}):
        own = [row for row in rows if row["scene"] == scene]
        names = ", ".join(sorted({row["embodiment"] for row in own}))
        body.append([scene, names, splits_of(own), len(own), *outcome_counts(own)])
    return Table(("Scene", "Embodiments", "Split", "Episodes", *OUTCOMES), body, range(3, 7))


def contact_sheet_of(context: ReportContext, folder: Path) -> tuple[Markup | None, list[str]]:
    """One episode per embodiment and task, six moments of its primary view; and what could not be shown."""
    episodes = EpisodeSet.open(folder)
    shown, unreadable = episode_rows(episodes, one_of_each(episodes.rows, context.config.contact_sheet_rows))
    if not shown:
        return None, unreadable
    alt = "Contact sheet of recorded episodes"
    return context.picture("contact_sheet", contact_sheet(shown), alt=alt, photo=True), unreadable
