"""Charts as inline SVG: they follow the page's theme, print well, and their bytes are reproducible."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from worldline_core.report.markup import Html, element, join

WIDTH, HEIGHT = 600, 320
LEFT, RIGHT, TOP, BOTTOM = 58, 16, 14, 46
CHARACTER = 7
"""Width of a letter of a row's label."""


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
    faint: bool = False
    """A raw curve behind its smoothed one: thin, pale, without an entry in the legend."""


@dataclass(frozen=True)
class Dot:
    """One row of an interval chart."""

    label: str
    value: float
    low: float | None = None
    high: float | None = None
    colour: str = "c0"


def nice_ticks(low: float, high: float, wanted: int = 5) -> list[float]:
    """Round numbers that cover a range."""
    if not math.isfinite(low) or not math.isfinite(high) or low == high:
        return [low]
    raw = (high - low) / max(wanted, 1)
    magnitude = 10.0 ** math.floor(math.log10(raw))
    step = next(m * magnitude for m in (1, 2, 2.5, 5, 10) if m * magnitude >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [round(i * step, 12) for i in range(first, math.floor(high / step + 1e-9) + 1)]


def tick_label(value: float) -> str:
    """A short number for an axis."""
    if value and (abs(value) >= 1e5 or abs(value) < 1e-3):
        return f"{value:.0e}".replace("e-0", "e-").replace("e+0", "e")
    return f"{value:,.6g}".replace(",", "\u202f").replace("-", "\u2212")


@dataclass(frozen=True)
class Axis:
    """A linear or logarithmic map from values to pixels."""

    low: float
    high: float
    start: float
    stop: float
    log: bool = False

    def at(self, value: float) -> float:
        low, high, value = (math.log10(max(v, 1e-300)) if self.log else v for v in (self.low, self.high, value))
        share = 0.5 if high == low else (value - low) / (high - low)
        return round(self.start + share * (self.stop - self.start), 2)

    def ticks(self, wanted: int = 5) -> list[float]:
        if not self.log:
            return nice_ticks(self.low, self.high, wanted)
        decades = math.log10(self.high / self.low)
        if decades < 0.5:
            return nice_ticks(self.low, self.high, wanted)
        exponents = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        factors = (1,) if decades > 3 else (1, 3) if decades > 1.3 else (1, 2, 3, 5, 7)
        ticks = [m * 10.0**e for e in exponents for m in factors]
        return [t for t in ticks if self.low * 0.999 <= t <= self.high * 1.001]


def value_range(series: Sequence[Series], log: bool) -> tuple[float, float]:
    """Range of all finite values with a little air; logarithmic ranges look at positive values only."""
    values = [float(v) for s in series for part in (s.y, s.low or (), s.high or ()) for v in part if math.isfinite(v)]
    values = [v for v in values if v > 0] if log else values
    if not values:
        return (0.1, 1.0) if log else (0.0, 1.0)
    low, high = min(values), max(values)
    if log:
        return low / 1.15, high * 1.15
    air = 0.06 * (high - low) or 0.05 * abs(high) or 1.0
    return low - air, high + air


def line_chart(
    series: Sequence[Series],
    *,
    title: str,
    x_label: str,
    y_label: str,
    log_y: bool = False,
    log_x: bool = False,
    y_range: tuple[float, float] | None = None,
    x_ticks: Sequence[float] | None = None,
    percent: bool = False,
) -> Html:
    """Lines with optional interval bands, a legend below the title, and a readable description.

    Args:
        log_y, log_x: logarithmic axes; values that are not positive are left out.
        x_ticks: where the x axis is labelled (default: round numbers).
        percent: y values are fractions and are labelled in per cent.
    """
    xs = [float(v) for s in series for v in s.x if math.isfinite(v) and (not log_x or v > 0)]
    x_low, x_high = (min(xs), max(xs)) if xs else (0.0, 1.0)
    y_low, y_high = y_range or value_range(series, log_y)
    x_axis = Axis(x_low, x_high, LEFT, WIDTH - RIGHT, log_x)
    y_axis = Axis(y_low, y_high, HEIGHT - BOTTOM, TOP, log_y)
    parts = grid(x_axis, y_axis, x_label, y_label, x_ticks, percent)
    for item in series:
        parts.append(line(item, x_axis, y_axis))
    return chart_figure(title, join(parts), HEIGHT, legend(series))


def grid(
    x_axis: Axis, y_axis: Axis, x_label: str, y_label: str, x_ticks: Sequence[float] | None, percent: bool
) -> list[Html]:
    """Grid lines, tick labels and axis titles."""
    parts: list[Html] = []
    for tick in y_axis.ticks():
        y = y_axis.at(tick)
        parts.append(element("line", x1=LEFT, x2=WIDTH - RIGHT, y1=y, y2=y, class_="grid"))
        shown = f"{tick * 100:.0f}\u202f%" if percent else tick_label(tick)
        parts.append(element("text", shown, x=LEFT - 8, y=y + 4, class_="tick end"))
    for tick in x_ticks if x_ticks is not None else x_axis.ticks(6):
        x = x_axis.at(tick)
        parts.append(element("line", x1=x, x2=x, y1=HEIGHT - BOTTOM, y2=HEIGHT - BOTTOM + 4, class_="axis"))
        parts.append(element("text", tick_label(tick), x=x, y=HEIGHT - BOTTOM + 18, class_="tick middle"))
    base = HEIGHT - BOTTOM
    parts.append(element("line", x1=LEFT, x2=WIDTH - RIGHT, y1=base, y2=base, class_="axis"))
    parts.append(element("text", x_label, x=(LEFT + WIDTH - RIGHT) / 2, y=HEIGHT - 6, class_="label middle"))
    middle = (TOP + base) / 2
    parts.append(element("text", y_label, x=14, y=middle, class_="label middle", transform=f"rotate(-90 14 {middle})"))
    return parts


def line(series: Series, x_axis: Axis, y_axis: Axis) -> Html:
    """One series: band, line, and points with a tooltip each."""
    usable = [
        i
        for i, (x, y) in enumerate(zip(series.x, series.y, strict=True))
        if math.isfinite(x) and math.isfinite(y) and (not y_axis.log or y > 0) and (not x_axis.log or x > 0)
    ]
    points = [(x_axis.at(series.x[i]), y_axis.at(clamp(series.y[i], y_axis))) for i in usable]
    parts: list[Html] = []
    if series.low is not None and series.high is not None and len(usable) > 1:
        lower = [(x_axis.at(series.x[i]), y_axis.at(clamp(series.low[i], y_axis))) for i in usable]
        upper = [(x_axis.at(series.x[i]), y_axis.at(clamp(series.high[i], y_axis))) for i in usable]
        parts.append(element("polygon", points=point_list(lower + upper[::-1]), class_="band"))
    if len(points) > 1:
        parts.append(
            element(
                "polyline", points=point_list(points), class_="line", stroke_dasharray="6 5" if series.dashed else None
            )
        )
    if series.markers or len(points) == 1:
        for i, (x, y) in zip(usable, points, strict=True):
            tip = element("title", f"{series.label}: {tick_label(series.x[i])}, {series.y[i]:.4g}")
            parts.append(element("circle", tip, cx=x, cy=y, r=4, class_="dot"))
    return element("g", parts, class_=f"series {series.colour}{' faint' if series.faint else ''}")


def clamp(value: float, axis: Axis) -> float:
    """Keeps a value within the drawn range."""
    return min(max(float(value), axis.low), axis.high)


def point_list(points: Sequence[tuple[float, float]]) -> str:
    """Points as SVG's attribute text."""
    return " ".join(f"{x:g},{y:g}" for x, y in points)


def legend(series: Sequence[Series]) -> Html:
    """Names and colours of the lines."""
    shown = [item for item in series if not item.faint]
    if len(shown) < 2:
        return Html("")
    entries = [
        element("span", element("i", class_=f"key {s.colour}{' dashed' if s.dashed else ''}"), s.label, class_="entry")
        for s in shown
    ]
    return element("div", entries, class_="legend")


def interval_chart(
    dots: Sequence[Dot], *, title: str, value_label: str, zero_line: bool = False, digits: int = 3, signed: bool = False
) -> Html:
    """Horizontal dots with interval whiskers, a row each: comparisons with their uncertainty."""
    row_height, right = 34, 90
    left = min(WIDTH // 2, 24 + CHARACTER * max((len(dot.label) for dot in dots), default=0))
    height = 12 + row_height * len(dots) + 44
    values = [v for d in dots for v in (d.value, d.low, d.high) if v is not None and math.isfinite(v)]
    low, high = (min(values), max(values)) if values else (0.0, 1.0)
    if zero_line:
        low, high = min(low, 0.0), max(high, 0.0)
    air = 0.08 * (high - low) or 0.1
    axis = Axis(low - air, high + air, left, WIDTH - right)
    bottom = 12 + row_height * len(dots)
    parts: list[Html] = []
    for tick in axis.ticks(4):
        x = axis.at(tick)
        parts.append(element("line", x1=x, x2=x, y1=8, y2=bottom, class_="grid"))
        parts.append(element("text", tick_label(tick), x=x, y=bottom + 17, class_="tick middle"))
    if zero_line:
        x = axis.at(0.0)
        parts.append(element("line", x1=x, x2=x, y1=4, y2=bottom + 4, class_="axis zero"))
    for index, dot in enumerate(dots):
        y = 12 + row_height * (index + 0.5)
        inner: list[Html] = [element("text", dot.label, x=left - 12, y=y + 4, class_="row end")]
        if dot.low is not None and dot.high is not None:
            inner.append(element("line", x1=axis.at(dot.low), x2=axis.at(dot.high), y1=y, y2=y, class_="whisker"))
        inner.append(
            element(
                "circle",
                element("title", f"{dot.label}: {dot.value:.4g}"),
                cx=axis.at(dot.value),
                cy=y,
                r=5,
                class_="dot",
            )
        )
        sign = "+" if signed and dot.value > 0 else ""
        shown = sign + f"{dot.value:.{digits}f}".replace("-", "\u2212")
        inner.append(element("text", shown, x=WIDTH - right + 14, y=y + 4, class_="row strong"))
        parts.append(element("g", inner, class_=f"series {dot.colour}"))
    parts.append(element("text", value_label, x=(left + WIDTH - right) / 2, y=height - 6, class_="label middle"))
    return chart_figure(title, join(parts), height, Html(""))


def funnel_chart(steps: Sequence[tuple[str, int]], *, title: str) -> Html:
    """Bars that shrink from what was found to what was kept, with counts and shares."""
    row_height, left = 40, 210
    height = 10 + row_height * len(steps) + 6
    most = max((count for _, count in steps), default=1) or 1
    parts: list[Html] = []
    for index, (label, count) in enumerate(steps):
        y = 8 + row_height * index
        width = round((WIDTH - left - 110) * count / most, 2)
        share = f"{100 * count / most:.0f}\u202f%"
        parts.append(element("text", label, x=left - 12, y=y + 21, class_="row end"))
        parts.append(element("rect", x=left, y=y + 3, width=max(width, 1), height=row_height - 14, rx=3, class_="bar"))
        shown = [element("tspan", f"{count}", class_="strong"), f"  {share}"]
        parts.append(element("text", shown, x=left + max(width, 1) + 10, y=y + 21, class_="row"))
    return chart_figure(title, element("g", parts, class_="series c0"), height, Html(""))


def chart_figure(title: str, content: Html, height: float, key: Html) -> Html:
    """A titled chart in a wrapper that scrolls on narrow screens."""
    svg = element(
        "svg",
        element("title", title),
        content,
        viewBox=f"0 0 {WIDTH} {height:g}",
        role="img",
        aria_label=title,
        class_="chart",
    )
    heading = element("div", title, class_="chart-title")
    return element("div", heading, key, element("div", svg, class_="chart-scroll"), class_="chart-box")
