"""Findings as text for people and as JSON for scripts."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from worldline_core.config import QUESTIONS
from worldline_core.discovery.findings import Discovery, Question
from worldline_core.untrusted_text import shown

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
