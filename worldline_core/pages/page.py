"""Static pages from templates, their tables and charts: every text is escaped, styles and scripts are inside, media beside.

Templates are beside the code that fills them, named from the package's root: `report/data.html`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
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
    found.filters |= {"number": number, "percent": percent, "words": words, "duration": duration}
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
    mean = number(float(measured["mean"]), digits, signed=signed)
    return render_macro("pages/parts.html", "with_note", value=mean, note=f"[{low}, {high}]")


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


# Charts as inline SVG: they follow the page's theme, fit a phone, print well, and their bytes are reproducible

WIDTH, HEIGHT = 480, 270
LEFT, RIGHT, TOP, BOTTOM = 62, 14, 12, 30


@dataclass(frozen=True)
class Line:
    """One line: points, and a colour class (`c0` .. `c7`)."""

    label: str
    x: Sequence[float]
    y: Sequence[float]
    colour: str = "c0"
    dashed: bool = False
    markers: bool = False


def nice_ticks(low: float, high: float, wanted: int = 5) -> list[float]:
    """Round numbers that cover a range."""
    if low == high:
        return [low]
    raw = (high - low) / wanted
    magnitude = 10.0 ** math.floor(math.log10(raw))
    step = next(m * magnitude for m in (1, 2, 2.5, 5, 10) if m * magnitude >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [round(i * step, 12) for i in range(first, math.floor(high / step + 1e-9) + 1)]


def tick_label(value: float) -> str:
    """A short number for an axis."""
    if value and (abs(value) >= 1e5 or abs(value) < 1e-3):
        return f"{value:.0e}".replace("e-0", "e-").replace("e+0", "e")
    return f"{value:,.6g}".replace(",", NARROW_SPACE).replace("-", MINUS)


@dataclass(frozen=True)
class Axis:
    """A linear or logarithmic map from values to the chart's units."""

    low: float
    high: float
    start: float
    stop: float
    log: bool = False

    def at(self, value: float) -> float:
        """Coordinate of a value; values outside of the range are drawn at its edge."""
        value = min(max(float(value), self.low), self.high)
        low, high, value = (math.log10(v) if self.log else v for v in (self.low, self.high, value))
        share = 0.5 if high == low else (value - low) / (high - low)
        return round(self.start + share * (self.stop - self.start), 2)

    def ticks(self, wanted: int = 5) -> list[float]:
        decades = math.log10(self.high / self.low) if self.log else 0.0
        if decades < 0.5:
            return nice_ticks(self.low, self.high, wanted)
        exponents = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        factors = (1,) if decades > 3 else (1, 3) if decades > 1.3 else (1, 2, 3, 5, 7)
        ticks = [m * 10.0**e for e in exponents for m in factors]
        return [t for t in ticks if self.low * 0.999 <= t <= self.high * 1.001]


def line_chart(
    series: Sequence[Line],
    *,
    title: str,
    x_label: str,
    y_label: str,
    log_y: bool = False,
) -> Markup:
    """Lines with a legend below the title; values that are not finite, or not positive on a logarithmic axis, are left out."""
    found = [
        (item, [(x, y) for x, y in zip(item.x, item.y, strict=True) if math.isfinite(y) and (y > 0 or not log_y)])
        for item in series
    ]
    xs, ys = ([p[k] for _, points in found for p in points] or [0.1, 1.0] for k in (0, 1))
    air = 0.06 * (max(ys) - min(ys)) or 0.05 * abs(max(ys)) or 1.0
    y_range = (min(ys) / 1.15, max(ys) * 1.15) if log_y else (min(ys) - air, max(ys) + air)
    x_axis = Axis(min(xs), max(xs), LEFT, WIDTH - RIGHT)
    y_axis = Axis(*y_range, HEIGHT - BOTTOM, TOP, log_y)
    rows = [(y_axis.at(v), tick_label(v)) for v in y_axis.ticks()]
    columns = [(x_axis.at(v), tick_label(v)) for v in x_axis.ticks(6)]
    lines = [
        (item, [(f"{tick_label(x)}, {y:.4g}", x_axis.at(x), y_axis.at(y)) for x, y in points]) for item, points in found
    ]
    return render_macro(
        "pages/charts.html", "lines", title=title, x_label=x_label, y_label=y_label, rows=rows, columns=columns, lines=lines,
        width=WIDTH, height=HEIGHT, left=LEFT, right=WIDTH - RIGHT, bottom=HEIGHT - BOTTOM,
    )  # fmt: skip
