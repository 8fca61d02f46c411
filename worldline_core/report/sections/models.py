"""Section "Models": the cards of the weights that were used, made readable."""

from __future__ import annotations

from pathlib import Path

from worldline_core.report.context import ReportContext, Section
from worldline_core.report.markdown import markdown
from worldline_core.report.markup import Column, element, join, number, table
from worldline_core.store.artifact_files import read_json

TITLE = "Models"
CARD = "MODEL_CARD.md"


def models_section(context: ReportContext) -> Section:
    """A table of checkpoints and every model card."""
    folders = {name: path for name, path in context.inputs.variants("models").items() if name}
    cards = {
        name: (path / CARD).read_text(encoding="utf-8", errors="replace")
        for name, path in folders.items()
        if (path / CARD).is_file()
    }
    if not folders:
        return Section("models", TITLE, missing="no model folders were given (inputs models.<name>).")
    rows = [
        [name, kind_of(path), number(size_of(path) / 1e6, 1), "yes" if name in cards else "missing"]
        for name, path in sorted(folders.items())
    ]
    columns = [Column("Model"), Column("Kind"), Column("Size, MB", numeric=True), Column("Card")]
    texts = [
        element("details", element("summary", f"Model card: {name}"), element("div", markdown(text), class_="prose"))
        for name, text in sorted(cards.items())
    ]
    lead = "Weights that ship with the project; each card says by which command, on what data, with which seeds and for how long it was trained."
    return Section("models", TITLE, lead, join(table(columns, rows), texts))


def kind_of(folder: Path) -> str:
    """What a folder's own description says it is."""
    for name in ("checkpoint.json", "tokenizer.json", "config.json", "segmenter.json"):
        content = read_json(folder / name)
        if content:
            return str(
                content.get("kind") or content.get("_class_name") or content.get("type") or name.removesuffix(".json")
            )
    return "folder"


def size_of(folder: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
