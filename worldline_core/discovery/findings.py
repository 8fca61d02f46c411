"""Findings about a folder of recordings with their evidence, and open questions."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from worldline_core.untrusted_text import cut, visible

Place = tuple[str, ...]
"""Keys that lead to a value within the source: ("arms", "right", "state", "gripper")."""


@dataclass(frozen=True)
class Question:
    """A value that cannot be known from the files: it becomes a TODO line, to which its place refers."""

    name: str
    text: str


@dataclass
class Discovery:
    """A folder of recordings, as it was understood.

    Attributes:
        about: one line: layout, robot, number of episodes, rate.
        source: an entry of `curate.sources`; questions stand for what is unknown.
        evidence: place within the source -> a sentence with the numbers that led to it.
        views: those that a model is to see, head first.
        fps: of the recordings.
        state_size: columns of the state; None of videos without states.
        episodes: those that can be read, where that is known without reading them; `frames`: of half of them, or more.
        cameras: how many of these views have one.
        trains: False of recordings that are for evaluation only.
        notes: what the user should know, and no value says.
    """

    kind: str
    about: str
    source: dict[str, Any]
    evidence: dict[Place, str] = field(default_factory=dict)
    views: list[str] = field(default_factory=list)
    fps: float | None = None
    state_size: int | None = None
    episodes: int | None = None
    frames: int | None = None
    cameras: Literal["all", "some", "none"] = "none"
    trains: bool = True
    notes: list[str] = field(default_factory=list)

    def say(self, place: Place, value: Any, evidence: str) -> None:
        """Set a value of the source, with its evidence."""
        inner = self.source
        for key in place[:-1]:
            inner = inner.setdefault(key, {})
        inner[place[-1]] = value
        self.evidence[place] = evidence

    def count_cameras(self, *known: Container[str]) -> None:
        """Set ``cameras`` from the views with a camera, of each episode looked at."""
        have = [view in each for each in known for view in self.views]
        self.cameras = "all" if have and all(have) else "some" if any(have) else "none"

    @property
    def questions(self) -> list[Question]:
        """Everything that has to be asked, once."""
        return list(dict.fromkeys(_questions(self.source)))


def _questions(value: Any) -> list[Question]:
    if isinstance(value, Question):
        return [value]
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else ()
    return [each for part in parts for each in _questions(part)]


def named(texts: Sequence[object], most: int = 8) -> str:
    """A list of texts of others within a sentence."""
    shown = [cut(visible(str(text)).replace("\n", " "), 60) for text in texts[:most]]
    return ", ".join(shown) + (f" and {len(texts) - most} more" if len(texts) > most else "")
