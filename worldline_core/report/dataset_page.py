"""A page to browse the episodes of a set: each with its facts and a video of its controls drawn over all views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.report.markup import Child, Html, element, join, notice
from worldline_core.report.page import asset

FILTER_SCRIPT = """
const box = document.getElementById("filter"), shown = document.getElementById("shown");
const cards = [...document.querySelectorAll("[data-text]")];
function filter() {
  const words = box.value.toLowerCase().split(/\\s+/).filter(Boolean);
  let count = 0;
  for (const card of cards) {
    card.hidden = !words.every(word => card.dataset.text.includes(word));
    count += !card.hidden;
    if (card.hidden) card.querySelector("video")?.pause();
  }
  shown.textContent = `${count} of ${cards.length}`;
}
box.addEventListener("input", filter);
filter();
"""
EXTRA_STYLE = """
#filter { font: inherit; width: min(100%, 34em); padding: 7px 12px; border: 1px solid var(--rule); border-radius: 8px;
  background: var(--card); color: var(--ink); }
.episode { margin: 0 0 34px; } .episode h3 { margin: 0 0 4px; } .episode video { max-width: 100%; border-radius: 8px; display: block; }
.facts { color: var(--soft); font-size: 14px; margin: 0 0 8px; max-width: none; }
"""


@dataclass(frozen=True)
class EpisodeCard:
    """One episode on the page.

    Attributes:
        video: path relative to the page; None where there is none, with `problem` saying why.
    """

    row: EpisodeRow
    video: str | None
    problem: str = ""


def dataset_page(title: str, subtitle: str, cards: Sequence[EpisodeCard]) -> str:
    """The whole document; its videos lie beside it, nothing comes from a network."""
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("title", title),
        element("style", Html(asset("style.css") + EXTRA_STYLE)),
    )
    box = element("input", id="filter", type="search", placeholder="robot, task, split, outcome …", aria_label="Filter")
    body = element(
        "body",
        element(
            "main",
            element("header", element("h1", title), element("p", subtitle, class_="subtitle")),
            element(
                "div", element("p", box, " ", element("span", id="shown", class_="muted")), [_card(c) for c in cards]
            ),
        ),
        element("footer", "Made by ", element("code", "worldline inspect --page"), "."),
        element("script", Html(FILTER_SCRIPT)),
    )
    return "<!doctype html>\n" + str(element("html", head, body, lang="en")) + "\n"


def _card(card: EpisodeCard) -> Html:
    row = card.row
    tone = {"success": "good", "failure": "bad"}.get(row.outcome, "")
    facts = [row.embodiment, row.task_family, row.scene, row.split.replace("_", " "), row.source]
    facts += [f"{row.num_frames} frames, {row.fps:g} Hz"]
    shown: Child
    if card.video is None:
        shown = notice(card.problem)
    else:
        shown = element(
            "video", src=card.video, controls=True, loop=True, muted=True, playsinline=True, preload="metadata"
        )
    return element(
        "div",
        join(
            element(
                "h3", row.instruction or row.episode_id, " ", element("span", row.outcome, class_=f"tag {tone}".strip())
            ),
            element("p", " · ".join([row.episode_id, *facts]), class_="facts"),
            shown,
        ),
        class_="episode",
        data_text=" ".join([row.episode_id, row.instruction, row.outcome, *facts]).lower(),
    )
