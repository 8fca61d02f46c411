"""Metrics of a run as JSON lines that a resumed run continues without a seam."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from worldline_core.store.atomic import write_bytes_atomic


class MetricsLog:
    """Appends rows with a ``step``; rows later than the resumed step are dropped, so they are written again once."""

    def __init__(self, path: Path, resume_step: int) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        kept = [line for line in _complete_lines(path) if json.loads(line)["step"] <= resume_step]
        write_bytes_atomic(path, "".join(f"{line}\n" for line in kept).encode())

    def add(self, row: dict[str, Any]) -> None:
        """Append one row."""
        with self.path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(row, allow_nan=False) + "\n")


def _complete_lines(path: Path) -> list[str]:
    if not path.is_file():
        return []
    text = path.read_text(encoding="utf-8")
    # A kill may have cut the last line short.
    return text[: text.rfind("\n") + 1].splitlines()


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """All rows of a log, for the report's loss curves."""
    return [json.loads(line) for line in _complete_lines(path)]
