"""One bad recording costs its reader's process, never the run."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.data.curating import rejected
from worldline_core.data.guards.reader_process import ReaderLimits, read_limited
from worldline_core.data.guards.rejection import RejectedInputError, check_columns
from worldline_core.errors import ConfigError
from worldline_core.store.remote import parse_location

LIMITS = ReaderLimits(memory_gb=2, seconds=60)


@pytest.mark.slow
def test_threads_read_side_by_side() -> None:
    """Each with a reader of its own: the pauses do not add up."""
    with ThreadPoolExecutor(2) as threads:
        list(threads.map(lambda _: read_limited(LIMITS, time.sleep, 0.2), range(2)))  # both are started
        started = time.monotonic()
        list(threads.map(lambda _: read_limited(LIMITS, time.sleep, 0.8), range(2)))
    assert time.monotonic() - started < 1.5


def test_what_a_function_raises_is_raised_here_and_the_reader_is_kept() -> None:
    before = read_limited(LIMITS, os.getpid)
    assert before != os.getpid()
    with pytest.raises(FileNotFoundError, match="no-such-file"):
        read_limited(LIMITS, os.stat, "/no-such-file")
    with pytest.raises(ConfigError, match="gopher2"):
        read_limited(LIMITS, parse_location, "gopher2://x/y")
    with pytest.raises(RejectedInputError, match="columns") as caught:
        read_limited(LIMITS, check_columns, 2000, "here")
    assert (caught.value.reason, caught.value.evidence["declared"]) == ("too_large", 2000)
    assert read_limited(LIMITS, os.getpid) == before


def test_a_crash_is_named_and_costs_its_reader_only() -> None:
    before = read_limited(LIMITS, os.getpid)
    with rejected("crashed", "SIGABRT"):
        read_limited(LIMITS, os.abort)
    assert read_limited(LIMITS, os.getpid) != before


@pytest.mark.parametrize("failure", ["os.abort()", "bytearray(5 << 30)", "hdf5.require_h5py()"])
def test_a_failure_by_what_was_read_before_is_tried_again(tmp_path: Path, failure: str) -> None:
    """The second reader finds the mark of the first one."""
    read_limited(LIMITS, os.getpid)
    code = f"""
import importlib, os, pathlib
from worldline_core.data.sources import hdf5
def import_without_memory(name):
    raise ImportError("h5py/_errors.so: failed to map segment from shared object")
mark = pathlib.Path({str(tmp_path / "mark")!r})
if not mark.exists():
    mark.touch()
    importlib.import_module = import_without_memory
    {failure}
"""
    read_limited(LIMITS, exec, code)
    assert (tmp_path / "mark").exists()


def test_too_much_memory_or_time() -> None:
    with rejected("out_of_memory", "2 GB"):
        read_limited(LIMITS, bytearray, 5 << 30)
    assert read_limited(LIMITS, len, bytes(1 << 20)) == 1 << 20
    started = time.monotonic()
    with rejected("out_of_time", "0.3 s"):
        read_limited(ReaderLimits(seconds=0.3), time.sleep, 100)
    assert time.monotonic() - started < 30


@pytest.mark.slow
def test_signs_of_life_put_the_deadline_off() -> None:
    code = """
import time
from worldline_core.data.guards import reader_process
reader_process._SIGN_EVERY_SECONDS = 0.1
for _ in range(6):
    time.sleep(0.2)
    reader_process.still_reading()
"""
    read_limited(ReaderLimits(seconds=0.8), exec, code)


@pytest.mark.slow
def test_what_a_function_imports_is_no_time_of_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine the first recording of a reader, whose imports took longer than the limit, was `out_of_time`."""
    slow = "import os, time\n'PYTEST_CURRENT_TEST' in os.environ or time.sleep(0.8)\ndef answer(): return 42\n"
    (tmp_path / "slow_module.py").write_text(slow)
    monkeypatch.syspath_prepend(tmp_path)
    assert read_limited(ReaderLimits(seconds=0.5), importlib.import_module("slow_module").answer) == 42


def test_a_reader_ends_with_the_process_that_waits_for_it(tmp_path: Path) -> None:
    """Even when that one is killed while the reader works."""
    mark = tmp_path / "pid"
    work = f"import os, time, pathlib; pathlib.Path({str(mark)!r}).write_text(str(os.getpid())); time.sleep(100)"
    code = f"from worldline_core.data.guards.reader_process import *; read_limited(ReaderLimits(), exec, {work!r})"
    with subprocess.Popen([sys.executable, "-c", code]) as process:
        while not (mark.exists() and mark.read_text()):
            assert process.poll() is None
            time.sleep(0.05)
        process.kill()
    for _ in range(100):
        try:
            if Path(f"/proc/{mark.read_text()}/stat").read_text().split()[2] == "Z":
                return
        except FileNotFoundError:
            return
        time.sleep(0.1)
    pytest.fail("the reader goes on")
