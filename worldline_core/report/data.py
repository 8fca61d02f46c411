"""Page "Data": what was recorded, as the set's card says it, with a contact sheet."""

from __future__ import annotations

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.pages.page import Table, words
from worldline_core.pictures.contact_sheet import contact_sheet
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.dataset_card import card_parts
from worldline_core.report.dataset_facts import DatasetFacts
from worldline_core.report.episode_sheet import episode_rows, one_of_each

TITLE = "Data"


def data_section(context: ReportContext) -> Section:
    """Counts of the curated episodes (before filters) and pictures of some."""
    folder = context.inputs.get("curate") or context.inputs.get("filter") or context.inputs.get("episodes")
    if folder is None:
        return Section("data", TITLE, missing="no EpisodeSet was given (inputs curate or filter).")
    facts = DatasetFacts.read(folder)
    if not facts.rows:
        return Section("data", TITLE, missing="the EpisodeSet holds no episode.")
    shown, unreadable = episode_rows(
        EpisodeSet.open(folder), one_of_each(facts.rows, context.config.contact_sheet_rows)
    )
    alt = "Contact sheet of recorded episodes"
    return context.section(
        "data",
        TITLE,
        facts.summary,
        contents=card_parts(facts, ("contents",)),
        scenes=scene_table(facts),
        sources=card_parts(facts, ("sources", "duplicates") if facts.sources else ("duplicates",)),
        sheet=context.picture("contact_sheet", contact_sheet(shown), alt=alt, photo=True) if shown else None,
        unreadable=unreadable,
    )


def scene_table(facts: DatasetFacts) -> Table:
    """Every scene with its robots and splits."""
    body = []
    for scene, _, episodes, recorded, *outcomes in facts.by_property(lambda row: row.scene):
        own = [row for row in facts.rows if row.scene == scene]
        robots, splits = sorted({row.embodiment for row in own}), sorted({words(row.split) for row in own})
        body.append([scene, ", ".join(robots), ", ".join(splits), episodes, recorded, *outcomes])
    headings = ("Scene", "Embodiments", "Split", "Episodes", "Recorded", "Success", "Failure", "Unknown")
    return Table(headings, body, range(3, 8))
