"""HTML that cannot be broken by its content: every text is escaped unless it was built here."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape

VOID_ELEMENTS = frozenset({"br", "hr", "img", "input", "link", "meta", "source"})


class Html(str):
    """Text that is already HTML. Anything else is escaped when it is put into an element."""

    __slots__ = ()


Child = str | int | float | None | Iterable["Child"]


def render(child: Child) -> Html:
    """Children as HTML: plain text is escaped, nested lists are flattened, None is nothing."""
    if child is None:
        return Html("")
    if isinstance(child, Html):
        return child
    if isinstance(child, str):
        return Html(escape(child, quote=True))
    if isinstance(child, (int, float)):
        return Html(escape(str(child)))
    return Html("".join(render(item) for item in child))


def element(name: str, /, *children: Child, **attributes: str | int | float | bool | None) -> Html:
    """One element. Attribute names lose a trailing `_`, inner `_` become `-`; False and None leave it out."""
    parts = [name]
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        label = key.rstrip("_").replace("_", "-")
        parts.append(label if value is True else f'{label}="{escape(str(value), quote=True)}"')
    opening = f"<{' '.join(parts)}>"
    if name in VOID_ELEMENTS:
        return Html(opening)
    return Html(f"{opening}{render(children)}</{name}>")


def join(*children: Child) -> Html:
    """Several pieces after one another."""
    return render(children)


def paragraph(*children: Child, class_: str | None = None) -> Html:
    """A paragraph."""
    return element("p", *children, class_=class_)


def code(text: str) -> Html:
    """Inline code."""
    return element("code", text)


def figure(content: Child, caption: Child, class_: str | None = None) -> Html:
    """A figure with its caption."""
    return element(
        "figure", element("div", content, class_="figure-body"), element("figcaption", caption), class_=class_
    )


def notice(*children: Child) -> Html:
    """A quiet box that says what is missing or what to mind."""
    return element("p", *children, class_="notice")


def details(summary: Child, *children: Child) -> Html:
    """Something folded away."""
    return element("details", element("summary", summary), *children)


@dataclass(frozen=True)
class Column:
    """One column of a table: heading, whether its cells are numbers, and how a value is shown."""

    heading: Child
    numeric: bool = False
    show: Callable[[object], Child] | None = None


def table(
    columns: Sequence[Column],
    rows: Iterable[Sequence[object]],
    *,
    caption: Child = None,
    emphasise: frozenset[int] = frozenset(),
    dense: bool = False,
) -> Html:
    """A table; the first cell of each row is its heading.

    Args:
        dense: intervals stand below their values, for tables of many columns.
        emphasise: numbers of the rows to set in bold.
    """
    head = element(
        "tr", [element("th", c.heading, scope="col", class_="number" if c.numeric else None) for c in columns]
    )
    body: list[Html] = []
    for index, row in enumerate(rows):
        cells: list[Html] = []
        for position, (column, value) in enumerate(zip(columns, row, strict=True)):
            shown: Child = column.show(value) if column.show is not None and value is not None else value  # type: ignore[assignment]
            if shown is None:
                shown = Html('<span class="absent">\u2013</span>')
            kind = "number" if column.numeric else None
            cells.append(
                element("th", shown, scope="row", class_=kind) if position == 0 else element("td", shown, class_=kind)
            )
        body.append(element("tr", cells, class_="emphasis" if index in emphasise else None))
    inner = [element("caption", caption)] if caption else []
    return element(
        "div",
        element("table", inner, element("thead", head), element("tbody", body)),
        class_="table-wrap dense" if dense else "table-wrap",
        tabindex="0",
    )


def number(value: object, digits: int = 2) -> str:
    """A number for a table: fixed digits for reals, grouped thousands for integers."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value)
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u202f")
    return f"{value:.{digits}f}".replace("-", "\u2212")


def interval(value: float, low: float | None, high: float | None, digits: int = 2, *, signed: bool = False) -> Html:
    """A value with its interval in smaller type: `0.52 [0.48, 0.56]`."""
    sign = "+" if signed and value > 0 else ""
    main = element("span", sign + number(float(value), digits), class_="value")
    if low is None or high is None:
        return main
    return join(
        main, element("span", f"[{number(float(low), digits)}, {number(float(high), digits)}]", class_="interval")
    )
