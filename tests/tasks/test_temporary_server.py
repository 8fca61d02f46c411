"""A run without a server: its temporary one obeys the run alone, and may end before it."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

SERVER = """
    import os, signal
    from pathlib import Path
    from tasks.execution.temporary_server import set_up_temporary_server, start_server_early

    set_up_temporary_server()
    if EARLY:
        start_server_early()
    import httpx
    from prefect import flow, task
    from prefect.client.orchestration import get_client
    from prefect.runtime import flow_run
    from tasks.execution.prefect_artifacts import run_flow, show_in_prefect
    from tasks.execution.shard_mapper import shared_server

    def servers():
        for entry in Path("/proc").glob("[0-9]*"):
            try:
                parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
                if parent == os.getpid() and b"uvicorn" in (entry / "cmdline").read_bytes():
                    yield int(entry.name)
            except OSError:
                continue

    def kill_server():
        (server,) = servers()
        os.kill(server, signal.SIGKILL)

    @task
    def node(number: int) -> int:
        return number
"""

KILLED = """
    @flow
    def killed_run() -> int:
        found = sum(node(number) for number in range(4))
        kill_server()
        show_in_prefect(Path.cwd(), {})
        return found

    print("sum", run_flow(killed_run), flush=True)
    os._exit(0)
"""

KILLED_EARLY = """
    @flow
    def killed_run() -> int:
        kill_server()
        with get_client(sync_client=True) as client:
            return len(client.read_flow_runs())

    try:
        run_flow(killed_run)
    except Exception as error:
        print(type(error).__name__, error.next_step.split()[-1], flush=True)
    os._exit(0)
"""

ATTACKED = """
    FOREIGN = {"Origin": "http://evil.example", "Host": "evil.example"}

    def attack(run_id, url):
        for headers in (FOREIGN, {"Origin": "null"}, {"Host": "evil.example:80"}, {}):
            for method, path in (("DELETE", f"flow_runs/{run_id}"), ("GET", f"flow_runs/{run_id}"),
                                 ("POST", "flow_runs/filter"), ("POST", f"flow_runs/{run_id}/set_state")):
                for content in ("text/plain", "application/json"):
                    answer = httpx.request(method, f"{url}{path}", headers={**headers, "Content-Type": content})
                    assert answer.status_code == 401, answer
                    assert "access-control-allow-origin" not in answer.headers, answer.headers
        asked = {"Origin": "http://evil.example", "Access-Control-Request-Method": "DELETE"}
        answer = httpx.options(f"{url}flow_runs/{run_id}", headers=asked)
        assert answer.status_code >= 400 and "access-control-allow-origin" not in answer.headers

    @flow
    def attacked_run() -> int:
        with get_client(sync_client=True) as client:
            attack(flow_run.id, str(client.api_url))
        return sum(node.map(range(3)).result())

    print("sum", run_flow(attacked_run), flush=True)
    with shared_server(), get_client(sync_client=True) as client:  # a step alone, and the runs are still there
        attack(client.read_flow_runs()[0].id, str(client.api_url))
        print("runs", len(client.read_flow_runs()), flush=True)
"""

SHARDS = """
    import sys
    sys.path.append(os.environ["PYTHONPATH"] + "/tests/scale")
    from number_work import NumberWork
    from tasks.execution.shard_mapper import PrefectMapper
    from worldline_core.scale.mapping import RunnerConfig, map_episodes

    map_episodes(PrefectMapper(RunnerConfig(kind="processes", workers=1)), NumberWork(Path.cwd()), [[1, 2], [4]])
    print("numbers", len(list(Path.cwd().glob("[0-9]"))), flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("program", "early", "printed"),
    [
        (KILLED, True, ["sum", "6"]),
        (KILLED_EARLY, False, ["UnavailableError", "continues"]),
        (ATTACKED, False, ["sum", "3", "runs", "1"]),
        (ATTACKED, True, ["sum", "3", "runs", "1"]),
        (SHARDS, False, ["numbers", "3"]),
    ],
    ids=["killed at the end", "killed early", "attacked", "attacked, started early", "shards in processes"],
)
def test_a_temporary_server(tmp_path: Path, project_root: Path, program: str, early: bool, printed: list[str]) -> None:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    environment |= {"PREFECT_HOME": str(tmp_path), "PYTHONPATH": str(project_root), "PREFECT_CLIENT_MAX_RETRIES": "0"}
    ended = subprocess.run(
        [sys.executable, "-c", f"EARLY = {early}\n" + textwrap.dedent(SERVER) + textwrap.dedent(program)],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert (ended.returncode, ended.stdout.split()) == (0, printed), ended.stderr
    assert "Traceback" not in ended.stderr and "EventsWorker" not in ended.stderr
