"""Templates escape what they show, charts carry their data, colours can be read."""

from __future__ import annotations

import math
import re
from xml.etree import ElementTree

import jinja2
import numpy as np
import pytest

from worldline_core.pages import page


def test_every_template_escapes() -> None:
    names = page.environment().list_templates(extensions=["html", "md"])
    assert {"pages/base.html", "report/overview.html", "report/card.md"} <= set(names)
    sources = {name: page.environment().loader.get_source(page.environment(), name)[0] for name in names}  # type: ignore[union-attr]
    assert not [n for n, text in sources.items() if n.endswith(".html") and re.search(r"\|\s*safe|autoescape", text)]


def test_a_name_that_the_template_does_not_know_is_an_error() -> None:
    with pytest.raises(jinja2.UndefinedError, match="'target' is undefined"):
        page.render("report/redirect.html", title="t")


def test_numbers_are_written_for_readers() -> None:
    assert (page.number(1234567), page.number(-0.126), page.percent(-0.2)) == (
        "1\u202f234\u202f567", "\u22120.13", "\u221220\u202f%",
    )  # fmt: skip
    assert "[0.40, 0.60]" in str(page.interval({"mean": 0.5, "low": 0.4, "high": 0.6}))
    assert "+0.50" in str(page.interval({"mean": 0.5, "low": 0.4, "high": 0.6}, signed=True))
    assert page.interval(None) is None
    assert [page.duration(s) for s in (3.21, 61, 150, 8000)] == ["3.2 s", "61 s", "2.5 min", "2.2 h"]


def test_text_and_lines_can_be_read_in_both_themes() -> None:
    style = page.asset("pages/style.css")
    found = re.findall(r"--([\w-]+): light-dark\(#(\w{6}), #(\w{6})\)", style)
    luminance = {}  # of WCAG 2
    for name, *themes in found:
        parts = [[int(colour[i : i + 2], 16) / 255 for i in (0, 2, 4)] for colour in themes]
        linear = [[c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in rgb] for rgb in parts]
        luminance[name] = np.array(linear) @ (0.2126, 0.7152, 0.0722) + 0.05
    texts = {"ink", "soft", "faint", "accent", "good", "bad"}
    needed = {(text, ground): 4.5 for text in texts for ground in ("paper", "card", "stripe", "notice")}
    for (text, ground), least in (needed | {(f"c{i}", "card"): 3.0 for i in range(8)}).items():
        ratio = luminance[text] / luminance[ground]
        assert np.maximum(ratio, 1 / ratio).min() >= least, (text, ground)
    used = set(re.findall(r"(?<![-\w])(?:color|fill): var\(--([\w-]+)\)", style))
    assert used <= texts | {"paper", "c"}  # paper stands on ink, c is no text


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-3.2, 17.0), (0.0021, 0.0026), (12.0, 90000.0)])
def test_ticks_are_round_and_inside(low: float, high: float) -> None:
    ticks = page.nice_ticks(low, high)
    assert 2 <= len(ticks) <= 12
    assert all(low - 1e-9 <= tick <= high + 1e-9 for tick in ticks)


def test_charts_are_xml_and_hold_every_point(hostile_text: str) -> None:
    series = page.Line(hostile_text, [1, 2, 3], [0.5, 0.25, math.nan], markers=True)
    chart = page.line_chart([series], title=hostile_text, x_label="step", y_label="loss", log_y=True)
    root = ElementTree.fromstring(chart)  # noqa: S314  # made two lines above
    assert len(root.findall(".//circle")) == 2  # the value that is not a number is left out


def test_axes_map_both_ends_and_have_even_ticks() -> None:
    assert (page.Axis(2, 32, 0, 100, log=True).at(8), page.Axis(0, 4, 100, 0).at(1)) == (50.0, 75.0)
    assert page.Axis(0.7, 1.2, 0, 1, log=True).ticks() == [0.7, 0.8, 0.9, 1.0, 1.1, 1.2]
    assert page.Axis(0.01, 10, 0, 1, log=True).ticks() == pytest.approx([0.01, 0.03, 0.1, 0.3, 1, 3, 10])
