"""The page of an unfinished run: done, running, to come. It reloads itself until the finished report takes its place."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from worldline_core.pages.page import duration, number, render
from worldline_core.store.artifact_files import read_json
from worldline_core.store.atomic import write_bytes_atomic

RELOAD_SECONDS = 5
MOST_FACTS = 6
PICTURES = ("previews/*.png", "previews/*.jpg", "media/*.jpg")


@dataclass(frozen=True)
class FinishedStep:
    """A finished step of the plan: its name, its artifact, and the seconds that it took in this run (0 when cached)."""

    name: str
    folder: Path
    seconds: float
    cached: bool = False


def write_progress_page(
    folder: Path,
    done: Sequence[FinishedStep],
    running: Sequence[str],
    to_come: Sequence[str],
    elapsed: float,
    failed: str = "",
) -> Path:
    """Write `folder/index.html` (`artifacts/report/latest`).

    Args:
        elapsed: seconds since the run began.
        failed: the error that ended the run; the page then shows it and no longer reloads.
    """
    page = render(
        "report/progress.html", title="WorldLine: this run", done=[_shown(folder, step) for step in done],
        running=list(running), to_come=list(to_come), elapsed=elapsed, failed=failed,
        reload=0 if failed else RELOAD_SECONDS,
    )  # fmt: skip
    write_bytes_atomic(folder / "index.html", page.encode())
    return folder / "index.html"


def write_finished_page(folder: Path, report: Path) -> Path:
    """Redirect `folder/index.html` to a finished report (a page, because not every file system has links)."""
    target = _address(folder, report / "index.html")
    page = render("report/redirect.html", title="WorldLine: the report", target=target, key=report.name)
    write_bytes_atomic(folder / "index.html", page.encode())
    return folder / "index.html"


def _shown(folder: Path, step: FinishedStep) -> dict[str, Any]:
    pictures = [path for pattern in PICTURES for path in sorted(step.folder.glob(pattern))]
    metrics = read_json(step.folder / "manifest.json").get("metrics") or {}
    numbers = [
        f"{name.replace('_', ' ')} {number(value, 3)}"
        for name, value in metrics.items()
        if isinstance(value, (int, float)) and not isinstance(value, bool)
    ]
    return {
        "name": step.name,
        "time": "found in the store" if step.cached else duration(step.seconds),
        "folder": _address(folder, step.folder),
        "facts": " · ".join(numbers[:MOST_FACTS]),
        "picture": _address(folder, pictures[0]) if pictures else None,
    }


def _address(folder: Path, target: Path) -> str:
    """A relative address that a browser follows from a page in `folder`."""
    return quote(os.path.relpath(target.resolve(), folder.resolve()).replace(os.sep, "/"))
