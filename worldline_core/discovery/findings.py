"""Findings about a folder of recordings with their evidence, open questions, and the stated licence; as text and as JSON."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Container, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from worldline_core.config import QUESTIONS
from worldline_core.data.guards.source_paths import AnyPath, is_file, regular_file
from worldline_core.data.sources.calibration_file import read_calibration
from worldline_core.untrusted_text import cut, printable, shown, visible

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
        cameras: how many of these views have one; `head_camera`: the head has.
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
    head_camera: bool = False
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
        """Set ``cameras`` and ``head_camera`` from the views with a camera, of each episode looked at."""
        have = [view in each for each in known for view in self.views]
        self.cameras = "all" if have and all(have) else "some" if any(have) else "none"
        self.head_camera = all("head" in each for each in known)

    @property
    def questions(self) -> list[Question]:
        """Everything that has to be asked, once."""
        return list(dict.fromkeys(_questions(self.source)))


_CALIBRATIONS = (
    *(f"meta/calibration.{suffix}" for suffix in ("yaml", "yml", "json")),
    *("calibration.yaml", "calibration.json", "cameras.json"),
)


def name_calibration(found: Discovery, root: AnyPath) -> None:
    """Names the calibration file of a source's folder, if there is one. Raises: RejectedInputError: it cannot be read."""
    for name in _CALIBRATIONS:
        if (root / name).exists():
            known = list(read_calibration(root, name))
            found.say(("calibration",), name, f"cameras of {named(known)}")
            found.count_cameras(known)
            return


def _questions(value: Any) -> list[Question]:
    if isinstance(value, Question):
        return [value]
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else ()
    return [each for part in parts for each in _questions(part)]


def named(texts: Sequence[object], most: int = 8) -> str:
    """A list of texts of others within a sentence."""
    shown = [cut(visible(str(text)).replace("\n", " "), 60) for text in texts[:most]]
    return ", ".join(shown) + (f" and {len(texts) - most} more" if len(texts) > most else "")


_WIDTH = 110


def as_json(found: Discovery, written: Path, commands: Sequence[str]) -> dict[str, Any]:
    """Everything that was found, what is to be filled in, the file and what to run next."""
    return {
        "kind": found.kind,
        "about": found.about,
        "file": str(written),
        "source": _plain(found.source),
        "views": found.views,
        "fps": found.fps,
        "state_size": found.state_size,
        "cameras": found.cameras,
        "trains": found.trains,
        "evidence": [{"key": list(place), "sentence": text} for place, text in found.evidence.items()],
        "todo": {each.name: each.text for each in found.questions},
        "notes": found.notes,
        "next": list(commands),
    }


def _plain(value: Any) -> Any:
    if isinstance(value, Question):
        return f"{QUESTIONS}.{value.name}"
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, list | tuple) else value


def as_text(found: Discovery, written: Path, commands: Sequence[str]) -> str:
    """The same for a terminal."""
    lines = [shown(found.about)]
    for place, text in found.evidence.items():
        lines += _wrapped(f"{'.'.join(place)}: {shown(text)}", "  ")
    for note in found.notes:
        lines += _wrapped(f"note: {shown(note)}", "")
    lines.append(f"written: {written}")
    if found.questions:
        lines.append(f"to be filled in there, under `{QUESTIONS}`:")
        for each in found.questions:
            lines += _wrapped(f"{each.name}: {shown(each.text)}", "  ")
    return "\n".join([*lines, *(f"next: {command}" for command in commands)])


def _wrapped(text: str, indent: str) -> list[str]:
    return textwrap.wrap(
        " ".join(text.split()), _WIDTH, initial_indent=indent, subsequent_indent=f"{indent}    ", break_on_hyphens=False
    )


_SPDX = {
    "apache-2.0": "Apache-2.0", "mit": "MIT", "bsd-3-clause": "BSD-3-Clause", "cc0-1.0": "CC0-1.0", "cc-by-4.0": "CC-BY-4.0",
    "cc-by-sa-4.0": "CC-BY-SA-4.0", "cc-by-nc-4.0": "CC-BY-NC-4.0", "cc-by-nc-sa-4.0": "CC-BY-NC-SA-4.0",
}  # fmt: skip
_TEXTS = {
    "apache license": "Apache-2.0", "mit license": "MIT", "attribution-noncommercial-sharealike 4.0": "CC-BY-NC-SA-4.0",
    "attribution-noncommercial 4.0": "CC-BY-NC-4.0", "attribution-sharealike 4.0": "CC-BY-SA-4.0",
    "attribution 4.0": "CC-BY-4.0", "cc0 1.0": "CC0-1.0",
}  # fmt: skip
_IN_CARD = re.compile(r"^licen[cs]e:[ \t]*[\"']?([\w.+-]{2,40})[\"']?[ \t]*$", re.MULTILINE)
_MOST_BYTES = 1 << 16


def stated_licence(root: AnyPath) -> tuple[str, str] | None:
    """(identifier, evidence) by the head of the dataset's card, or by the text of its licence file; None where nothing says."""
    for name in ("README.md", "LICENSE", "LICENSE.md", "LICENSE.txt", "LICENCE"):
        if not is_file(root / name):
            continue
        with regular_file(root / name).open("rb") as file:
            text = file.read(_MOST_BYTES).decode("utf-8", errors="replace")
        if name == "README.md":
            head = text.split("---", 2)[1] if text.startswith("---") and text.count("---") > 1 else ""
            if (found := _IN_CARD.search(head)) is not None:
                said = found[1]
                return _SPDX.get(said.lower(), cut(printable(visible(said)), 40)), "README.md says so"
            continue
        first = " ".join(text[:400].lower().split())
        if (known := next((spdx for words, spdx in _TEXTS.items() if words in first), None)) is not None:
            return known, f"by the text of {name}"
    return None
