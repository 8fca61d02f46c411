"""The dataset card of an EpisodeSet: README.md (as the Hugging Face hub reads it), index.html, one picture per source;
and the page "Data" of a report: what was recorded, as the card says it, with a contact sheet.

The card's page is the Markdown file's text made into HTML: what is said is written once, in `card.md`.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from pathlib import Path

import yaml
from markupsafe import Markup

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.instructions import mentions_outcome
from worldline_core.pages.charts import funnel_chart
from worldline_core.pages.page import Table, markdown, render, words
from worldline_core.pictures import contact_sheet, jpeg_bytes
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.dataset_facts import (
    UNKNOWN,
    DatasetFacts,
    counted,
    frame_rates,
    most_frequent,
    recorded_time,
)
from worldline_core.report.episode_sheet import episode_rows, one_of_each, some_of_each
from worldline_core.store.atomic import write_bytes_atomic
from worldline_core.untrusted_text import cut, visible

PICTURES = "pictures"
ROWS_PER_SOURCE = 6
SHEET_WIDTH = 1180
MOST_INSTRUCTIONS = 15
MOST_LEAKS = 12
NONE = "-"
LONGEST_CELL = 300
"""Characters of one cell of a table."""

# The hub knows these by name; every other licence is "other" with its name beside it.
HUB_LICENSES = frozenset(
    (
        "apache-2.0", "mit", "bsd-2-clause", "bsd-3-clause", "cc0-1.0", "cc-by-2.0", "cc-by-2.5", "cc-by-3.0", "cc-by-4.0",
        "cc-by-sa-3.0", "cc-by-sa-4.0", "cc-by-nc-2.0", "cc-by-nc-3.0", "cc-by-nc-4.0", "cc-by-nd-4.0", "cc-by-nc-nd-3.0",
        "cc-by-nc-nd-4.0", "cc-by-nc-sa-2.0", "cc-by-nc-sa-3.0", "cc-by-nc-sa-4.0", "odc-by", "odbl", "pddl", "gpl-3.0",
        "lgpl-3.0", "agpl-3.0", "unknown",
    )
)  # fmt: skip
_SIZES = ("n<1K", "1K<n<10K", "10K<n<100K", "100K<n<1M", "1M<n<10M", "10M<n<100M", "100M<n<1B", "1B<n<10B")
"""The hub's classes of size, a factor of ten each."""
_PRIMARY_VIEW_REASONS = {
    "source": "as the source declares",
    "configured": "as configured",
    "head": "the head's, because the source's own choice has no images",
    "most_motion": "the view with most motion",
}


def write_card(folder: Path, output: Path, title: str | None = None) -> list[Path]:
    """Write the card of a finished EpisodeSet; equal sets give equal bytes.

    Args:
        output: gets README.md, index.html and pictures/.
        title: default: "EpisodeSet" and the folder's name.

    Returns: the files written.

    Raises: DataError when the folder is no EpisodeSet; ArtifactError when one of its tables is damaged.
    """
    facts = DatasetFacts.read(folder)
    heading = title or f"EpisodeSet {folder.resolve().name}"
    pictures = _write_pictures(facts, output)
    text = render("report/card.md", pictures=pictures, picture_folder=PICTURES, **card_values(facts))
    header = yaml.safe_dump(hub_metadata(facts, heading), sort_keys=False, allow_unicode=True, width=120)
    readme, page = output / "README.md", output / "index.html"
    write_bytes_atomic(readme, f"---\n{header}---\n\n# {plain(heading)}\n\n{plain(facts.summary)}\n\n{text}".encode())
    funnel = funnel_chart(facts.funnel, title="Episodes left after each step")
    html = render(
        "report/card.html",
        title=heading,
        subtitle=facts.summary,
        funnel=funnel,
        body=markdown(text, heading=1, pictures=True),
    )
    write_bytes_atomic(page, html.encode())
    return [readme, page, *(output / PICTURES / name for _, name, _ in pictures)]


