"""A command that can be stopped: the work happens in a child process, and this one waits for it and answers signals."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from types import FrameType

from worldline_core.scale.process import end_with_parent

GRACE_SECONDS = 3.0
"""Time that the work has to end by itself, for example at Prefect's server, before it is killed."""
SAVE_SECONDS = 27.0
"""The same where a scheduler asks (SIGTERM): a training saves its state. Less than the 30 s after which torchrun kills."""


class _StoppedError(BaseException):
    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def run_supervised(action: Callable[[], object], *, continues: bool) -> None:
    """Do the work in a process group of its own, and end with its exit status.

    Processes of a pool and Prefect's temporary server belong to that group. Ctrl-C in a terminal reaches this process
    alone; otherwise the server would end first and the flow wait minutes for it. Killed, this process takes the group
    with it, and torchrun takes this process. SIGINT ends the whole group within `GRACE_SECONDS`, SIGTERM within
    `SAVE_SECONDS`, with exit status 130 or 143. Finished work is safe whenever that happens: outputs are written
    atomically, training goes on from its last state.

    Args:
        continues: whether the same command, called again, goes on where this one was stopped.
    """
    if not hasattr(os, "fork"):
        action()
        return
    child = os.fork()
    if child == 0:
        os.setpgid(0, 0)
        end_with_parent(lambda: os.killpg(0, signal.SIGKILL))
        action()
        return
    if "TORCHELASTIC_RUN_ID" in os.environ:  # in a session of its own, which nothing ends when torchrun is killed
        end_with_parent(lambda: (_kill_group(child), os._exit(1)))

    def stop(number: int, _frame: FrameType | None) -> None:
        raise _StoppedError(number)

    again = "; the same command continues" if continues else ""
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, stop)
        _, status = os.waitpid(child, 0)
    except _StoppedError as stopped:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        _end_group(child, GRACE_SECONDS if stopped.number == signal.SIGINT else SAVE_SECONDS)
        print(f"stopped{again}", file=sys.stderr)
        raise SystemExit(128 + stopped.number) from None
    code = os.waitstatus_to_exitcode(status)
    if code < 0:
        _kill_group(child)
        name = signal.Signals(-code).name
        print(f"error: the work was ended by {name}, perhaps for its memory{again}", file=sys.stderr)
    raise SystemExit(code if code >= 0 else 128 - code)


def _end_group(child: int, seconds: float) -> None:
    os.kill(child, signal.SIGTERM)
    deadline = time.monotonic() + seconds
    while os.waitpid(child, os.WNOHANG) == (0, 0):
        if time.monotonic() > deadline:
            _kill_group(child)
            os.waitpid(child, 0)
            return
        time.sleep(0.05)
    _kill_group(child)


def _kill_group(child: int) -> None:
    try:
        os.killpg(child, signal.SIGKILL)
    except ProcessLookupError:
        return  # no process is left
