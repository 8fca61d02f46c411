"""Processes that end with the one that started them: killed, it cannot end them, and they would go on writing."""

from __future__ import annotations

import functools
import multiprocessing
import os
import threading
import time
from collections.abc import Callable


def end_with_parent(end: Callable[[], object]) -> None:
    """Call `end` soon after the process that started this one has ended."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        end()

    threading.Thread(target=watch, name="end with parent", daemon=True).start()


@functools.cache
def end_with_pool() -> None:
    """Let this process of a pool end with the one that started it, at once where that has ended already."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        end_with_parent(lambda: os._exit(1))
        if not parent.is_alive():
            os._exit(1)
