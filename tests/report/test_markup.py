"""HTML is escaped, well-formed, and charts carry their data."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import pytest

from worldline_core.report.charts import (
    CHARACTER,
    Axis,
    Dot,
    Series,
    funnel_chart,
    interval_chart,
    line_chart,
    nice_ticks,
)
from worldline_core.report.markdown import markdown
from worldline_core.report.markup import Column, Html, element, interval, join, number, table
from worldline_core.report.sections.training import error_chart


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
    html = element("p", hostile_text, title='"><img src=x onerror=alert(1)>')
    assert tags(html) == ["p"]
    assert "&lt;script&gt;" in html


def test_html_made_here_is_not_escaped_twice() -> None:
    assert element("p", join("a < b, ", element("b", "x & y"))) == "<p>a &lt; b, <b>x &amp; y</b></p>"


def test_attributes_without_a_value_are_left_out() -> None:
    assert element("video", muted=True, loop=False, poster=None, data_x=3) == '<video muted data-x="3"></video>'


def test_table_refuses_rows_of_a_wrong_length() -> None:
    with pytest.raises(ValueError, match="argument 2 is shorter"):
        table([Column("a"), Column("b")], [["only one"]])


def test_numbers_are_written_for_readers() -> None:
    assert number(1234567) == "1\u202f234\u202f567"
    assert number(-0.126) == "\u22120.13"
    assert "[0.40, 0.60]" in interval(0.5, 0.4, 0.6)
    assert interval(0.5, None, None, signed=True) == '<span class="value">+0.50</span>'


def test_markdown_reads_what_cards_use(hostile_text: str) -> None:
    html = markdown(
        f"# Title\n\nText with `code` and **bold**.\n\n- one\n- two\n  more\n\n| a | b |\n|---|---|\n| 1 | {hostile_text} |\n\n```\nx < y\n```"
    )
    assert [tag for tag in tags(html) if tag not in ("div", "thead", "tbody", "tr", "th", "td")] == [
        "h4", "p", "code", "strong", "ul", "li", "li", "table", "pre",
    ]  # fmt: skip
    assert "two more" in html
    assert "x &lt; y" in html


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
    intervals = interval_chart([Dot("a", 0.1, -0.2, 0.3), Dot("b", 0.4)], title="t", value_label="v", zero_line=True)
    dots = ElementTree.fromstring(intervals)  # noqa: S314
    assert (len(dots.findall(".//circle")), len(dots.findall(".//line[@class='whisker']"))) == (2, 1)
    funnel = ElementTree.fromstring(funnel_chart([("found", 10), ("kept", 5)], title="t"))  # noqa: S314
    first, second = (float(bar.attrib["width"]) for bar in funnel.findall(".//rect"))
    assert second == pytest.approx(first / 2, abs=0.01)


def test_html_marks_only_what_was_built() -> None:
    assert isinstance(element("p"), Html)
    assert not isinstance("<p></p>", Html)


def test_row_labels_of_an_interval_chart_stay_inside_the_picture() -> None:
    name = "Stage II, shuffled actions (long-trained)"
    svg = interval_chart([Dot(name, 0.5, 0.4, 0.6), Dot("copy", 0.2)], title="t", value_label="v")
    found = re.search(rf'<text x="([\d.]+)"[^>]*class="row end">{re.escape(name)}<', svg)
    assert found is not None
    right = float(found.group(1))
    assert right - CHARACTER * len(name) >= 0
    dots = [float(x) for x in re.findall(r'<circle cx="([\d.]+)"', svg)]
    assert min(dots) > right


def test_an_axis_over_less_than_half_a_decade_has_even_ticks() -> None:
    assert Axis(0.7, 1.2, 0, 1, log=True).ticks() == [0.7, 0.8, 0.9, 1.0, 1.1, 1.2]
    assert Axis(0.01, 10, 0, 1, log=True).ticks() == pytest.approx([0.01, 0.03, 0.1, 0.3, 1, 3, 10])


def test_a_held_out_error_that_was_measured_once_is_a_row_of_dots() -> None:
    once = {"validation/rollout_error": ([9.0], [0.25]), "validation/rollout_error_copy": ([9.0], [0.5])}
    shown = error_chart("Distillation", "error", "validation/rollout_error", once)
    assert shown.count("<circle") == 2
    assert "held-out scenes" in shown
    assert "0.500" in shown
    often = {name: ([3.0, *steps], [0.7, *values]) for name, (steps, values) in once.items()}
    assert error_chart("Distillation", "error", "validation/rollout_error", often).count("<polyline") == 2
    assert error_chart("Distillation", "error", "validation/sample_error", once) == ""
