"""Static pages from templates: every text is escaped, styles and scripts are inside the page, media beside it.

Templates are beside the code that fills them, named from the package's root: `report/data.html`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markdown_it import MarkdownIt
from markupsafe import Markup

from worldline_core.untrusted_text import cut, visible

PACKAGE = Path(__file__).parents[1]
NARROW_SPACE, MINUS = "\u202f", "\u2212"


def _finalize(value: object) -> object:
    """Format a value for a template; plain text is cut, because recordings may hold any."""
    return cut(value) if isinstance(value, str) and not isinstance(value, Markup) else value


@cache
def environment() -> Environment:
    """The templates of the whole package; an unknown name in one of them is an error."""
    found = Environment(
        loader=FileSystemLoader(PACKAGE),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_finalize,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.globals |= {"asset": asset, "interval": interval}
    found.filters |= {"number": number, "percent": percent, "words": words, "duration": duration, "markdown": markdown}
    return found


def render(template: str, **values: object) -> Markup:
    """A template filled with values: plain text among them is escaped and cut, what was rendered before is not.

    Control characters and those that turn the direction of text, wherever they come from, are written as escapes.
    """
    return Markup(visible(environment().get_template(template).render(**values)))  # noqa: S704  # escaped by the environment


def render_macro(template: str, macro: str, **values: object) -> Markup:
    """One macro of a template, for pieces that Python puts together."""
    return getattr(environment().get_template(template).module, macro)(**values)


@cache
def asset(name: str) -> Markup:
    """A style sheet or a script of this package, to be put into a page as it is."""
    return Markup((PACKAGE / name).read_text(encoding="utf-8"))  # noqa: S704  # a file of this package


@cache
def _markdown_reader() -> MarkdownIt:
    reader = MarkdownIt("commonmark", {"html": False}).enable("table").disable(["link", "autolink", "image"])
    reader.add_render_rule("table_open", lambda *_: '<div class="table-wrap"><div tabindex="0"><table>\n')
    reader.add_render_rule("table_close", lambda *_: "</table></div></div>\n")
    return reader


def markdown(text: str, *, heading: int = 4) -> Markup:
    """Markdown as HTML; raw HTML, links and pictures stay text.

    Args:
        heading: level of the text's first level of headings.
    """
    reader = _markdown_reader()
    tokens = reader.parse(str(text))
    for token in tokens:
        if token.type in ("heading_open", "heading_close"):
            token.tag = f"h{min(6, int(token.tag[1]) + heading - 1)}"
    return Markup(reader.renderer.render(tokens, reader.options, {}))  # noqa: S704  # raw HTML is switched off


def number(value: object, digits: int = 2, *, signed: bool = False) -> str:
    """A number for readers: fixed digits for reals, grouped thousands for integers, anything else as it is."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value)
    sign = "+" if signed and value > 0 else ""
    if isinstance(value, int):
        return sign + f"{value:,}".replace(",", NARROW_SPACE).replace("-", MINUS)
    return sign + f"{value:.{digits}f}".replace("-", MINUS)


def percent(share: float) -> str:
    """A share as `64 %`."""
    return f"{number(100 * float(share), 0)}{NARROW_SPACE}%"


def duration(seconds: float) -> str:
    """Seconds in words that a reader takes in at once."""
    if seconds < 100:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.1f} min" if minutes < 120 else f"{minutes / 60:.1f} h"


def words(name: object) -> str:
    """A name of the code as words: `held_out` as `held out`."""
    return str(name).replace("_", " ")


def interval(measured: dict[str, float] | None, digits: int = 2, *, signed: bool = False) -> Markup | None:
    """`{"mean", "low", "high"}` as a value with its interval in smaller type, `0.52 [0.48, 0.56]`; None stays None."""
    if measured is None:
        return None
    low, high = (number(float(measured[key]), digits) for key in ("low", "high"))
    return with_note(number(float(measured["mean"]), digits, signed=signed), f"[{low}, {high}]")


def with_note(value: str, note: str) -> Markup:
    """A value of a table with a note in smaller type."""
    return render_macro("pages/parts.html", "with_note", value=value, note=note)


def code(text: object) -> Markup:
    """Inline code."""
    return Markup("<code>{}</code>").format(text)


@dataclass(frozen=True)
class Table:
    """A table; the first cell of each row is its heading, None is shown as a dash.

    Attributes:
        numeric: positions of the columns with numbers, aligned right.
        dense: intervals below their values, for tables of many columns.
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[object]]
    numeric: Iterable[int] = ()
    caption: str = ""
    dense: bool = False

    def __html__(self) -> Markup:
        return render_macro("pages/parts.html", "table", shown=self, numeric=set(self.numeric))
