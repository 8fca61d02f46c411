"""The little Markdown that model cards use, as HTML: headings, paragraphs, lists, tables, code. All text is escaped."""

from __future__ import annotations

import re

from worldline_core.report.markup import Column, Html, element, join, table

INLINE = re.compile(r"`([^`]+)`|\*\*([^*]+)\*\*")


def inline(text: str) -> Html:
    """Code and bold within a line; everything else stays as it was written."""
    parts: list[str | Html] = []
    end = 0
    for match in INLINE.finditer(text):
        parts.append(text[end : match.start()])
        parts.append(element("code", match[1]) if match[1] is not None else element("strong", match[2]))
        end = match.end()
    return join(parts, text[end:])


def cells(line: str) -> list[str]:
    """The cells of a table's line."""
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


class MarkdownReader:
    """Collects lines into blocks."""

    def __init__(self) -> None:
        self.blocks: list[Html] = []
        self.kind = ""
        self.lines: list[str] = []

    def close(self) -> None:
        """Ends the block that is being read."""
        lines, kind = self.lines, self.kind
        self.lines, self.kind = [], ""
        if not lines:
            return
        if kind == "code":
            self.blocks.append(element("pre", "\n".join(lines)))
        elif kind == "list":
            self.blocks.append(element("ul", [element("li", inline(line)) for line in lines]))
        elif kind == "table":
            rows = [cells(line) for line in lines if not set(line) <= set("|-: ")]
            width = max(len(row) for row in rows)
            full = [row + [""] * (width - len(row)) for row in rows]
            self.blocks.append(
                table([Column(inline(c)) for c in full[0]], [[inline(c) for c in row] for row in full[1:]])
            )
        else:
            self.blocks.append(element("p", inline(" ".join(lines))))

    def add(self, kind: str, line: str) -> None:
        """Appends a line to a block of this kind, beginning one where another kind was read."""
        if self.kind != kind:
            self.close()
        self.kind = kind
        self.lines.append(line)

    def read(self, text: str) -> Html:
        """A whole text."""
        for line in text.splitlines():
            bare = line.strip()
            if bare.startswith("```"):
                was_code = self.kind == "code"
                self.close()
                self.kind = "" if was_code else "code"
            elif self.kind == "code":
                self.lines.append(line)
            elif not bare:
                self.close()
            elif bare.startswith("#"):
                self.close()
                self.blocks.append(element("h4", inline(bare.lstrip("#").strip())))
            elif bare.startswith(("- ", "* ")):
                self.add("list", bare[2:])
            elif bare.startswith("|"):
                self.add("table", bare)
            elif self.kind == "list" and line.startswith(" "):
                self.lines[-1] += " " + bare
            else:
                self.add("paragraph", bare)
        self.close()
        return join(self.blocks)


def markdown(text: str) -> Html:
    """Markdown as HTML."""
    return MarkdownReader().read(text)
