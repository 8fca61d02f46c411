"""Charts as inline SVG: they follow the page's theme, fit a phone, print well, and their bytes are reproducible."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from worldline_core.pages.page import MINUS, NARROW_SPACE, number, percent, render_macro

WIDTH, HEIGHT = 480, 270
LEFT, RIGHT, TOP, BOTTOM = 62, 14, 12, 30
VALUE_WIDTH, ROW_HEIGHT = 70, 46
"""Room for the number at the right end of an interval chart's row, and the row's height."""


@dataclass(frozen=True)
class Series:
    """One line: points, optionally an interval around each, and a colour class (`c0` .. `c7`)."""

    label: str
    x: Sequence[float]
    y: Sequence[float]
    low: Sequence[float] | None = None
    high: Sequence[float] | None = None
    colour: str = "c0"
    dashed: bool = False
    markers: bool = False


@dataclass(frozen=True)
class Dot:
    """One row of an interval chart."""

    label: str
    value: float
    low: float
    high: float
    colour: str = "c0"


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


def _value_range(series: Sequence[Series], log: bool) -> tuple[float, float]:
    """Range of all finite values with a little air; logarithmic ranges look at positive values only."""
    values = [float(v) for s in series for part in (s.y, s.low or (), s.high or ()) for v in part if math.isfinite(v)]
    values = [v for v in values if v > 0 or not log] or [0.1, 1.0]
    low, high = min(values), max(values)
    air = 0.06 * (high - low) or 0.05 * abs(high) or 1.0
    return (low / 1.15, high * 1.15) if log else (low - air, high + air)


def line_chart(
    series: Sequence[Series],
    *,
    title: str,
    x_label: str,
    y_label: str,
    log_y: bool = False,
    log_x: bool = False,
    x_ticks: Sequence[float] | None = None,
    shares: bool = False,
) -> Markup:
    """Lines with optional interval bands and a legend below the title.

    Args:
        log_y, log_x: logarithmic axes; values that are not positive are left out.
        x_ticks: where the x axis is labelled (default: round numbers).
        shares: y is from 0 to 1 and labelled in per cent.
    """
    xs = [float(v) for s in series for v in s.x if math.isfinite(v) and (not log_x or v > 0)]
    x_axis = Axis(min(xs, default=0.0), max(xs, default=1.0), LEFT, WIDTH - RIGHT, log_x)
    y_axis = Axis(*((0.0, 1.02) if shares else _value_range(series, log_y)), HEIGHT - BOTTOM, TOP, log_y)
    rows = [(y_axis.at(v), percent(v) if shares else tick_label(v)) for v in y_axis.ticks()]
    columns = [(x_axis.at(v), tick_label(v)) for v in (x_axis.ticks(6) if x_ticks is None else x_ticks)]
    return render_macro(
        "pages/charts.html", "lines", title=title, x_label=x_label, y_label=y_label, rows=rows, columns=columns,
        lines=[_line(item, x_axis, y_axis) for item in series], legend=series if len(series) > 1 else [],
        width=WIDTH, height=HEIGHT, left=LEFT, right=WIDTH - RIGHT, bottom=HEIGHT - BOTTOM,
    )  # fmt: skip


def _line(item: Series, x_axis: Axis, y_axis: Axis) -> dict[str, object]:
    """The points of one series as SVG's attribute texts: the line, its band, and single points with their tooltips."""
    usable = [
        i
        for i, (x, y) in enumerate(zip(item.x, item.y, strict=True))
        if math.isfinite(x) and math.isfinite(y) and (not y_axis.log or y > 0) and (not x_axis.log or x > 0)
    ]

    def points(values: Sequence[float]) -> list[str]:
        return [f"{x_axis.at(item.x[i]):g},{y_axis.at(values[i]):g}" for i in usable]

    band = ""
    if item.low is not None and item.high is not None and len(usable) > 1:
        band = " ".join(points(item.low) + points(item.high)[::-1])
    dots = [
        (x_axis.at(item.x[i]), y_axis.at(item.y[i]), f"{item.label}: {tick_label(item.x[i])}, {item.y[i]:.4g}")
        for i in (usable if item.markers or len(usable) == 1 else ())
    ]
    line = " ".join(points(item.y)) if len(usable) > 1 else ""
    return {"style": item, "line": line, "band": band, "dots": dots}


def interval_chart(
    dots: Sequence[Dot], *, title: str, value_label: str, zero_line: bool = False, digits: int = 3, signed: bool = False
) -> Markup:
    """Dots with interval whiskers below their labels, a row each: comparisons with their uncertainty."""
    values = [v for d in dots for v in (d.value, d.low, d.high)] + [0.0] * zero_line
    air = 0.08 * (max(values) - min(values)) or 0.1
    axis = Axis(min(values) - air, max(values) + air, 8, WIDTH - VALUE_WIDTH)
    rows = [
        {
            "dot": dot, "top": 8 + ROW_HEIGHT * i, "at": axis.at(dot.value), "ends": (axis.at(dot.low), axis.at(dot.high)),
            "shown": number(float(dot.value), digits, signed=signed),
        }
        for i, dot in enumerate(dots)
    ]  # fmt: skip
    return render_macro(
        "pages/charts.html", "dots", title=title, x_label=value_label, rows=rows, bottom=8 + ROW_HEIGHT * len(dots),
        width=WIDTH, zero=axis.at(0.0) if zero_line else None, ticks=[(axis.at(v), tick_label(v)) for v in axis.ticks(4)],
    )  # fmt: skip
