"""Section "Data": what was recorded, by embodiment, scene and outcome, with a contact sheet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from worldline_core.errors import DataError
from worldline_core.pictures.contact_sheet import SheetRow, contact_sheet, evenly_spaced
from worldline_core.report.card_blocks import Heading, duplicate_blocks, source_blocks
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.dataset_card import block_html
from worldline_core.report.dataset_facts import DatasetFacts
from worldline_core.report.markup import Column, Html, element, figure, join, notice, number, table
from worldline_core.store.artifact_files import JsonObject, read_rows

TITLE = "Data"


def data_section(context: ReportContext) -> Section:
    """Counts of the curated episodes (before filters) and pictures of some."""
    folder = context.inputs.get("curate") or context.inputs.get("filter") or context.inputs.get("episodes")
    if folder is None:
        return Section("data", TITLE, missing="no EpisodeSet was given (inputs curate or filter).")
    rows = read_rows(folder / "index.parquet")
    if not rows:
        return Section("data", TITLE, missing="the EpisodeSet holds no episode.")
    seconds = sum(row["num_frames"] / row["fps"] for row in rows if row["fps"])
    lead = (
        f"{number(len(rows))} episodes, {number(sum(row['num_frames'] for row in rows))} time steps"
        f" ({seconds / 60:.1f} minutes), {len({row['embodiment'] for row in rows})} embodiments,"
        f" {len({row['scene'] for row in rows})} scenes, {len({row['task_family'] for row in rows})} task families."
        f" {split_note(rows)} Outcomes are labels for evaluation and never reach the model."
    )
    body = join(
        embodiment_table(rows),
        element("div", count_table(rows, "task_family", "Task"), count_table(rows, "split", "Split"), class_="grid2"),
        scene_table(rows),
        sources(folder),
        sheet(context, rows),
    )
    return Section("data", TITLE, lead, body)


def split_note(rows: Sequence[JsonObject]) -> str:
    """Whether training and test share a scene, checked, not assumed."""
    scenes = {
        split: {row["scene"] for row in rows if row["split"] == split} for split in {row["split"] for row in rows}
    }
    trained = scenes.get("train", set())
    held_out = set().union(*(scenes.get(split, set()) for split in ("test", "ood_test")))
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


def embodiment_table(rows: Sequence[JsonObject]) -> Html:
    """Episodes, scenes, seconds and outcomes of each embodiment."""
    columns = [
        Column("Embodiment"),
        Column("Splits"),
        *[Column(name, numeric=True) for name in ("Scenes", "Episodes", "Seconds", "Success", "Failure", "Unknown")],
    ]
    body = []
    for name in sorted({row["embodiment"] for row in rows}):
        own = [row for row in rows if row["embodiment"] == name]
        seconds = sum(row["num_frames"] / row["fps"] for row in own if row["fps"])
        splits = ", ".join(sorted({row["split"].replace("_", " ") for row in own}))
        scenes = len({row["scene"] for row in own})
        body.append([name, splits, scenes, len(own), f"{seconds:.0f}", *outcome_counts(own)])
    total_seconds = sum(row["num_frames"] / row["fps"] for row in rows if row["fps"])
    scenes = len({row["scene"] for row in rows})
    body.append(["all", "", scenes, len(rows), f"{total_seconds:.0f}", *outcome_counts(rows)])
    return table(columns, body, caption="Episodes by embodiment", emphasise=frozenset({len(body) - 1}))


def count_table(rows: Sequence[JsonObject], key: str, heading: str) -> Html:
    """Episodes and outcomes by one column of the index."""
    columns = [Column(heading), *[Column(name, numeric=True) for name in ("Episodes", "Success", "Failure", "Unknown")]]
    body = []
    for value in sorted({str(row[key]) for row in rows}):
        own = [row for row in rows if str(row[key]) == value]
        body.append([value.replace("_", " "), len(own), *outcome_counts(own)])
    return table(columns, body, caption=f"Episodes by {heading.lower()}")


def scene_table(rows: Sequence[JsonObject]) -> Html:
    """Every scene with its split, folded away."""
    columns = [Column("Scene"), Column("Embodiments"), Column("Split"), Column("Episodes", numeric=True)]
    columns += [Column(name, numeric=True) for name in ("Success", "Failure", "Unknown")]
    body = []
    for scene in sorted({row["scene"] for row in rows}):
        own = [row for row in rows if row["scene"] == scene]
        names = ", ".join(sorted({row["embodiment"] for row in own}))
        splits = ", ".join(sorted({row["split"].replace("_", " ") for row in own}))
        body.append([scene, names, splits, len(own), *outcome_counts(own)])
    return element("details", element("summary", f"All {len(body)} scenes"), table(columns, body))


def sources(folder: Path) -> Html:
    """Sources with their licences, and copies and leaks, as the dataset card has them; nothing for a set without."""
    facts = DatasetFacts.read(folder)
    if not facts.sources:
        return Html("")
    blocks = [*source_blocks(facts), Heading("Duplicates and leakage"), *duplicate_blocks(facts)]
    return join([block_html(block) for block in blocks])


def sheet(context: ReportContext, rows: Sequence[JsonObject]) -> Html:
    """A contact sheet: one episode an embodiment and task, six moments of its primary view."""
    from worldline_core.data.episodes.episode_set import EpisodeSet

    folder = context.inputs.get("curate") or context.inputs.get("filter") or context.inputs.get("episodes")
    if folder is None:
        return Html("")
    episodes = EpisodeSet.open(folder)
    pictures: list[SheetRow] = []
    unreadable: list[str] = []
    for index in one_of_each(rows, context.config.contact_sheet_rows):
        row = rows[index]
        view = row.get("primary_view") or "head"
        try:
            frames = episodes.frames(index, view, evenly_spaced(row["num_frames"], 6))
        except DataError as error:
            unreadable.append(f"{row['episode_id']}: {error.what}")
            continue
        title = f"{row['embodiment']}  ·  {row['instruction']}"
        note = f"{row['episode_id']}  ·  {row['scene']}  ·  {row['split'].replace('_', ' ')}  ·  {row['outcome']}"
        pictures.append(SheetRow(title, np.asarray(frames), note))
    parts = [notice(f"No picture of {line}") for line in unreadable]
    if pictures:
        picture = contact_sheet(pictures, tile_height=128)
        image = context.picture("contact_sheet", picture, alt="Contact sheet of recorded episodes", photo=True)
        caption = (
            "Contact sheet: one episode of each embodiment and task, from its first to its last frame, primary view."
        )
        parts.append(figure(image, caption, class_="wide"))
    return join(parts)


def one_of_each(rows: Sequence[JsonObject], most: int) -> list[int]:
    """Rows that show every pair of embodiment and task once, failures and successes in turn, at most `most`."""
    seen: dict[tuple[str, str], list[int]] = {}
    for index, row in enumerate(rows):
        seen.setdefault((row["embodiment"], row["task_family"]), []).append(index)
    chosen: list[int] = []
    for turn, key in enumerate(sorted(seen)):
        wanted = "failure" if turn % 2 else "success"
        candidates = sorted(seen[key], key=lambda i: (rows[i]["outcome"] != wanted, rows[i]["episode_id"]))
        chosen.append(candidates[0])
    if len(chosen) > most:
        chosen = [chosen[round(i)] for i in np.linspace(0, len(chosen) - 1, most)]
    return chosen
