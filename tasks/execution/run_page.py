"""The page of a run: `report/latest/index.html` in the store, from the first finished step to the report.

It reloads itself until the finished report takes its place.
"""

from __future__ import annotations

import errno
import logging
import os
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import quote

from tasks.execution.artifact_task import TaskCall
from worldline_core.pages.page import duration, number, render
from worldline_core.store.artifact_files import read_json
from worldline_core.store.atomic import write_bytes_atomic
from worldline_core.store.store import disk_full

logger = logging.getLogger(__name__)

REFRESH_SECONDS = 10.0
LATEST_REPORT = Path("report", "latest")
"""The page's folder in the store."""
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


class RunPage:
    """Shows what is done, running and to come; written after every step and every ten seconds.

    A context: when it is left, the page leads to the finished report, or shows the error that ended the run.
    ``at_once`` calls run side by side.
    """

    def __init__(self, artifacts: Path, calls: Mapping[str, TaskCall], at_once: int = 1) -> None:
        self.folder = artifacts / LATEST_REPORT
        self._calls = calls
        self._at_once = at_once
        self._running: dict[str, float] = {}
        self._done: dict[str, FinishedStep] = {}
        self._report: Path | None = None
        self._writable = True
        self._began = time.monotonic()
        self._change = threading.RLock()
        self._over = threading.Event()
        self._clock = threading.Thread(target=self._refresh, name="run page", daemon=True)

    def __enter__(self) -> Self:
        self._start_ready()
        self._clock.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._clock.join()
        if error is not None:
            self._write(failed=str(error) or type(error).__name__)
        elif self._report is not None:
            with self._unless_unwritable():
                write_finished_page(self.folder, self._report)

    def finished(self, call: TaskCall, folder: Path, *, cached: bool) -> None:
        with self._change:
            began = self._running.pop(call.name, time.monotonic())
            seconds = 0.0 if cached else time.monotonic() - began
            self._done[call.name] = FinishedStep(call.name, folder, seconds, cached)
            if call.task.name == "report":
                self._report = folder
            self._start_ready()
            self._write()

    def _start_ready(self) -> None:
        """Workers take calls in the order in which their inputs become ready."""
        for name, call in self._calls.items():
            ready = all(source.name in self._done for source in call.upstream)
            if ready and name not in self._done and len(self._running) < self._at_once:
                self._running.setdefault(name, time.monotonic())

    def _refresh(self) -> None:
        while not self._over.wait(REFRESH_SECONDS):
            if self._done:
                self._write()

    def _write(self, failed: str = "") -> None:
        with self._change, self._unless_unwritable():
            to_come = [name for name in self._calls if name not in self._done and name not in self._running]
            elapsed = time.monotonic() - self._began
            write_progress_page(self.folder, list(self._done.values()), list(self._running), to_come, elapsed, failed)

    @contextmanager
    def _unless_unwritable(self) -> Iterator[None]:
        """A run that finds everything in a store that it may not write has no page; on a full disk its own error counts."""
        try:
            yield
        except OSError as error:
            if error.errno not in (errno.EROFS, errno.EACCES, errno.EPERM) and not disk_full(error):
                raise
            if self._writable:
                logger.warning("no page of this run: %s", error)
            self._writable = False


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
