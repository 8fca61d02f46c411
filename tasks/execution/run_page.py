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
        self._done: dict[str, dict[str, Any]] = {}
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
            seconds = time.monotonic() - self._running.pop(call.name, time.monotonic())
            self._done[call.name] = finished_step(self.folder, call.name, folder, None if cached else seconds)
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
    done: Sequence[Mapping[str, Any]],
    running: Sequence[str],
    to_come: Sequence[str],
    elapsed: float,
    failed: str = "",
) -> Path:
    """Write `folder/index.html` (`artifacts/report/latest`).

    Args:
        done: steps as `finished_step` describes them.
        elapsed: seconds since the run began.
        failed: the error that ended the run; the page then shows it and no longer reloads.
    """
    page = render(
        "report/progress.html", title="WorldLine: this run", done=done,
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


def finished_step(folder: Path, name: str, artifact: Path, seconds: float | None) -> dict[str, Any]:
    """Describe a finished step for the page in ``folder``; ``seconds`` is None for a step that was cached."""
    pictures = [path for pattern in PICTURES for path in sorted(artifact.glob(pattern))]
    metrics = read_json(artifact / "manifest.json").get("metrics") or {}
    numbers = [
        f"{metric.replace('_', ' ')} {number(value, 3)}"
        for metric, value in metrics.items()
        if isinstance(value, (int, float)) and not isinstance(value, bool)
    ]
    return {
        "name": name,
        "time": "found in the store" if seconds is None else duration(seconds),
        "folder": _address(folder, artifact),
        "facts": " · ".join(numbers[:MOST_FACTS]),
        "picture": _address(folder, pictures[0]) if pictures else None,
    }


def _address(folder: Path, target: Path) -> str:
    """A relative address that a browser follows from a page in `folder`."""
    return quote(os.path.relpath(target.resolve(), folder.resolve()).replace(os.sep, "/"))
