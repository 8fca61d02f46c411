"""Settings of a run's processes: end with the parent, equal bytes when continued, freed memory kept."""

from __future__ import annotations

import ctypes
import functools
import logging
import multiprocessing
import multiprocessing.util
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from worldline_core.store.artifact_files import read_json
from worldline_core.store.atomic import write_json_atomic

logger = logging.getLogger(__name__)

_TRIM_THRESHOLD, _MMAP_MAX, _ARENA_MAX = -1, -4, -8  # malloc.h
_NEVER = 2**31 - 1


def end_with_parent(end: Callable[[], object]) -> None:
    """Call `end` soon after the process that started this one has ended: killed, it cannot end this one itself."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.2)
        end()

    threading.Thread(target=watch, name="end with parent", daemon=True).start()


@functools.cache
def end_with_pool() -> None:
    """Let this process of a pool end with the one that started it, at once where that has ended already.

    It skips Python's own clean-up at exit, which takes a spawned process with torch and Prefect three seconds.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        # A priority below multiprocessing's own finalizers, which flush queues and join children.
        multiprocessing.util.Finalize(None, _exit_flushed, exitpriority=-100)
        end_with_parent(lambda: os._exit(1))
        if not parent.is_alive():
            os._exit(1)


def _exit_flushed() -> None:
    if sys.exc_info()[0] is None:  # otherwise Python prints the error and exits with 1
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)


@contextmanager
def same_threads(output: Path) -> Iterator[None]:
    """Give work that is continued the number of linear-algebra threads it began with.

    Sums in another order round differently, so the bytes of a result would depend on where the work was interrupted.
    """
    torch = sys.modules.get("torch")
    if torch is None:
        yield
        return
    path, now = output / "run" / "threads.json", torch.get_num_threads()
    begun = read_json(path).get("threads")
    if begun not in (None, now):
        logger.info("continuing on %d threads, as it began, instead of %d", begun, now)
        torch.set_num_threads(begun)
    elif begun is None:
        write_json_atomic(path, {"threads": now})
    try:
        yield
    finally:
        torch.set_num_threads(now)


def keep_freed_memory() -> bool:
    """Have glibc keep freed blocks for the next allocation; returns whether it does.

    By default it returns large blocks to the kernel, and every page of the next tensor is mapped and zeroed again: decoding
    by the small tokenizer takes twice as long. Peak memory stays the same. A choice in the environment (MALLOC_...,
    GLIBC_TUNABLES, another allocator in LD_PRELOAD) is left alone.
    """
    if any(name.startswith("MALLOC_") or name in ("GLIBC_TUNABLES", "LD_PRELOAD") for name in os.environ):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):
        return False
    # One arena for all threads: blocks too large for the small arenas of threads would be mapped and unmapped again.
    settings = ((_MMAP_MAX, 0), (_TRIM_THRESHOLD, _NEVER), (_ARENA_MAX, 1))
    done = [bool(mallopt(parameter, value)) for parameter, value in settings]
    return all(done)
