"""Progress of a loop: a bar on a terminal; elsewhere, and in processes that share a terminal, a line of the log a minute."""

from __future__ import annotations

import logging
import multiprocessing
import sys
import time
from collections.abc import Collection, Iterator
from contextvars import ContextVar
from types import TracebackType
from typing import Self

from tqdm import tqdm

logger = logging.getLogger(__name__)

LINE_SECONDS = 60.0
running_node: ContextVar[str] = ContextVar("running_node", default="")
"""The node of a run that is worked on, where several may be side by side: what is shown begins with it."""


class Progress:
    """Counts what is done of a loop and shows it, with what is left at the present pace.

    Args:
        total: how much there is to do, in `unit`s; `done` of them were finished before.
        shown: False shows nothing, for all but one of the processes that do the same loop.
    """

    def __init__(self, title: str, total: int, unit: str, *, done: int = 0, shown: bool = True) -> None:
        self.title = ": ".join(dict.fromkeys(name for name in (running_node.get(), title) if name))
        self.total, self.unit, self.done, self.clips = total, unit, done, 0
        drawn = shown and sys.stderr.isatty() and multiprocessing.parent_process() is None
        self._writes_lines = shown and not drawn
        self._bar = tqdm(total=total, initial=done, desc=self.title, unit=unit, dynamic_ncols=True, disable=not drawn)
        names = (None, "worldline_core", "tasks", "flows") if drawn else ()
        self._log_handlers = [handler for name in names for handler in logging.getLogger(name).handlers]
        self._since = time.monotonic(), done, 0  # the last line, or the start

    def __enter__(self) -> Self:
        for handler in self._log_handlers:
            handler.addFilter(self._make_room)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.close()
        for handler in self._log_handlers:
            handler.removeFilter(self._make_room)

    def advance(self, count: int = 1, *, clips: int = 0, **facts: float | str) -> None:
        """So many more are done; `clips` of a loop that counts something else; `facts` to show beside them."""
        self.done += count
        self.clips += clips
        shown = [f"{key} {value if isinstance(value, str) else format(value, '.4g')}" for key, value in facts.items()]
        now, (at, done, seen) = time.monotonic(), self._since
        seconds = max(now - at, 1e-9)
        if self.clips:
            shown.append(f"{(self.clips - seen) / seconds:.3g} clips/s")
        if not self._bar.disable:
            self._bar.set_postfix_str(", ".join(shown), refresh=False)
            self._bar.update(count)
        elif self._writes_lines and seconds >= LINE_SECONDS:
            # At the pace since the last line: what was there already, and passed at once, says nothing of what is left.
            pace = (self.done - done) / seconds
            left = f"{tqdm.format_interval((self.total - self.done) / pace)} left" if pace else "no estimate"
            rate = [] if self.clips else [f"{pace:.3g} {self.unit}s/s"]
            logger.info(
                "%s: %s", self.title, ", ".join([f"{self.done} of {self.total} {self.unit}s", *shown, *rate, left])
            )
            self._since = now, self.done, self.clips

    def _make_room(self, _record: logging.LogRecord) -> bool:
        """Take the bar away where a message is written; the next step draws it again."""
        self._bar.clear()
        return True


def with_progress[T](items: Collection[T], title: str, unit: str) -> Iterator[T]:
    """The items one by one, with the progress shown."""
    with Progress(title, len(items), unit) as progress:
        for item in items:
            yield item
            progress.advance()
