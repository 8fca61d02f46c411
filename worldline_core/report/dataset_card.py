"""The dataset card of an EpisodeSet: README.md (as the Hugging Face hub reads it), index.html, one picture a source."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import yaml

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.errors import DataError
from worldline_core.pictures.contact_sheet import SheetRow, contact_sheet, evenly_spaced
from worldline_core.pictures.labels import jpeg_bytes
from worldline_core.report.card_blocks import (
    Block,
    FunnelBlock,
    Heading,
    Paragraph,
    PictureBlock,
    TableBlock,
    card_blocks,
    summary,
)
from worldline_core.report.charts import funnel_chart
from worldline_core.report.dataset_facts import UNKNOWN, DatasetFacts
from worldline_core.report.markup import Column, Html, element, figure, join, paragraph, table
from worldline_core.report.page import asset
from worldline_core.store.atomic import write_bytes_atomic

PICTURES = "pictures"
ROWS_A_SOURCE = 6
MOMENTS = 6
SHEET_WIDTH = 1180
# The hub knows these by name; every other licence is "other" with its name beside it.
HUB_LICENSES = frozenset(
    {
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
    }
)
_SIZES = (
    (10**3, "n<1K"),
    (10**4, "1K<n<10K"),
    (10**5, "10K<n<100K"),
    (10**6, "100K<n<1M"),
    (10**7, "1M<n<10M"),
    (10**8, "10M<n<100M"),
    (10**9, "100M<n<1B"),
)


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
    pictures, files = _write_pictures(facts, output)
    blocks = card_blocks(facts, pictures)
    readme, page = output / "README.md", output / "index.html"
    write_bytes_atomic(readme, markdown_card(facts, heading, blocks).encode())
    write_bytes_atomic(page, html_card(facts, heading, blocks).encode())
    return [readme, page, *files]


def markdown_card(facts: DatasetFacts, title: str, blocks: Sequence[Block]) -> str:
    """Markdown with the hub's YAML header."""
    header = yaml.safe_dump(hub_metadata(facts, title), sort_keys=False, allow_unicode=True, width=120)
    parts = [f"---\n{header}---", f"# {_plain(title)}", *(_markdown(block) for block in blocks)]
    return "\n\n".join(parts) + "\n"


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
        "size_categories": [next((name for limit, name in _SIZES if facts.num_frames < limit), "1B<n<10B")],
        "configs": [
            {"config_name": Path(name).name, "data_files": f"{name}/data/*/*.parquet"}
            for name in sorted(facts.sizes)
            if not name.startswith("..")
        ],
    }
    return {key: value for key, value in metadata.items() if value}


def _markdown(block: Block) -> str:
    match block:
        case Heading(text):
            return f"## {_plain(text)}"
        case Paragraph(text):
            return _plain(text)
        case PictureBlock(path, caption):
            return f"![{_plain(caption)}]({path})\n\n{_plain(caption)}"
        case FunnelBlock(steps):
            rows = [(label, str(count)) for label, count in steps]
            return _markdown(TableBlock(("Step", "Number"), rows, frozenset({1})))
        case TableBlock(columns, rows, numeric):
            rule = ["---:" if position in numeric else "---" for position in range(len(columns))]
            lines = [columns, rule, *rows]
            return "\n".join("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines)


def _plain(text: str) -> str:
    """Text of recordings in Markdown: no markup, no line break, whatever was recorded."""
    escaped = re.sub(r"([\\`*\[\]<>#|])", r"\\\1", " ".join(text.split()))
    return re.sub(r"(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])", r"\\_", escaped)  # within a word it is no markup


def _cell(text: str) -> str:
    return text if re.fullmatch(r"-+:?", text) else _plain(text)


def html_card(facts: DatasetFacts, title: str, blocks: Sequence[Block]) -> str:
    """One static page; its pictures lie beside it, nothing comes from a network."""
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element(
            "meta",
            http_equiv="Content-Security-Policy",
            content="default-src 'none'; img-src 'self' file:; style-src 'unsafe-inline'",
        ),
        element("title", title),
        element("style", Html(asset("style.css"))),
    )
    shown = [block_html(block) for block in blocks if block != Paragraph(summary(facts))]
    body = element(
        "body",
        element(
            "main",
            element("header", element("h1", title), element("p", summary(facts), class_="subtitle")),
            element("section", element("h2", title), shown),
        ),
        element("footer", "Made by ", element("code", "worldline card"), " from the set's own tables."),
    )
    return "<!doctype html>\n" + str(element("html", head, body, lang="en")) + "\n"


def block_html(block: Block) -> Html:
    """One block of a card as HTML."""
    match block:
        case Heading(text):
            return element("h3", text)
        case Paragraph(text):
            return paragraph(text)
        case PictureBlock(path, caption):
            return figure(element("img", src=path, alt=caption, loading="lazy"), caption, class_="wide")
        case FunnelBlock(steps):
            return funnel_chart(steps, title="Episodes left after each step")
        case TableBlock(columns, rows, numeric):
            headings = [Column(name, numeric=position in numeric) for position, name in enumerate(columns)]
            return join(table(headings, rows))


def _write_pictures(facts: DatasetFacts, output: Path) -> tuple[list[PictureBlock], list[Path]]:
    """One contact sheet a source: up to six episodes, over embodiments and tasks, six moments of the primary view."""
    episodes = EpisodeSet.open(facts.folder)
    blocks: list[PictureBlock] = []
    files: list[Path] = []
    for number, name in enumerate(facts.names):
        rows = [row for index in _examples(facts, name) if (row := _sheet_row(episodes, index)) is not None]
        if not rows:
            continue
        path = output / PICTURES / f"source_{number:02d}.jpg"
        write_bytes_atomic(path, jpeg_bytes(contact_sheet(rows, tile_height=128, min_width=SHEET_WIDTH)))
        caption = f"Source {name}: {len(rows)} episodes from their first to their last frame, primary view."
        blocks.append(PictureBlock(f"{PICTURES}/{path.name}", caption))
        files.append(path)
    return blocks, files


def _examples(facts: DatasetFacts, source: str) -> list[int]:
    """Positions of up to six rows of a source, over its embodiments and tasks as far as they go."""
    groups: dict[tuple[str, str], list[int]] = {}
    for position, row in enumerate(facts.rows):
        if row.source == source and row.primary_view in row.views:
            groups.setdefault((row.embodiment, row.task_family), []).append(position)
    turns = [positions for _, positions in sorted(groups.items())]
    chosen: list[int] = []
    depth = 0
    while len(chosen) < ROWS_A_SOURCE and any(depth < len(positions) for positions in turns):
        chosen += [positions[depth] for positions in turns if depth < len(positions)]
        depth += 1
    if len(turns) > ROWS_A_SOURCE:
        chosen = [chosen[round(i)] for i in np.linspace(0, len(turns) - 1, ROWS_A_SOURCE)]
    return sorted(chosen[:ROWS_A_SOURCE])


def _sheet_row(episodes: EpisodeSet, index: int) -> SheetRow | None:
    row = episodes.rows[index]
    try:
        frames = np.asarray(episodes.frames(index, row.primary_view, evenly_spaced(row.video_frames, MOMENTS)))
    except (DataError, RejectedInputError):
        return None  # the caption counts the episodes that are shown
    title = f"{row.embodiment}  ·  {row.instruction or '(no instruction)'}"
    return SheetRow(title, frames, f"{row.episode_id}  ·  {row.scene}  ·  {row.split}  ·  {row.outcome}")
