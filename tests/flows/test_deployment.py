"""`prefect deployment run` against a real local server and worker, with the smoke preset."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from worldline_core.evaluation.paired import read_series, write_series
from worldline_core.report.comparison import scores_file

PREFECT = [sys.executable, "-m", "prefect"]


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory, project_root: Path) -> Iterator[dict[str, str]]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    home = tmp_path_factory.mktemp("prefect")
    variables = os.environ | {
        "PREFECT_HOME": str(home), "PREFECT_API_URL": f"http://127.0.0.1:{port}/api", "NO_COLOR": "1",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "PREFECT_WORKER_QUERY_SECONDS": "1",  # runs are picked up at once, not within ten seconds
    }  # fmt: skip
    with _started(
        variables, project_root, home / "server.log", "server", "start", "--port", f"{port}", "--no-ui"
    ) as server:
        deadline = time.time() + 180
        while True:
            assert time.time() < deadline and server.poll() is None, "the Prefect server did not answer"
            try:
                with urllib.request.urlopen(f"{variables['PREFECT_API_URL']}/health", timeout=2):
                    break
            except OSError:
                time.sleep(0.5)
        yield variables


@contextmanager
def _started(environment: dict[str, str], cwd: Path, log: Path, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    with log.open("w") as stream:
        process = subprocess.Popen(
            [*PREFECT, *arguments], env=environment, cwd=cwd, stdout=stream, stderr=stream, start_new_session=True
        )
        try:
            yield process
        finally:
            os.killpg(process.pid, signal.SIGTERM)
            try:
                process.wait(timeout=20)
            except subprocess.TimeoutExpired:  # Prefect's worker now and then loses the signal and polls on
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


@pytest.fixture(scope="module")
def worker_log(
    environment: dict[str, str], project_root: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Path]:
    """Output of a worker that serves all deployments."""
    for command in ("work-pool create worldline --type process", "--no-prompt deploy --all"):
        done = subprocess.run(
            [*PREFECT, *command.split()], env=environment, cwd=project_root, capture_output=True, text=True, timeout=200, check=False
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
    log = tmp_path_factory.mktemp("worker") / "worker.log"
    with _started(environment, project_root, log, "worker", "start", "--pool", "worldline"):
        yield log


def _run(environment: dict[str, str], cwd: Path, deployment: str, parameters: dict[str, Any], status: int = 0) -> None:
    """A deployed run, watched to its end."""
    watched = ["--params", json.dumps(parameters), "--watch", "--watch-timeout", "420"]
    done = subprocess.run(
        [*PREFECT, "deployment", "run", deployment, *watched],
        env=environment, cwd=cwd, capture_output=True, text=True, timeout=450, check=False,
    )  # fmt: skip
    assert done.returncode == status, done.stdout + done.stderr


def _ask(environment: dict[str, str], path: str, body: dict[str, Any]) -> Any:
    request = urllib.request.Request(
        f"{environment['PREFECT_API_URL']}/{path}", json.dumps(body).encode(), {"Content-Type": "application/json"}
    )
    with urllib.request.urlopen(request, timeout=10) as answer:
        return json.load(answer)


@pytest.mark.slow
def test_nightly_guards_on_a_real_server_and_worker(
    environment: dict[str, str], worker_log: Path, project_root: Path, tmp_path: Path
) -> None:
    config, artifacts = tmp_path / "nightly.yaml", tmp_path / "artifacts"
    source = {"kind": "episode_set", "path": "artifacts/shipped/recordings", "name": "shipped", "license": "Apache-2.0",
              "redistribution": "yes", "include": ["*-test-s1-0000[0-1]"]}  # fmt: skip
    # A night needs a model that it does not train itself: banks are not rolled out, so this one costs nothing.
    models = {"causal": "artifacts/shipped/models/causal"}
    own = {"models": models, "rollouts": {"causal": {"checkpoint": "shipped_causal"}}, "evaluate_policy": None}
    config.write_text(json.dumps({"extends": "smoke", "curate": {"sources": [source]}, **own}))
    given = {"preset": None, "config": str(config), "artifacts": str(artifacts)}
    _run(environment, project_root, "nightly-evaluation/nightly-evaluation", {**given, "night": "first"})

    # The good night was three points of IoU better than what is measured now.
    history = artifacts / "nightly"
    scores = read_series(scores_file(history, "first"))
    better = {n: {r: v + 0.03 * ("robot_iou@head" in n) for r, v in values.items()} for n, values in scores.items()}
    write_series(scores_file(history, "first"), better)
    metric = "video/test/copy_first_frame/robot_iou@head"
    assert len(scores[metric]) >= 8
    _run(environment, project_root, "nightly-evaluation/nightly-evaluation", {**given, "night": "second"}, status=1)
    wanted = {"flows": {"name": {"any_": ["nightly-evaluation"]}}, "sort": "START_TIME_DESC"}
    runs = _ask(environment, "flow_runs/filter", wanted)
    assert [run["state"]["type"] for run in runs] == ["FAILED", "COMPLETED"]
    message = runs[0]["state"]["message"]
    for part in (metric, "-0.030", "12 recordings, most on", "worldline nightly --accept second"):
        assert part in message, message
    for run in runs:
        filters = {"artifacts": {"flow_run_id": {"any_": [run["id"]]}}}
        kinds = {found["key"]: found["type"] for found in _ask(environment, "artifacts/filter", filters)}
        assert (kinds["report"], kinds["metrics"], kinds["picture"]) == ("markdown", "table", "image")
    assert metric in (history / "index.html").read_text()
    _run(environment, project_root, "step/filter", given)
