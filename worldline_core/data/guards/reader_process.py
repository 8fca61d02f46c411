"""A process that reads what others recorded, with a limit of memory and a deadline.

A decoder may crash on a damaged file, never end, or ask for all memory of the machine. In a process of its own that costs
one recording: the run goes on with a new reader. A reader is kept from call to call, so that it opens each source once;
results are small, and frames come back through files.
"""

from __future__ import annotations

import atexit
import os
import pickle
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection, Pipe
from multiprocessing.util import get_temp_dir
from tempfile import mkdtemp
from typing import Any

from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.errors import UnavailableError
from worldline_core.scale.process import end_with_parent

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_SECONDS_TO_END = 5.0
_SIGN_OF_LIFE = b""
_SIGN_EVERY_SECONDS = 1.0


class ReaderLimits(StrictModel):
    """Limits of reading one recording; one that needs more is quarantined."""

    memory_gb: float = Field(default=8.0, gt=0, description="memory of the process that reads")
    seconds: float = Field(default=600.0, gt=0, description="time without a picture decoded or a file opened")


def read_limited[T](limits: ReaderLimits, function: Callable[..., T], *arguments: object) -> T:
    """Result of `function`, called in the reader process of this thread.

    A reader that has read other recordings before may fail by what these left behind: then a new one tries again.

    Args:
        function: of a module; it, its arguments and its result are pickled.

    Raises: RejectedInputError (crashed, out_of_time, out_of_memory); UnavailableError when no reader can be started;
        whatever the function raises.
    """
    while True:
        reader = _idle_reader() or _Reader()
        reused, reader.used = reader.used, True
        try:
            error, result = reader.call(limits, function, arguments)
        except RejectedInputError as lost:
            reader.end()
            if reused and lost.reason == "crashed":
                continue
            raise
        except BaseException:
            reader.end()
            raise
        if isinstance(error, RejectedInputError) and error.reason == "out_of_memory":
            reader.end()
            if reused:
                continue
        else:
            _idle.append(reader)
        if error is not None:
            raise error
        return result


def still_reading() -> None:
    """Give a sign of life: in a reader process the deadline begins anew. Elsewhere nothing happens."""
    global _last_sign
    if _caller is not None and time.monotonic() - _last_sign > _SIGN_EVERY_SECONDS:
        _caller.send_bytes(_SIGN_OF_LIFE)
        _last_sign = time.monotonic()


class _Reader:
    """A reader process, as seen by the process that waits for it."""

    def __init__(self) -> None:
        self.used = False
        self.environment = _environment()
        self._folder = mkdtemp(prefix="worldline-reader-", dir=get_temp_dir())  # for its copies of remote files
        self._connection, there = Pipe()
        with there:
            # Not multiprocessing: that imports the program's main module again, and allows no children of daemons.
            code = (
                f"import sys; sys.path[:] = {sys.path!r}\n"
                f"from {__name__} import serve\n"
                f"serve({there.fileno()}, {os.getpid()})"
            )
            self._process = subprocess.Popen(  # noqa: S603 - this same program
                [sys.executable, "-c", code],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[there.fileno()],
                env={**self.environment, **dict.fromkeys(_THREADS, "1"), "TMPDIR": self._folder},
            )
        try:
            self._connection.recv_bytes()
        except (EOFError, ConnectionError) as error:
            raise UnavailableError(
                "The process that reads recordings does not start",
                got=self._ending(),
                next_step="see what it wrote to the terminal",
            ) from error

    def call(self, limits: ReaderLimits, function: Callable[..., Any], arguments: tuple[object, ...]) -> Any:
        """(error, result), one of them None.

        Raises: RejectedInputError (crashed, out_of_time).
        """
        try:
            self._connection.send((limits, function, arguments))
            content = self._connection.recv_bytes()  # the function is imported, which is no time of the recording's
            while content == _SIGN_OF_LIFE:
                if not self._connection.poll(limits.seconds):
                    raise RejectedInputError(
                        "out_of_time",
                        "Reading does not come to an end",
                        expected=f"a file opened or a picture decoded within {limits.seconds:g} s",
                        next_step="copy the file again; if it is whole, raise curate.reader.seconds",
                        evidence={"limit_seconds": limits.seconds},
                    )
                content = self._connection.recv_bytes()
        except (EOFError, ConnectionError) as error:
            raise RejectedInputError(
                "crashed",
                "The process that reads has crashed",
                got=self._ending(),
                next_step="copy the file again; if it is whole, report this bug",
            ) from error
        return pickle.loads(content)  # noqa: S301 - written by this same program

    def _ending(self) -> str:
        try:
            status = self._process.wait(_SECONDS_TO_END)
        except subprocess.TimeoutExpired:
            return "closed connection"
        return signal.Signals(-status).name if status < 0 else f"exit status {status}"

    def end(self) -> None:
        """Kill the process, where it still runs."""
        self._process.kill()
        self._process.wait()
        self._connection.close()
        shutil.rmtree(self._folder, ignore_errors=True)


# Appending and popping are atomic: threads need no lock. A forked process has no readers of its own.
_idle: list[_Reader] = []
os.register_at_fork(after_in_child=_idle.clear)


def _environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}


def _idle_reader() -> _Reader | None:
    """A reader with the present environment, which holds credentials and endpoints of object stores."""
    while _idle:
        reader = _idle.pop()
        if reader.environment == _environment():
            return reader
        reader.end()
    return None


@atexit.register
def _end_readers() -> None:
    while _idle:
        _idle.pop().end()


_caller: Connection | None = None
_last_sign = 0.0


def serve(descriptor: int, parent: int) -> None:
    """Answer calls until the other end of the connection is closed: the body of a reader process."""
    global _caller
    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that started this one decides what is interrupted
    end_with_parent(lambda: os._exit(1))
    if os.getppid() != parent:
        return
    cv2.setNumThreads(1)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with Connection(descriptor) as _caller:
        _caller.send_bytes(_SIGN_OF_LIFE)
        while True:
            try:
                limits, function, arguments = _caller.recv()
            except EOFError:
                return
            _caller.send_bytes(_SIGN_OF_LIFE)
            _caller.send(_answer(limits, function, arguments))


def _answer(limits: ReaderLimits, function: Callable[..., Any], arguments: tuple[object, ...]) -> tuple[Any, Any]:
    resource.setrlimit(resource.RLIMIT_DATA, (int(limits.memory_gb * 2**30), resource.RLIM_INFINITY))
    try:
        return None, function(*arguments)
    except Exception as error:  # noqa: BLE001 - raised again by the process that waits
        if lack := _lack_of_memory(error):
            rejected = RejectedInputError(
                "out_of_memory",
                "Reading needs too much memory",
                expected=f"at most {limits.memory_gb:g} GB",
                got=str(lack) or None,
                next_step="the file is damaged or hostile; if it is neither, raise curate.reader.memory_gb",
                evidence={"limit_gb": limits.memory_gb},
            )
            return rejected, None
        error.add_note("".join(traceback.format_tb(error.__traceback__)))  # which pickling loses
        return error, None


def _lack_of_memory(error: BaseException | None) -> BaseException | None:
    """The cause of an error that is a lack of memory: also of a library that finds none to be loaded into."""
    while error is not None and not isinstance(error, MemoryError):
        if isinstance(error, ImportError) and "failed to map segment" in str(error):
            return error
        error = error.__cause__
    return error
