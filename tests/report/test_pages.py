"""Templates escape what they show, charts carry their data, colours can be read."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import jinja2
import pytest

from worldline_core.pages.charts import (
    VALUE_WIDTH,
    WIDTH,
    Axis,
    Dot,
    Series,
    interval_chart,
    line_chart,
    nice_ticks,
)
from worldline_core.pages.page import asset, environment, interval, markdown, number, percent, render


class _Texts(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)


def tags(html: str) -> list[str]:
    parser = _Texts()
    parser.feed(html)
    return parser.tags


def test_text_and_attributes_are_escaped(hostile_text: str) -> None:
    attribute = '"><img src=x onerror=alert(1)>'
    html = environment().from_string('<p title="{{ title }}">{{ text }}</p>').render(text=hostile_text, title=attribute)
    assert tags(html) == ["p"]
    assert "&lt;script&gt;" in html


def test_every_template_escapes_but_those_of_markdown() -> None:
    names = environment().list_templates(extensions=["html", "md"])
    assert {"pages/base.html", "report/overview.html", "report/card.md"} <= set(names)
    sources = {name: environment().loader.get_source(environment(), name)[0] for name in names}  # type: ignore[union-attr]
    assert not [n for n, text in sources.items() if n.endswith(".html") and re.search(r"\|\s*safe|autoescape", text)]


def test_a_name_that_the_template_does_not_know_is_an_error() -> None:
    with pytest.raises(jinja2.UndefinedError, match="'target' is undefined"):
        render("report/redirect.html", title="t")


def test_numbers_are_written_for_readers() -> None:
    assert number(1234567) == "1\u202f234\u202f567"
    assert number(-0.126) == "\u22120.13"
    assert percent(-0.2) == "\u221220\u202f%"
    assert "[0.40, 0.60]" in str(interval({"mean": 0.5, "low": 0.4, "high": 0.6}))
    assert "+0.50" in str(interval({"mean": 0.5, "low": 0.4, "high": 0.6}, signed=True))
    assert interval(None) is None


def test_markdown_of_others_has_no_links_pictures_or_html() -> None:
    text = "[a](javascript:alert(1)) ![b](https://x/y.png) <https://x> <img src=x onerror=alert(1)> &lt;b&gt;"
    assert tags(markdown(text)) == ["p"]


def colours() -> dict[str, tuple[str, str]]:
    """Light and dark of every colour that the style sheet names."""
    found = re.findall(r"--([\w-]+): light-dark\((#\w{6}), (#\w{6})\)", asset("pages/style.css"))
    return {name: (light, dark) for name, light, dark in found}


def luminance(colour: str) -> float:
    """Relative luminance of WCAG 2."""
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("text", ["ink", "soft", "faint", "accent", "good", "bad"])
@pytest.mark.parametrize("ground", ["paper", "card", "stripe", "notice"])
def test_text_can_be_read_in_both_themes(text: str, ground: str) -> None:
    for theme in (0, 1):
        assert contrast(colours()[text][theme], colours()[ground][theme]) >= 4.5


def test_lines_of_charts_stand_out_and_every_text_colour_is_tested() -> None:
    found = colours()
    for name in (f"c{i}" for i in range(8)):
        assert min(contrast(found[name][theme], found["card"][theme]) for theme in (0, 1)) >= 3.0
    used = set(re.findall(r"(?<![-\w])(?:color|fill): var\(--([\w-]+)\)", asset("pages/style.css")))
    assert used <= {"ink", "soft", "faint", "accent", "good", "bad", "paper", "c"}  # paper stands on ink, c is no text


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-3.2, 17.0), (0.0021, 0.0026), (12.0, 90000.0)])
def test_ticks_are_round_and_inside(low: float, high: float) -> None:
    ticks = nice_ticks(low, high)
    assert 2 <= len(ticks) <= 12
    assert all(low - 1e-9 <= tick <= high + 1e-9 for tick in ticks)


def test_axis_maps_both_ends() -> None:
    assert (Axis(2, 32, 0, 100, log=True).at(8), Axis(0, 4, 100, 0).at(1)) == (50.0, 75.0)


def test_charts_are_xml_and_hold_every_point(hostile_text: str) -> None:
    series = [
        Series(hostile_text, [1, 2, 3], [0.5, 0.25, float("nan")], [0.4, 0.2, 0.1], [0.6, 0.3, 0.2], markers=True)
    ]
    chart = line_chart(series, title=hostile_text, x_label="step", y_label="loss", log_y=True)
    root = ElementTree.fromstring(chart)  # noqa: S314  # made two lines above
    assert len(root.findall(".//circle")) == 2  # the value that is not a number is left out
    intervals = interval_chart([Dot("a", 0.1, -0.2, 0.3)], title="t", value_label="v", zero_line=True)
    dots = ElementTree.fromstring(intervals)  # noqa: S314
    assert (len(dots.findall(".//circle")), len(dots.findall(".//line[@class='whisker']"))) == (1, 1)


def test_row_labels_of_an_interval_chart_stay_inside_the_picture() -> None:
    name = "Stage II, shuffled actions (long-trained)"
    svg = interval_chart([Dot(name, 0.5, 0.4, 0.6), Dot("copy", 0.2, 0.1, 0.3)], title="t", value_label="v")
    found = re.search(rf'<text x="([\d.]+)" y="([\d.]+)" class="row">{re.escape(name)}<', svg)
    assert float(found[1]) + 7.4 * len(name) <= WIDTH  # 7.4 is the mean width of a letter
    circles = [(float(x), float(y)) for x, y in re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)"', svg)]
    assert all(0 < x <= WIDTH - VALUE_WIDTH for x, _ in circles)
    assert circles[0][1] > float(found[2]) + 5  # the dot is below its label


def test_an_axis_over_less_than_half_a_decade_has_even_ticks() -> None:
    assert Axis(0.7, 1.2, 0, 1, log=True).ticks() == [0.7, 0.8, 0.9, 1.0, 1.1, 1.2]
    assert Axis(0.01, 10, 0, 1, log=True).ticks() == pytest.approx([0.01, 0.03, 0.1, 0.3, 1, 3, 10])
