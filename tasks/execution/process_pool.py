"""Prefect's pool of processes of this machine, in which steps on the longest remaining path start first."""

from __future__ import annotations

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
"""Prefect submits the successors of a finished task within this time."""


class RankedPool:
    """Gives an executor one piece of work per worker: the highest rank first, the oldest among equals.

    When work of rank r ends, its worker waits up to `_SUCCESSOR_SECONDS` for a successor of rank r - 1, unless something of that rank
    is waiting already.
    ``rank`` is called in the thread that submits work.
    """

    def __init__(self, executor: Executor, workers: int, rank: Callable[[], int]) -> None:
        self._executor, self._free, self._rank = executor, workers, rank
        self._waiting: list[tuple[int, int, Callable[[], Any], Future[Any]]] = []
        self._numbers, self._changed, self._ended = count(), threading.Condition(), False
        self._kept_for, self._kept_until = 0, 0.0
        # Work is not submitted from callbacks: a broken executor calls them while it holds its own lock.
        threading.Thread(target=self._dispatch, name="ranked pool", daemon=True).start()

    def submit(self, work: Callable[[], Any]) -> Future[Any]:
        """Returns a future of the work's result, which can be cancelled while the work waits."""
        future: Future[Any] = Future()
        with self._changed:
            if self._ended:
                raise RuntimeError("the pool has been shut down")
            heapq.heappush(self._waiting, (-self._rank(), next(self._numbers), work, future))
            self._changed.notify()
        return future

    def shutdown(self, *, wait: bool, cancel_futures: bool) -> None:
        with self._changed:
            self._ended = True
            waiting, self._waiting = self._waiting, []
            self._changed.notify()
        for *_, future in waiting:
            future.cancel()
        self._executor.shutdown(wait=wait, cancel_futures=cancel_futures)

    def _dispatch(self) -> None:
        while (found := self._next()) is not None:
            work, future, rank = found
            if not future.set_running_or_notify_cancel():
                self._release()
                continue
            try:
                self._executor.submit(work).add_done_callback(partial(self._end, future, rank))
            except RuntimeError as error:  # broken, or shut down
                self._release()
                future.set_exception(error)

    def _next(self) -> tuple[Callable[[], Any], Future[Any], int] | None:
        """Wait for a free worker and work for it; None once the pool has been shut down."""
        with self._changed:
            while not self._ended:
                kept = self._kept_until - time.monotonic()
                if self._free and self._waiting and (kept <= 0 or -self._waiting[0][0] >= self._kept_for):
                    self._free -= 1
                    below, _, work, future = heapq.heappop(self._waiting)
                    return work, future, -below
                self._changed.wait(kept if kept > 0 else None)
        return None

    def _release(self) -> None:
        with self._changed:
            self._free += 1
            self._changed.notify()

    def _end(self, future: Future[Any], rank: int, done: Future[Any]) -> None:
        with self._changed:
            now = time.monotonic()
            kept = self._kept_for if now < self._kept_until else 0
            self._kept_for, self._kept_until = max(kept, rank - 1), now + _SUCCESSOR_SECONDS
        self._release()
        error = CancelledError() if done.cancelled() else done.exception()
        if error is None:
            future.set_result(done.result())
        else:
            future.set_exception(error)


def process_runner(workers: int, ranks: Mapping[str, int] | None = None) -> Any:
    """A task runner; ``ranks``, by the name of a task's run: among tasks that are ready, the highest starts first."""
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
