"""The page that says how far a run is, kept true while its nodes run."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from tasks.artifact_task import ArtifactReference
from worldline_core.report.progress import DoneNode, estimate_left, write_finished_page, write_progress_page

REFRESH_SECONDS = 10.0


class RunPage:
    """Writes ``report/latest/index.html`` in a store: after every node and every ten seconds while the run goes on.

    A context: when it is left, the page leads to the finished report, or shows the error that ended the run.
    """

    def __init__(self, artifacts: Path, nodes: Sequence[str], at_once: int = 1) -> None:
        self.artifacts = artifacts
        self.folder = artifacts / "report" / "latest"
        self._at_once = at_once
        self._to_come = list(nodes)
        self._running: dict[str, float] = {}
        self._done: list[DoneNode] = []
        self._report: Path | None = None
        self._began = time.monotonic()
        self._change = threading.RLock()
        self._over = threading.Event()
        self._clock = threading.Thread(target=self._keep_true, name="run page", daemon=True)

    def __enter__(self) -> Self:
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
            write_finished_page(self.folder, self._report)

    def started(self, node: str) -> None:
        """A node has been started."""
        with self._change:
            self._to_come.remove(node)
            self._running[node] = time.monotonic()

    def finished(self, node: str, artifact: ArtifactReference, cached: bool) -> None:
        """A node has ended, or was found finished."""
        with self._change:
            began = self._running.pop(node)
            folder = Path(str(artifact.path))
            self._done.append(DoneNode(node, folder, 0.0 if cached else time.monotonic() - began, cached))
            if artifact.step == "report":
                self._report = folder
        self._write()

    def _keep_true(self) -> None:
        while not self._over.wait(REFRESH_SECONDS):
            if self._done:
                self._write()

    def _write(self, failed: str = "") -> None:
        with self._change:
            now = time.monotonic()
            left = estimate_left(
                self.artifacts, self._done, list(self._running), self._to_come,
                sum(now - began for began in self._running.values()), self._at_once,
            )  # fmt: skip
            write_progress_page(
                self.folder, self._done, list(self._running), self._to_come, now - self._began, left, failed
            )
