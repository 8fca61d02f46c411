"""Several processes that torchrun started on one step: the first owns the artifact, the others help it to be made.

Only the first takes the lock and finishes the artifact; it announces itself in a small file beside the lock, so that a
helper neither waits for a lock that is never freed nor joins work that another command is doing.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from worldline_core.store.atomic import write_bytes_atomic

_POLL_SECONDS = 0.1


def is_helper() -> bool:
    """Whether torchrun started this process as another than the first."""
    return int(os.environ.get("WORLD_SIZE", "1")) > 1 and int(os.environ.get("RANK", "0")) > 0


def _launch() -> bytes:
    """Names the launch that this process belongs to: the same in all of its processes."""
    names = ("TORCHELASTIC_RUN_ID", "MASTER_ADDR", "MASTER_PORT", "WORLD_SIZE")
    return " ".join(os.environ.get(name, "") for name in names).encode()


@contextmanager
def announced(path: Path) -> Iterator[None]:
    """Within the context, helpers of this launch may work; without helpers nothing is written."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield
        return
    write_bytes_atomic(path, _launch())
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


def wait_for_announcement[T](path: Path, finished: Callable[[], T | None]) -> T | None:
    """Return None once the first process has begun, or what ``finished`` finds if there is nothing left to do.

    If the first process fails instead, torchrun ends this one.
    """
    while (found := finished()) is None:
        if path.is_file() and path.read_bytes() == _launch():
            return None
        time.sleep(_POLL_SECONDS)
    return found


def wait_until[T](finished: Callable[[], T | None]) -> T:
    """Return what ``finished`` finds, once it finds something."""
    while (found := finished()) is None:
        time.sleep(_POLL_SECONDS)
    return found
