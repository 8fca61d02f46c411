"""Prefect's pool of processes of this machine: the step with the longest way to the end of the run goes first."""

from __future__ import annotations

import contextlib
import heapq
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from contextvars import ContextVar, copy_context
from functools import partial
from itertools import count
from typing import Any, Self

_MOST_WAITING = 4096
_SUCCESSOR_SECONDS = 0.5
"""Within this time what waited for finished work is submitted."""


class RankedPool:
    """Gives an executor no more work than it has workers: of what waits, the highest rank goes first, then the oldest.

    The worker of finished work waits a moment for a successor, whose rank is lower by one at most, where it would go first.

    Args:
        rank: of the work that is submitted, asked in the thread that submits it.
    """

    def __init__(self, executor: Executor, workers: int, rank: Callable[[], int]) -> None:
        self._executor, self._free, self._rank = executor, workers, rank
        self._waiting: list[tuple[int, int, Callable[[], Any], Future[Any]]] = []
        self._numbers, self._lock = count(), threading.Lock()
        self._kept_for, self._kept_until = 0, 0.0
        # An executor that breaks ends its futures with its lock held: nothing may be submitted from their callbacks.
        self._starter = ThreadPoolExecutor(1)

    def submit(self, work: Callable[[], Any]) -> Future[Any]:
        """The future of the work's result; it can be cancelled as long as the work waits."""
        future: Future[Any] = Future()
        with self._lock:
            heapq.heappush(self._waiting, (-self._rank(), next(self._numbers), work, future))
        self._starter.submit(self._start)
        return future

    def shutdown(self, *, wait: bool, cancel_futures: bool) -> None:
        """Cancel what waits, and end the executor as it ends."""
        with self._lock:
            waiting, self._waiting = self._waiting, []
        for *_, future in waiting:
            future.cancel()
        self._executor.shutdown(wait=wait, cancel_futures=cancel_futures)
        self._starter.shutdown(wait=wait)

    def _start(self) -> None:
        while (found := self._next()) is not None:
            work, future, rank = found
            if not future.set_running_or_notify_cancel():
                self._release()
                continue
            try:
                self._executor.submit(work).add_done_callback(partial(self._end, future, rank))
            except RuntimeError as error:  # it is broken, or shut down
                self._release()
                future.set_exception(error)

    def _next(self) -> tuple[Callable[[], Any], Future[Any], int] | None:
        with self._lock:
            if not self._free or not self._waiting or self._is_kept():
                return None
            self._free -= 1
            below, _, work, future = heapq.heappop(self._waiting)
            return work, future, -below

    def _is_kept(self) -> bool:
        """Returns whether a worker is kept for work that goes before all that waits."""
        return time.monotonic() < self._kept_until and -self._waiting[0][0] < self._kept_for

    def _keep(self, rank: int) -> None:
        """Keep workers for a moment for work of this rank."""
        with self._lock:
            kept = self._kept_for if time.monotonic() < self._kept_until else 0
            self._kept_for, self._kept_until = max(kept, rank), time.monotonic() + _SUCCESSOR_SECONDS
        later = threading.Timer(_SUCCESSOR_SECONDS, self._start_later)
        later.daemon = True
        later.start()

    def _start_later(self) -> None:
        with contextlib.suppress(RuntimeError):  # it has been shut down
            self._starter.submit(self._start)

    def _release(self) -> None:
        with self._lock:
            self._free += 1

    def _end(self, future: Future[Any], rank: int, done: Future[Any]) -> None:
        if rank > 1:
            self._keep(rank - 1)
        self._release()
        self._start_later()
        error = CancelledError() if done.cancelled() else done.exception()
        if error is None:
            future.set_result(done.result())
        else:
            future.set_exception(error)


def process_runner(workers: int, ranks: Mapping[str, int] | None = None) -> Any:
    """A task runner of this many processes.

    Args:
        ranks: of tasks by the names of their runs; of those that are ready, the highest goes first.
    """
    from prefect import Task
    from prefect.task_runners import ProcessPoolTaskRunner

    rank: ContextVar[int] = ContextVar("rank", default=0)

    class ProcessRunner(ProcessPoolTaskRunner):
        """Does not wait for its queue of messages: a worker that was killed while it wrote there never releases the lock,
        and this process would then never end. Its thread sends them with the settings of the run: without, it would know
        neither address nor password of a temporary server.

        Each task waits for its inputs in its own thread. Prefect uses only as many threads as workers, so that waiting tasks
        block others that are ready."""

        def __enter__(self) -> Self:
            self._context = copy_context()
            entered = super().__enter__()
            if self._resolver_executor is not None:
                self._resolver_executor.shutdown()
            self._resolver_executor = ThreadPoolExecutor(_MOST_WAITING)
            self._executor: Any = RankedPool(self._executor, workers, rank.get)
            return entered

        def _resolve_futures_and_submit(  # pyright: ignore[reportIncompatibleMethodOverride]
            self, task: Task[..., Any], **values: Any
        ) -> Future[bytes]:
            rank.set((ranks or {}).get(str(task.task_run_name), 0))  # for this thread
            return super()._resolve_futures_and_submit(task, **values)

        def _forward_subprocess_messages(self) -> None:
            self._context.run(super()._forward_subprocess_messages)

        def _stop_message_forwarding(self) -> None:
            if self._subprocess_message_queue is not None:
                self._subprocess_message_queue.cancel_join_thread()
            super()._stop_message_forwarding()

    return ProcessRunner(max_workers=workers)
