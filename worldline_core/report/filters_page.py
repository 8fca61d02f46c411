"""A page that shows what the filters kept and dropped: a sheet of clips for every reason."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from worldline_core.filters.verdict import REASONS
from worldline_core.pictures.clip_strip import KEPT_COLOUR, reason_colour
from worldline_core.report.markup import Html, element, join, notice
from worldline_core.report.page import asset

EXTRA_STYLE = """
.reason { margin: 0 0 44px; } .reason h2 { margin: 0 0 2px; } .reason img { max-width: 100%; border-radius: 8px; display: block; }
.swatch { display: inline-block; width: .8em; height: .8em; border-radius: 3px; margin-right: .45em; }
.facts { color: var(--soft); margin: 0 0 10px; max-width: none; } .contents { list-style: none; padding: 0; display: flex; flex-wrap: wrap; gap: 6px 22px; }
"""


@dataclass(frozen=True)
class ReasonGroup:
    """Episodes under one heading.

    Attributes:
        whole, partly, stage2: episodes dropped whole, that lost frames, and that are kept for Stage I only.
        picture: path relative to the page; None where no clip could be shown.
    """

    reason: str
    whole: int
    partly: int
    stage2: int
    picture: str | None
    size: tuple[int, int] = (0, 0)


def filters_page(title: str, subtitle: str, groups: Sequence[ReasonGroup], kept: ReasonGroup) -> str:
    """The whole document; its pictures lie beside it, nothing comes from a network."""
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("title", title),
        element("style", Html(asset("style.css") + EXTRA_STYLE)),
    )
    links = [
        element(
            "li", element("a", _swatch(g.reason), g.reason, href=f"#{g.reason}"), f" {g.whole + g.partly + g.stage2}"
        )
        for g in groups
    ]
    links.append(element("li", element("a", _swatch("kept"), "kept whole", href="#kept"), f" {kept.whole}"))
    body = element(
        "body",
        element(
            "main",
            element("header", element("h1", title), element("p", subtitle, class_="subtitle")),
            element("ul", links, class_="contents"),
            [_group(group) for group in groups],
            _group(kept),
        ),
        element("footer", "Made by ", element("code", "worldline inspect"), "."),
    )
    return "<!doctype html>\n" + str(element("html", head, body, lang="en")) + "\n"


def _swatch(reason: str) -> Html:
    colour = KEPT_COLOUR if reason == "kept" else reason_colour(reason)
    return element("span", class_="swatch", style=f"background: rgb{colour}")


def _group(group: ReasonGroup) -> Html:
    if group.reason == "kept":
        name, text = "kept whole", "No detector found anything."
        counts = [f"{group.whole} episodes"]
    else:
        name, text = group.reason, REASONS.get(group.reason, "")
        counts = [
            f"{count} {words}"
            for count, words in (
                (group.whole, "dropped whole"),
                (group.partly, "lost frames"),
                (group.stage2, "kept for Stage I only"),
            )
            if count
        ]
    width, height = group.size
    shown = (
        notice("None of these can be shown: their images cannot be read.")
        if group.picture is None
        else element(
            "img",
            src=group.picture,
            alt=f"Clips: {name}",
            width=width,
            height=height,
            style="height: auto",
            loading="lazy",
        )
    )
    return element(
        "section",
        join(
            element("h2", _swatch(group.reason), name),
            element("p", join(text, " ", element("b", ", ".join(counts)), "."), class_="facts"),
            shown,
        ),
        class_="reason",
        id=group.reason,
    )
