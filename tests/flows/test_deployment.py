"""`prefect deployment run` against a real local server and worker, with the smoke preset."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
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
    variables = {
        **os.environ,
        "PREFECT_HOME": str(home),
        "PREFECT_API_URL": f"http://127.0.0.1:{port}/api",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "PREFECT_WORKER_QUERY_SECONDS": "1",  # runs are picked up at once, not within ten seconds
        "NO_COLOR": "1",
    }
    log = (home / "server.log").open("w")
    server = subprocess.Popen(
        [*PREFECT, "server", "start", "--host", "127.0.0.1", "--port", str(port), "--no-ui"],
        env=variables, cwd=project_root, stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
    )  # fmt: skip
    try:
        _wait_until_healthy(f"{variables['PREFECT_API_URL']}/health", server)
        yield variables
    finally:
        os.killpg(server.pid, signal.SIGTERM)
        server.wait(timeout=30)
        log.close()


def _wait_until_healthy(url: str, server: subprocess.Popen[bytes]) -> None:
    deadline = time.time() + 180
    while time.time() < deadline and server.poll() is None:
        try:
            with urllib.request.urlopen(url, timeout=2):
                return
        except (urllib.error.URLError, TimeoutError, ConnectionError):
            time.sleep(0.5)
    pytest.fail(f"the Prefect server did not answer at {url}")


def _prefect(environment: dict[str, str], cwd: Path, *arguments: str, timeout: int = 200) -> str:
    result = subprocess.run(
        [*PREFECT, *arguments], env=environment, cwd=cwd, capture_output=True, text=True, timeout=timeout, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def _stop(worker: subprocess.Popen[bytes]) -> None:
    os.killpg(worker.pid, signal.SIGTERM)
    try:
        worker.wait(timeout=20)
    except subprocess.TimeoutExpired:  # Prefect's worker now and then loses the signal and polls on
        os.killpg(worker.pid, signal.SIGKILL)
        worker.wait()


@pytest.fixture(scope="module")
def worker_log(
    environment: dict[str, str], project_root: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Path]:
    """What a worker says that serves all deployments."""
    _prefect(environment, project_root, "work-pool", "create", "worldline", "--type", "process")
    _prefect(environment, project_root, "--no-prompt", "deploy", "--all")
    log = tmp_path_factory.mktemp("worker") / "worker.log"
    worker = subprocess.Popen(
        [*PREFECT, "worker", "start", "--pool", "worldline"],
        env=environment, cwd=project_root, stdout=log.open("w"), stderr=subprocess.STDOUT, start_new_session=True,
    )  # fmt: skip
    try:
        yield log
    finally:
        _stop(worker)


def _run(
    environment: dict[str, str], cwd: Path, deployment: str, parameters: dict[str, Any], wait_s: int = 420
) -> subprocess.CompletedProcess[str]:
    """A deployed run, watched to its end."""
    return subprocess.run(
        [*PREFECT, "deployment", "run", deployment, "--params", json.dumps(parameters), "--watch", "--watch-timeout", f"{wait_s}"],
        env=environment, cwd=cwd, capture_output=True, text=True, timeout=wait_s + 30, check=False,
    )  # fmt: skip


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
    own = {
        "models": {"causal": "artifacts/shipped/models/causal"},
        "rollouts": {"causal": {"checkpoint": "shipped_causal"}},
    }
    config.write_text(json.dumps({"extends": "smoke", "curate": {"sources": [source]}, "evaluate_policy": None, **own}))
    given = {"preset": None, "config": str(config), "artifacts": str(artifacts)}
    first = _run(environment, project_root, "nightly-evaluation/nightly-evaluation", {**given, "night": "first"})
    assert first.returncode == 0, first.stdout + first.stderr + worker_log.read_text()

    # The good night was three points of IoU better than what is measured now.
    history = artifacts / "nightly"
    scores = read_series(scores_file(history, "first"))
    better = {n: {r: v + 0.03 * ("robot_iou@head" in n) for r, v in values.items()} for n, values in scores.items()}
    write_series(scores_file(history, "first"), better)
    metric = "video/test/copy_first_frame/robot_iou@head"
    assert len(scores[metric]) >= 8
    second = _run(environment, project_root, "nightly-evaluation/nightly-evaluation", {**given, "night": "second"})
    assert second.returncode == 1, second.stdout + second.stderr
    runs = _ask(
        environment,
        "flow_runs/filter",
        {"flows": {"name": {"any_": ["nightly-evaluation"]}}, "sort": "START_TIME_DESC"},
    )
    assert [run["state"]["type"] for run in runs] == ["FAILED", "COMPLETED"]
    message = runs[0]["state"]["message"]
    for part in (metric, "-0.030", "12 recordings, most on", "pictures/", "worldline nightly --accept second"):
        assert part in message, message
    for run in runs:
        filters = {"artifacts": {"flow_run_id": {"any_": [run["id"]]}}}
        kinds = {found["key"]: found["type"] for found in _ask(environment, "artifacts/filter", filters)}
        assert (kinds["report"], kinds["metrics"], kinds["picture"]) == ("markdown", "table", "image")
    assert metric in (history / "index.html").read_text()

    filtered = _run(environment, project_root, "step/filter", given)
    assert filtered.returncode == 0, filtered.stdout + filtered.stderr
