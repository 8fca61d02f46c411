"""A run without a server: what others left in Prefect's home does not matter, and it ends without a traceback."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

KILLED = """
    import os, signal, sys
    from pathlib import Path
    from tasks.execution.temporary_server import set_up_temporary_server

    set_up_temporary_server()
    from prefect import flow, task
    from tasks.execution.prefect_artifacts import run_flow, show_in_prefect
    from worldline_core.errors import UnavailableError

    def kill_server():
        for entry in Path("/proc").glob("[0-9]*"):
            try:
                parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
                if parent == os.getpid() and b"uvicorn" in (entry / "cmdline").read_bytes():
                    os.kill(int(entry.name), signal.SIGKILL)
            except OSError:
                continue

    @task
    def node(number: int) -> int:
        if number == 1:
            kill_server()
        return number

    @flow
    def killed_run() -> int:
        found = sum(node(number) for number in range(4))
        show_in_prefect(Path.cwd(), {})
        return found

    print("sum", run_flow(killed_run), flush=True)
    os._exit(0)
"""


@pytest.mark.slow
def test_a_server_that_is_killed_fails_no_run_whose_work_is_done(tmp_path: Path, project_root: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    environment |= {"PREFECT_HOME": str(tmp_path), "PYTHONPATH": str(project_root), "PREFECT_CLIENT_MAX_RETRIES": "0"}
    ended = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(KILLED)],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert (ended.returncode, ended.stdout.split()[-2:]) == (0, ["sum", "6"]), ended.stderr