def hub_metadata(facts: DatasetFacts, title: str) -> dict[str, object]:
    """The header that the hub's dataset pages and searches are made from."""
    licenses = list(facts.licenses())
    single = licenses[0] if len(licenses) == 1 else None
    known = single is not None and single.lower() in HUB_LICENSES
    metadata: dict[str, object] = {"pretty_name": title, "license": str(single).lower() if known else "other"}
    if not known:
        name = " and ".join(licenses) if licenses else UNKNOWN
        metadata["license_name"] = re.sub(r"[^a-z0-9.+-]+", "-", name.lower()).strip("-") or UNKNOWN
    embodiments = sorted({row.embodiment for row in facts.rows})
    metadata |= {
        "task_categories": ["robotics"],
        "tags": ["LeRobot", "WorldLine", "robotics", *embodiments],
        "size_categories": [_SIZES[bisect_right([10**power for power in range(3, 10)], facts.num_frames)]],
        "configs": [
            {"config_name": Path(name).name, "data_files": f"{name}/data/*/*.parquet"}
            for name in sorted({row.dataset for row in facts.rows})
            if not name.startswith("..")
        ],
    }
    return {key: value for key, value in metadata.items() if value}


def card_parts(facts: DatasetFacts, names: Iterable[str]) -> Markup:
    """Parts of the card, of `sources`, `contents` and `duplicates`, as HTML for another page."""
    values = card_values(facts)
    return markdown("\n\n".join(render(f"report/card_{name}.md", **values) for name in names), heading=2)


def card_values(facts: DatasetFacts) -> dict[str, object]:
    """What the card says, by the names that its template uses: plain values, and tables as Markdown."""
    instructions = most_frequent(row.instruction for row in facts.rows)
    kinds = ("Scenes", "Episodes", "Recorded", "Success", "Failure", "Unknown")
    primary_views = [
        f"{view} in {count} ({_PRIMARY_VIEW_REASONS.get(reason, reason)})"
        for (view, reason), count in facts.primary_views
    ]
    return {
        "plain": plain,
        "sources": markdown_table(
            ("Source", "Kind", "Found", "Kept", "Recorded", "fps", "Share in training", "Licence", "Redistribution"),
            [_source_row(facts, name) for name in facts.names],
            range(2, 7),
        ),
        "undeclared": facts.licenses().get(UNKNOWN, []),
        "funnel": markdown_table(("Step", "Number"), facts.funnel, [1]),
        "reasons": markdown_table(("Step", "Reason", "Episodes", "For example"), facts.reasons, [2]),
        "contents": [
            (heading, markdown_table((name, *kinds), facts.by_property(value_of), range(1, 7)))
            for heading, name, value_of in (
                ("Embodiments", "Embodiment", lambda row: row.embodiment),
                ("Tasks", "Task family", lambda row: words(row.task_family)),
                ("Splits", "Split", lambda row: words(row.split)),
            )
        ],
        "views": markdown_table(("View", "Episodes", "Width x height", "fps", "Primary in"), facts.views, [1, 4]),
        "primary_views": "; ".join(primary_views),
        "instructions": markdown_table(
            ("Instruction", "Episodes"),
            [(text or "(none)", count) for text, count in instructions[:MOST_INSTRUCTIONS]],
            [1],
        ),
        "instruction_notes": _instruction_notes(facts, len(instructions)),
        "calibrated": f"{facts.calibrated} of {len(facts.rows)}",
        "declared": markdown_table(
            ("Source", "Convention", "As recorded"),
            [(s.label, name, value) for s in facts.sources for name, value in sorted(s.conventions.items())],
        ),
        "detectors": markdown_table(
            ("Detector", "Episodes passed", "Episodes failed"),
            [(words(name), passed, failed) for name, passed, failed in facts.calibration],
            [1, 2],
        ),
        "filtered": facts.filtered,
        "taken_out": {r: facts.duplicates(r) for r in ("duplicate", "near_duplicate", "duplicate_id", "scene_leak")},
        "split_note": facts.split_note,
        "leakage": _leakage(facts),
    }


def plain(text: str) -> str:
    """Text of recordings in Markdown: no markup, no entity, no line break, no end of it, whatever was recorded."""
    escaped = re.sub(r"([\\`*\[\]<>#|&])", r"\\\1", visible(cut(" ".join(text.split()))))
    return re.sub(r"(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])", r"\\_", escaped)  # within a word it is no markup


