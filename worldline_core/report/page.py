"""The page around the sections: head, navigation, styles and the little script."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib.resources import files

from worldline_core.report.context import Section
from worldline_core.report.markup import Child, Html, element, join, notice

NAVIGATION = {"summary": "In short", "videos": "Videos", "video": "Quality", "policy": "Policy", "actions": "Actions"}
"""Short titles for the navigation."""
POLICY = "default-src 'none'; img-src 'self' data: file:; media-src 'self' file:; style-src 'unsafe-inline'; script-src 'unsafe-inline' 'self' file:"


def asset(name: str) -> str:
    """The text of a file beside this module."""
    return files("worldline_core.pages").joinpath(name).read_text(encoding="utf-8")


def render_page(title: str, subtitle: Child, hero: Child, sections: Sequence[Section]) -> str:
    """The whole document. Everything it loads lies beside it; nothing comes from a network."""
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("meta", http_equiv="Content-Security-Policy", content=POLICY),
        element("title", title),
        element("style", Html(asset("style.css"))),
    )
    links = [
        element("a", NAVIGATION.get(s.anchor, s.title), href=f"#{s.anchor}", class_="absent" if s.missing else None)
        for s in sections
    ]
    button = element("button", "Theme", type="button", id="theme", title="Light or dark")
    nav = element(
        "nav",
        element(
            "div",
            element("a", "WorldLine", href="#top", class_="brand"),
            element("div", links, class_="links"),
            button,
            class_="bar",
        ),
    )
    header = element("header", element("h1", title), element("p", subtitle, class_="subtitle"), hero, id="top")
    body = element(
        "body",
        nav,
        element("main", header, [render_section(s) for s in sections]),
        element(
            "footer",
            "Made by ",
            element("code", "worldline report"),
            ". The page and its media are self-contained and can be moved or copied.",
        ),
        element("script", Html(""), src="run/run.js"),
        element("script", Html(asset("page.js"))),
    )
    return "<!doctype html>\n" + str(element("html", head, body, lang="en")) + "\n"


def render_section(section: Section) -> Html:
    """One section; a missing one says so."""
    content = (
        notice(element("strong", "Missing: "), section.missing)
        if section.missing
        else join(element("p", section.lead, class_="lead") if section.lead else None, section.body)
    )
    return element("section", element("h2", section.title), content, id=section.anchor)


def run_script(parts: Mapping[str, Html]) -> str:
    """`run/run.js`: what is not reproducible, as HTML by slot name."""
    # `</` would end a script element if this text were ever inlined.
    content = json.dumps({name: str(part) for name, part in sorted(parts.items())}, indent=1).replace("</", "<\\/")
    return f"window.WORLDLINE_RUN = {content};\n"
