"""Headline numbers: a figure, what it is, and how it was measured."""

from __future__ import annotations

from dataclasses import dataclass

from worldline_core.report.markup import Child, Html, element, number


@dataclass(frozen=True)
class Tile:
    """One headline number; `mood` is "good", "bad" or neither."""

    figure: Child
    what: Child
    how: Child = None
    mood: str = ""


def render_tile(tile: Tile) -> Html:
    """One tile."""
    return element(
        "div",
        element("div", tile.figure, class_="figure"),
        element("div", tile.what, class_="what"),
        element("div", tile.how, class_="how") if tile.how is not None else None,
        class_=f"tile {tile.mood}".strip(),
    )


def bounds(low: float, high: float, digits: int = 2, *, signed: bool = False) -> str:
    """An interval in words that fit a tile."""
    shown = [("+" if signed and v > 0 else "") + number(float(v), digits) for v in (low, high)]
    return f"95\u202f% interval {shown[0]} to {shown[1]}"