def markdown_table(headings: Sequence[str], rows: Sequence[Sequence[object]], numeric: Iterable[int] = ()) -> str:
    """A table in Markdown, or nothing where there are no rows; `numeric` columns are aligned right."""
    rule = ["---:" if position in set(numeric) else "---" for position in range(len(headings))]
    cells = [[plain(cut(str(cell), LONGEST_CELL)) for cell in row] for row in (headings, *rows)]
    lines = [cells[0], rule, *cells[1:]]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) if rows else ""


def _source_row(facts: DatasetFacts, name: str) -> tuple[object, ...]:
    """Where episodes come from, how many came through, and what their licence allows."""
    own = [row for row in facts.rows if row.source == name]
    noted, weight = facts.source_facts(name), facts.weights.get(name)
    share = f"{100 * float(weight['share']):.1f} %" if isinstance(weight, dict) else NONE
    kind, found = (NONE, NONE) if noted is None else (noted.kind, noted.found)
    kept = len({(row.dataset, row.episode_index) for row in own})
    rights = (UNKNOWN, UNKNOWN) if noted is None else (noted.license, noted.redistribution)
    return name, kind, found, kept, recorded_time(own), frame_rates(own) or NONE, share, *rights


def _instruction_notes(facts: DatasetFacts, kinds: int) -> str:
    notes: list[str] = []
    if kinds > MOST_INSTRUCTIONS:
        notes.append(f"The {MOST_INSTRUCTIONS} most frequent of {kinds}.")
    if facts.rewritten_instructions:
        notes.append(
            f"{facts.rewritten_instructions} were brought to one spelling; their raw texts are kept in the index"
            " (conventions, raw_instruction)."
        )
    telling = sum(mentions_outcome(row.instruction) for row in facts.rows)
    if telling:
        notes.append(
            f"Warning: the instruction of {counted(telling, 'episode')} speaks of the outcome, which models must not see."
        )
    return " ".join(notes)


def _leakage(facts: DatasetFacts) -> tuple[str, str]:
    """What was found about scenes on both sides of the split, in words and as a table."""
    leaks = facts.curation.get("scene_leaks", [])
    if not facts.curation:
        return "Leakage was not looked for: this set does not come from curation.", ""
    if facts.curation.get("leakage_action") == "off":
        return "Leakage was not looked for: curate.leakage.action is off.", ""
    if not leaks:
        return "No two differently named scenes on both sides of the split look like one.", ""
    rows = [(leak["learning_scene"], leak["testing_scene"], leak["distance"]) for leak in leaks[:MOST_LEAKS]]
    text = f"{counted(len(leaks), 'pair')} of scenes across the split look like one (first images; bits of 256):"
    return text, markdown_table(("Learnt from", "Tested on", "Differing bits"), rows, [2])


def _write_pictures(facts: DatasetFacts, output: Path) -> list[tuple[str, str, int]]:
    """(source, file name, number of episodes) of one contact sheet per source: up to six episodes, over embodiments and
    tasks, six moments of the primary view."""
    episodes = EpisodeSet.open(facts.folder)
    written: list[tuple[str, str, int]] = []
    for number, name in enumerate(facts.names):
        own = [i for i, row in enumerate(facts.rows) if row.source == name and row.primary_view in row.views]
        rows, _ = episode_rows(episodes, some_of_each(facts.rows, own, ROWS_PER_SOURCE))
        if rows:
            file = f"source_{number:02d}.jpg"
            sheet = contact_sheet(rows, tile_height=128, min_width=SHEET_WIDTH)
            write_bytes_atomic(output / PICTURES / file, jpeg_bytes(sheet))
            written.append((name, file, len(rows)))
    return written


def data_section(context: ReportContext) -> Section:
    """Counts of the curated episodes (before filters) and pictures of some."""
    folder = context.inputs.get("curate") or context.inputs.get("filter") or context.inputs.get("episodes")
    if folder is None:
        return Section("data", "Data", missing="no EpisodeSet was given (inputs curate or filter).")
    facts = DatasetFacts.read(folder)
    if not facts.rows:
        return Section("data", "Data", missing="the EpisodeSet holds no episode.")
    shown, unreadable = episode_rows(
        EpisodeSet.open(folder), one_of_each(facts.rows, context.config.contact_sheet_rows)
    )
    alt = "Contact sheet of recorded episodes"
    return context.section(
        "data",
        "Data",
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
