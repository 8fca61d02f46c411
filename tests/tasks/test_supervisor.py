"""Processes of a command: it ends with all that it started, and continued work has the threads that it began with."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

from worldline_core.store.artifact_files import read_manifest
from worldline_core.store.store import ArtifactStore

# The work starts a process of its own that ignores polite signals, as a busy pool does, and writes its id.
WORK = """
import signal, subprocess, sys, time
from tasks.execution.command_line import run_supervised

def work():
    code = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('ready', flush=True); time.sleep(60)"
    helper = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    helper.stdout.readline()
    print(helper.pid, flush=True)
    %s

run_supervised(work, continues=True)
"""


def start(project_root: Path, *command: str) -> tuple[subprocess.Popen[str], int]:
    """A process and the number that it prints first: one of its own."""
    process = subprocess.Popen(
        [sys.executable, *command], cwd=project_root, env=os.environ | {"PYTHONPATH": str(project_root)},
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


@pytest.mark.parametrize(
    ("body", "number", "status"),
    [
        (SLEEP, signal.SIGINT, 130),
        (SLEEP, signal.SIGTERM, 143),
        pytest.param(f"signal.signal(signal.SIGTERM, signal.SIG_IGN); {SLEEP}", signal.SIGINT, 130, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_a_signal_from_the_terminal_stops_everything(project_root: Path, body: str, number: int, status: int) -> None:
    process, helper = start(project_root, "-c", WORK % body)
    os.killpg(process.pid, number)
    _, error = process.communicate(timeout=20)
    assert (process.returncode, error) == (status, "stopped; the same command continues\n")
    wait_until_gone(helper)


@pytest.mark.parametrize(
    ("body", "status", "said"),
    [
        ("helper.kill(); raise SystemExit(7)", 7, ""),
        ("signal.raise_signal(signal.SIGKILL)", 137, "SIGKILL, perhaps for its memory; the same command continues"),
    ],
)
def test_the_command_ends_with_the_status_of_the_work(project_root: Path, body: str, status: int, said: str) -> None:
    process, helper = start(project_root, "-c", WORK % body)
    _, error = process.communicate(timeout=20)
    assert process.returncode == status
    assert said in error
    wait_until_gone(helper)


TORCHRUN = """
import os, subprocess, sys
os.environ["TORCHELASTIC_RUN_ID"] = "none"
command = subprocess.Popen([sys.executable, sys.argv[1]], start_new_session=True)
print(command.pid, flush=True)
command.wait()
"""


def test_the_work_ends_with_a_torchrun_that_is_killed(project_root: Path, tmp_path: Path) -> None:
    """torchrun starts its commands in sessions of their own, so that killing it, or its group, reaches none of them."""
    (tmp_path / "command.py").write_text(WORK % SLEEP)
    torchrun, command = start(project_root, "-c", TORCHRUN, str(tmp_path / "command.py"))
    helper = int(torchrun.stdout.readline())
    kill(torchrun)
    for process in (command, helper):
        wait_until_gone(process)


def kill(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.communicate()


def test_the_work_ends_with_a_command_that_is_killed(project_root: Path) -> None:
    process, helper = start(project_root, "-c", WORK % SLEEP)
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
    recording, worker = start(project_root, str(tmp_path / "recording.py"))
    recording.kill()
    recording.wait()
    wait_until_gone(worker)


def test_a_step_is_continued_on_the_threads_that_it_began_with(tmp_path: Path, declare: Any) -> None:
    seen: list[int] = []

    def work(config: object, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
        seen.append(torch.get_num_threads())
        if len(seen) == 1:
            raise KeyboardInterrupt
        return {}

    task = declare("count", function=work)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        with pytest.raises(KeyboardInterrupt):
            task.run(ArtifactStore(tmp_path), task.load_config()(), {})
        torch.set_num_threads(1)
        artifact = task.run(ArtifactStore(tmp_path), task.load_config()(), {})
        assert (seen, torch.get_num_threads()) == ([3, 3], 1)
    finally:
        torch.set_num_threads(before)
    assert read_manifest(artifact.path)["environment"]["threads"] == 3


FREED = """
import sys
from worldline_core.scale.process import keep_freed_memory

kept = keep_freed_memory()
block = b"x" * (256 << 20)
del block
resident = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmRSS"))
print(kept, resident > 256 << 10)
"""


@pytest.mark.skipif("glibc" not in str(os.confstr("CS_GNU_LIBC_VERSION")), reason="glibc's malloc")
@pytest.mark.parametrize(("environment", "said"), [({}, "True True"), ({"MALLOC_ARENA_MAX": "2"}, "False False")])
def test_freed_memory_is_kept_unless_the_environment_says_otherwise(
    project_root: Path, environment: dict[str, str], said: str
) -> None:
    chosen = ("GLIBC_TUNABLES", "LD_PRELOAD", "MALLOC_")
    others = {name: value for name, value in os.environ.items() if not name.startswith(chosen)}
    done = subprocess.run(
        [sys.executable, "-c", FREED], capture_output=True, text=True, cwd=project_root, env=others | environment, check=True
    )  # fmt: skip
    assert done.stdout.strip() == said
