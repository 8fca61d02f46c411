"""Stopping a command: it ends at once, with everything that it started, and says what to do."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

# The work starts a process of its own that ignores polite signals, as a busy pool does, and writes its id.
WORK = """
import signal, subprocess, sys, time
from tasks.execution.supervisor import run_supervised

def work():
    code = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('ready', flush=True); time.sleep(60)"
    helper = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    helper.stdout.readline()
    print(helper.pid, flush=True)
    %s

run_supervised(work, continues=True)
"""


def start(project_root: Path, body: str) -> tuple[subprocess.Popen[str], int]:
    process = subprocess.Popen(
        [sys.executable, "-c", WORK % body], cwd=project_root, env={**os.environ, "PYTHONPATH": str(project_root)},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    return process, int(process.stdout.readline())


def wait_until_gone(pid: int) -> None:
    deadline = time.monotonic() + 10
    while Path(f"/proc/{pid}").exists() and time.monotonic() < deadline:
        if Path(f"/proc/{pid}/stat").read_text().rsplit(") ")[-1].startswith("Z"):
            return  # dead; whoever adopted it has not asked yet
        time.sleep(0.05)
    assert not Path(f"/proc/{pid}").exists()


SLEEP = "time.sleep(60)"
DEAF = pytest.param(
    f"signal.signal(signal.SIGTERM, signal.SIG_IGN); {SLEEP}", signal.SIGINT, 130, marks=pytest.mark.slow
)


@pytest.mark.parametrize(
    ("body", "number", "status"), [(SLEEP, signal.SIGINT, 130), (SLEEP, signal.SIGTERM, 143), DEAF]
)
def test_a_signal_from_the_terminal_stops_everything(project_root: Path, body: str, number: int, status: int) -> None:
    process, helper = start(project_root, body)
    os.killpg(process.pid, number)
    _, error = process.communicate(timeout=20)
    assert (process.returncode, error) == (status, "stopped; the same command continues\n")
    wait_until_gone(helper)


@pytest.mark.parametrize(
    ("body", "status", "said"),
    [
        ("helper.kill(); raise SystemExit(7)", 7, ""),
        (
            "signal.raise_signal(signal.SIGKILL)",
            137,
            "ended by SIGKILL, perhaps for its memory; the same command continues",
        ),
    ],
)
def test_the_command_ends_with_the_status_of_the_work(project_root: Path, body: str, status: int, said: str) -> None:
    process, helper = start(project_root, body)
    _, error = process.communicate(timeout=20)
    assert process.returncode == status
    assert said in error
    wait_until_gone(helper)


def test_the_work_ends_with_a_torchrun_that_is_killed(project_root: Path, tmp_path: Path) -> None:
    """torchrun starts its commands in sessions of their own, so that killing it, or its group, reaches none of them."""
    (tmp_path / "command.py").write_text(WORK % "time.sleep(60)")
    launcher = (
        "import os, subprocess, sys\n"
        "os.environ['TORCHELASTIC_RUN_ID'] = 'none'\n"
        "command = subprocess.Popen([sys.executable, sys.argv[1]], start_new_session=True)\n"
        "print(command.pid, flush=True)\n"
        "command.wait()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", launcher, str(tmp_path / "command.py")], cwd=project_root, stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(project_root)}, text=True,
    ) as torchrun:  # fmt: skip
        started = [int(torchrun.stdout.readline()) for _ in range(2)]
        torchrun.kill()
    for process in started:
        wait_until_gone(process)


def test_the_work_ends_with_a_command_that_is_killed(project_root: Path) -> None:
    process, helper = start(project_root, "time.sleep(60)")
    process.kill()
    process.wait()
    wait_until_gone(helper)


RECORDING = """
import os, time
from worldline_core.recorder.record import run_in_processes

def record_for_a_minute(task):
    os.write(1, f"{os.getpid()}\\n".encode())
    time.sleep(60)

if __name__ == "__main__":
    list(run_in_processes(record_for_a_minute, [0, 1], workers=2))
"""


@pytest.mark.slow
def test_processes_that_record_end_with_the_one_that_started_them(project_root: Path, tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    (tmp_path / "recording.py").write_text(RECORDING)
    with subprocess.Popen(
        [sys.executable, str(tmp_path / "recording.py")], cwd=project_root, stdout=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": str(project_root)},
    ) as recording:  # fmt: skip
        worker = int(recording.stdout.readline())
        recording.kill()
    wait_until_gone(worker)
