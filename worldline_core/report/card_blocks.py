"""What a dataset card says, block by block: the same for the Markdown file and for the HTML page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.instructions import mentions_outcome
from worldline_core.report.dataset_facts import UNKNOWN, DatasetFacts, hours_of

MOST_INSTRUCTIONS = 15
MOST_LEAKS = 12
NONE = "-"


@dataclass(frozen=True)
class Heading:
    """Of a part of the card."""

    text: str


@dataclass(frozen=True)
class Paragraph:
    """Plain text."""

    text: str


@dataclass(frozen=True)
class TableBlock:
    """Rows of texts; `numeric` are the positions of columns with numbers."""

    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]
    numeric: frozenset[int] = frozenset()


@dataclass(frozen=True)
class PictureBlock:
    """`path` is relative to the card."""

    path: str
    caption: str


@dataclass(frozen=True)
class FunnelBlock:
    """What is left after each step."""

    steps: list[tuple[str, int]]


Block = Heading | Paragraph | TableBlock | PictureBlock | FunnelBlock


def card_blocks(facts: DatasetFacts, pictures: Sequence[PictureBlock]) -> list[Block]:
    """The whole card after its title."""
    return [
        Paragraph(summary(facts)),
        *source_blocks(facts),
        Heading("Pictures"),
        *(pictures or [Paragraph("None of the episodes could be read for a picture.")]),
        Heading("From recordings to training"),
        FunnelBlock(facts.funnel),
        Paragraph("Stage I learns from one view without actions, Stage II from all required views with actions."),
        *reason_blocks(facts),
        *_contents(facts),
        *_views(facts),
        *_instructions(facts),
        Heading("Calibration"),
        *_calibration(facts),
        Heading("Duplicates and leakage"),
        *duplicate_blocks(facts),
    ]


def summary(facts: DatasetFacts) -> str:
    """One sentence of size, one of what outcomes are."""
    rows = facts.rows
    segments = f" ({len(rows)} segments)" if len(rows) != facts.num_episodes else ""
    outcomes = Counter(row.outcome for row in rows)
    return (
        f"{hours_text(rows)} hours in {facts.num_episodes} episodes{segments}, {facts.num_frames} frames a view;"
        f" {counted(len({row.embodiment for row in rows}), 'embodiment')}, {counted(len({row.scene for row in rows}), 'scene')},"
        f" {counted(len({row.instruction for row in rows if row.instruction}), 'instruction')}. Outcomes: {outcomes['success']}"
        f" successes, {outcomes['failure']} failures, {outcomes['unknown']} unknown; they are labels for evaluation and"
        " never reach a model."
    )


def counted(count: int, noun: str) -> str:
    """A number and its noun."""
    return f"{count} {noun}" + ("" if count == 1 else "s")


def hours_text(rows: Sequence[EpisodeRow]) -> str:
    """Hours with three digits that say something."""
    hours = hours_of(rows)
    if 0 < hours < 0.001:
        return "< 0.001"
    return f"{hours:,.0f}" if hours >= 100 else f"{hours:.3g}"


def source_blocks(facts: DatasetFacts) -> list[Block]:
    """Where the episodes come from, how many came through, and what their licences allow."""
    table: list[tuple[str, ...]] = []
    for name in facts.names:
        own = [row for row in facts.rows if row.source == name]
        noted = facts.source_facts(name)
        weight = facts.weights.get(name)
        share = f"{100 * float(weight['share']):.1f} %" if isinstance(weight, dict) else NONE
        table.append(
            (
                name,
                NONE if noted is None else noted.kind,
                NONE if noted is None else str(noted.found),
                str(len({(row.dataset, row.episode_index) for row in own})),
                hours_text(own),
                ", ".join(sorted({f"{row.fps:g}" for row in own})) or NONE,
                share,
                UNKNOWN if noted is None else noted.license,
                UNKNOWN if noted is None else noted.redistribution,
            )
        )
    columns = ("Source", "Kind", "Found", "Kept", "Hours", "fps", "Share in training", "Licence", "Redistribution")
    blocks: list[Block] = [Heading("Sources and licences"), TableBlock(columns, table, frozenset({2, 3, 4, 5, 6}))]
    unknown = facts.licenses().get(UNKNOWN, [])
    if unknown:
        blocks.append(Paragraph(f"Nobody has declared the licence of: {', '.join(unknown)}."))
    return blocks


def reason_blocks(facts: DatasetFacts) -> list[Block]:
    """Why episodes did not get through."""
    if not facts.reasons:
        return [Paragraph("Nothing was refused.")]
    rows = [(step, reason, str(count), detail) for step, reason, count, detail in facts.reasons]
    return [TableBlock(("Step", "Reason", "Episodes", "For example"), rows, frozenset({2}))]


def _contents(facts: DatasetFacts) -> list[Block]:
    blocks: list[Block] = []
    groups: tuple[tuple[str, str, Callable[[EpisodeRow], str]], ...] = (
        ("Embodiments", "Embodiment", lambda row: row.embodiment),
        ("Tasks", "Task family", lambda row: row.task_family.replace("_", " ")),
        ("Splits", "Split", lambda row: row.split.replace("_", " ")),
    )
    for title, heading, key in groups:
        table: list[tuple[str, ...]] = []
        for value in sorted({key(row) for row in facts.rows}):
            own = [row for row in facts.rows if key(row) == value]
            outcomes = Counter(row.outcome for row in own)
            counts = (outcomes["success"], outcomes["failure"], outcomes["unknown"])
            scenes = len({row.scene for row in own})
            table.append((value, str(scenes), str(len(own)), hours_text(own), *map(str, counts)))
        columns = (heading, "Scenes", "Episodes", "Hours", "Success", "Failure", "Unknown")
        blocks += [Heading(title), TableBlock(columns, table, frozenset(range(1, 7)))]
    return blocks


def _views(facts: DatasetFacts) -> list[Block]:
    table: list[tuple[str, ...]] = []
    for view in facts.views:
        own = [row for row in facts.rows if view in row.views]
        primary = sum(row.primary_view == view for row in own)
        sizes = ", ".join(facts.resolutions(own, view)) or UNKNOWN
        table.append((view, str(len(own)), sizes, ", ".join(sorted({f"{row.fps:g}" for row in own})), str(primary)))
    why = {
        "source": "as the source declares",
        "configured": "as configured",
        "head": "the head's, because the source's own choice has no images",
        "most_motion": "the view with most motion",
    }
    chosen = "; ".join(
        f"{view} in {count} ({why.get(reason, reason)})"
        for (view, reason), count in sorted(facts.primary_views.items(), key=lambda item: (-item[1], item[0]))
    )
    columns = ("View", "Episodes", "Width x height", "fps", "Primary in")
    return [
        Heading("Views"),
        TableBlock(columns, table, frozenset({1, 4})),
        Paragraph(f"Primary view for single-view training: {chosen}."),
    ]


def _instructions(facts: DatasetFacts) -> list[Block]:
    kinds = len({row.instruction for row in facts.rows})
    rows = [(text or "(none)", str(count)) for text, count in facts.instructions(MOST_INSTRUCTIONS)]
    blocks: list[Block] = [Heading("Instructions"), TableBlock(("Instruction", "Episodes"), rows, frozenset({1}))]
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
    return [*blocks, Paragraph(" ".join(notes))] if notes else blocks


def _calibration(facts: DatasetFacts) -> list[Block]:
    blocks: list[Block] = [
        Paragraph(f"{facts.calibrated} of {len(facts.rows)} entries have K and extrinsics for every view.")
    ]
    declared = [
        (source.label, name, value) for source in facts.sources for name, value in sorted(source.conventions.items())
    ]
    if declared:
        blocks += [
            Paragraph("Departures from the contract that the configuration declares, and that curation repaired:"),
            TableBlock(("Source", "Convention", "As recorded"), declared),
        ]
    if facts.calibration:
        rows = [(name.replace("_", " "), str(passed), str(failed)) for name, passed, failed in facts.calibration]
        blocks.append(TableBlock(("Detector", "Episodes passed", "Episodes failed"), rows, frozenset({1, 2})))
    elif not facts.filtered:
        blocks.append(Paragraph("These are curated episodes: the filters have not judged them yet."))
    return blocks


def duplicate_blocks(facts: DatasetFacts) -> list[Block]:
    """Copies that were taken out, and scenes that may be on both sides of the split."""
    counts = {
        reason: facts.duplicates(reason) for reason in ("duplicate", "near_duplicate", "duplicate_id", "scene_leak")
    }
    blocks: list[Block] = [
        Paragraph(
            f"Taken out: {counts['duplicate']} exact duplicates, {counts['near_duplicate']} near duplicates (encoded or cut"
            f" another way), {counts['duplicate_id']} repeated ids, {counts['scene_leak']} episodes of scenes that are"
            " tested on under another name."
        ),
        Paragraph(_split_note(facts)),
    ]
    leaks = facts.curation.get("scene_leaks", [])
    if not facts.curation:
        blocks.append(Paragraph("Leakage was not looked for: this set does not come from curation."))
    elif facts.curation.get("leakage_action") == "off":
        blocks.append(Paragraph("Leakage was not looked for: curate.leakage.action is off."))
    elif not leaks:
        blocks.append(Paragraph("No two differently named scenes on both sides of the split look like one."))
    else:
        rows = [(str(leak["learning_scene"]), str(leak["testing_scene"]), str(leak["distance"])) for leak in leaks]
        blocks += [
            Paragraph(
                f"{counted(len(leaks), 'pair')} of scenes across the split look like one (first images; bits of 256):"
            ),
            TableBlock(("Learnt from", "Tested on", "Differing bits"), rows[:MOST_LEAKS], frozenset({2})),
        ]
    return blocks


def _split_note(facts: DatasetFacts) -> str:
    """Whether training and test share a scene: counted, not assumed."""
    learnt = {row.scene for row in facts.rows if row.split in ("train", "validation")}
    tested = {row.scene for row in facts.rows if row.split in ("test", "ood_test")}
    if not learnt or not tested:
        return "Only one side of the split is in this set, so no scene can be on both."
    shared = sorted(learnt & tested)
    if shared:
        return f"Warning: {len(shared)} scenes are both learnt from and tested on ({', '.join(shared[:4])})."
    return f"No scene that is tested on ({len(tested)}) is among those that are learnt from ({len(learnt)})."
