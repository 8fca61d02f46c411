"""Nodes of a run: started when their inputs are finished, side by side in processes, with a page that stays true."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import textwrap
import time
import urllib.request
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from prefect import flow
from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import FlowFilter, FlowFilterName
from prefect.settings import PREFECT_API_URL, PREFECT_LOCAL_STORAGE_PATH, temporary_settings

from tasks.artifact_task import ArtifactReference
from tasks.prefect_artifacts import is_worth_saying, show_in_prefect
from tasks.run_nodes import RunPage, run_nodes
from worldline_core.config import StrictModel, load_config
from worldline_core.errors import DataError
from worldline_core.pipeline import steps
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.pipeline.plan import Node, plan
from worldline_core.pipeline.steps import Step
from worldline_core.scale.mapping import RunnerConfig


class WriteConfig(StrictModel):
    text: str


def write(config: WriteConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    if config.text == "broken":
        raise DataError("This node cannot work")
    before = "".join((folder / "text").read_text() for folder in inputs.values())
    (output / "text").write_text(before + config.text)
    return {"written": len(before) + 1}


class WriteStep(Step):
    def load_function(self) -> Any:
        return write

    def load_config(self) -> type[StrictModel]:
        return WriteConfig


class Watcher:
    def __init__(self) -> None:
        self.events: list[str] = []

    def started(self, node: str) -> None:
        self.events.append(f"started {node}")

    def finished(self, node: str, artifact: ArtifactReference, cached: bool) -> None:
        self.events.append(f"{'found' if cached else 'made'} {node}")


@pytest.fixture
def storage(prefect_server: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    for name, inputs in (("write_first", ()), ("write_next", ("before",))):
        monkeypatch.setitem(steps.STEPS, name, WriteStep(name, 1, "", "", "", inputs))
    with temporary_settings({PREFECT_LOCAL_STORAGE_PATH: tmp_path / "prefect"}):
        yield tmp_path / "store"


def nodes(second: str = "b") -> list[Node]:
    # Given in an order in which they cannot be started.
    return [
        Node("write_next.second", "write_next", WriteConfig(text=second), {"before": "write_first"}),
        Node("write_first", "write_first", WriteConfig(text="a"), {}),
    ]


def run(store: Path, second: str = "b", watcher: Any = None) -> dict[str, ArtifactReference]:
    @flow(name=store.parent.name)
    def some_nodes() -> dict[str, ArtifactReference]:
        return run_nodes(nodes(second), store, RunnerConfig(), watcher)

    return some_nodes()


def test_a_node_starts_when_its_inputs_are_finished_and_is_found_the_second_time(storage: Path) -> None:
    watcher = Watcher()
    done = run(storage, watcher=watcher)
    assert (done["write_next.second"].path / "text").read_text() == "ab"
    assert watcher.events == ["started write_first", "made write_first", "started write_next.second", "made write_next.second"]  # fmt: skip
    again = Watcher()
    assert run(storage, watcher=again) == done
    assert [event for event in again.events if "started" not in event] == [
        "found write_first",
        "found write_next.second",
    ]


@pytest.mark.slow
def test_prefect_shows_what_depends_on_what(storage: Path) -> None:
    run(storage)
    deadline, runs = time.monotonic() + 30, {}
    with get_client(sync_client=True) as client:
        while len(runs) < 2 and time.monotonic() < deadline:  # task runs reach the server as events, later
            time.sleep(0.2)
            found = client.read_task_runs(flow_filter=FlowFilter(name=FlowFilterName(any_=[storage.parent.name])))
            runs = {run.name: run for run in found}
    waited_for = runs["write_next.second"].task_inputs["wait_for"]
    assert [source.model_dump()["id"] for source in waited_for] == [runs["write_first"].id]


@pytest.mark.slow
def test_prefect_shows_the_report_and_the_metrics(prefect_server: None, tmp_path: Path) -> None:
    success = {"mean": 0.75, "low": 0.5, "high": 1.0, "count": 9}
    summary = {"methods": {"causal": {"budgets": {"32": {"success": success}}}}}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    scores = ArtifactReference(step="evaluate_planning", path=tmp_path, digest="0" * 64)

    pictures = [tmp_path / "worst.jpg", tmp_path / "second.jpg"]
    for colour, picture in zip(("red", "blue"), pictures, strict=True):
        Image.new("RGB", (8, 6), colour).save(picture)

    @flow
    def shown() -> None:
        show_in_prefect(tmp_path / "latest", {"evaluate_planning": scores, "report": scores}, pictures)

    shown()
    with get_client(sync_client=True) as client:
        found = {artifact.key: artifact.data for artifact in client.read_artifacts()}
    assert (tmp_path / "latest" / "index.html").as_uri() in str(found["report"])
    row = {"metric": "planning/N=32/causal/success", "mean": 0.75, "95 % from": 0.5, "to": 1.0, "trajectories": 9}
    assert json.loads(str(found["metrics"])) == [row]
    for key, picture in zip(("picture", "picture-1"), pictures, strict=True):
        # A browser shows it wherever the page comes from: the picture itself is in its address.
        with urllib.request.urlopen(str(found[key])) as reply:
            assert (reply.headers["Content-type"], reply.read()) == ("image/jpeg", picture.read_bytes())


@pytest.mark.slow
def test_the_page_shows_the_error_that_ended_the_run(storage: Path) -> None:
    with pytest.raises(DataError, match="This node cannot work"), RunPage(storage, ["write_next.second", "write_first"]) as page:  # fmt: skip
        run(storage, "broken", page)
    text = (storage / "report" / "latest" / "index.html").read_text()
    assert "This node cannot work" in text
    assert "write_first" in text


FEW = """
extends: smoke
curate:
  sources: [{kind: episode_set, path: artifacts/shipped/recordings, include: ["viperx_pearl-train-s1-0000[12]"]}]
curate_banks:
  sources: [{kind: episode_set, path: artifacts/shipped/banks, include: [bank_lift_viperx-000]}]
"""


@pytest.mark.slow
def test_nodes_side_by_side_give_the_artifacts_of_one_process(
    prefect_server: None, tmp_path: Path, project_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(project_root)
    (tmp_path / "few.yaml").write_text(FEW)
    settings = load_config(PipelineConfig, path=tmp_path / "few.yaml")
    some = [node for node in plan(settings, project_root) if node.step in ("curate", "render_actions", "filter")]

    @flow
    def side_by_side(at_once: int) -> dict[str, ArtifactReference]:
        return run_nodes(some, tmp_path / f"store{at_once}", RunnerConfig(nodes_at_once=at_once))

    with temporary_settings({PREFECT_LOCAL_STORAGE_PATH: tmp_path / "prefect"}):
        digests = [{name: artifact.digest for name, artifact in side_by_side(n).items()} for n in (1, 2)]
    assert set(digests[0]) == {"curate", "filter", "render_actions", "curate.banks", "render_actions.banks"}
    assert digests[0] == digests[1]


# The pool's processes import this file, so that the line a minute is a line a step in them too.
SIDE_BY_SIDE = """
import sys
from pathlib import Path
from worldline_core import progress
from worldline_core.config import StrictModel
from worldline_core.pipeline import steps

class CountConfig(StrictModel):
    last: int

class CountStep(steps.Step):
    def load_function(self):
        return lambda config, inputs, output: {"last": list(progress.with_progress(range(config.last), "counting", "number"))}

    def load_config(self):
        return CountConfig

progress.LINE_SECONDS = 0.0
steps.STEPS["count"] = CountStep("count", 1, "", "", "", ())

if __name__ == "__main__":
    from prefect import flow
    from tasks.run_nodes import run_nodes
    from worldline_core.pipeline.plan import Node
    from worldline_core.scale.mapping import RunnerConfig

    nodes = [Node("count", "count", CountConfig(last=3), {}), Node("count.more", "count", CountConfig(last=4), {})]

    @flow
    def both():
        run_nodes(nodes, Path(sys.argv[1]), RunnerConfig(nodes_at_once=2))

    both()
"""


@pytest.mark.slow
def test_nodes_side_by_side_write_each_line_once_and_say_whose_it_is(
    prefect_server: None, project_root: Path, tmp_path: Path
) -> None:
    (tmp_path / "both.py").write_text(SIDE_BY_SIDE)
    process = subprocess.run(
        [sys.executable, tmp_path / "both.py", tmp_path / "store"], cwd=project_root, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, check=False, timeout=250,
        env={**os.environ, "PYTHONPATH": str(project_root), "PREFECT_API_URL": PREFECT_API_URL.value() or ""},
    )  # fmt: skip
    assert process.returncode == 0, process.stdout[-2000:]
    assert "\r" not in process.stdout
    assert "█" not in process.stdout
    shown = [
        line.partition(" - ")[2].partition(" numbers")[0] for line in process.stdout.splitlines() if "number" in line
    ]
    expected = [f"count: counting: {n} of 3" for n in (1, 2, 3)] + [
        f"count.more: counting: {n} of 4" for n in (1, 2, 3, 4)
    ]
    assert sorted(shown) == sorted(expected)


@pytest.mark.parametrize(("error", "shown"), [(DataError("x"), False), (KeyError("x"), True)])
def test_an_error_that_says_what_to_do_is_logged_without_a_traceback(error: Exception, *, shown: bool) -> None:
    record = logging.LogRecord(
        "prefect.flow_runs", logging.ERROR, "", 0, "failed: %r", (error,), (type(error), error, None)
    )
    assert is_worth_saying(record)
    assert (record.exc_info is not None) == shown
    record.msg, record.args = "Crash detected! Execution was aborted by a termination signal.", None
    assert not is_worth_saying(record)


@pytest.mark.slow
def test_a_process_of_the_pool_ends_with_the_one_that_started_it(project_root: Path) -> None:
    code = """
        import multiprocessing, os, time
        from worldline_core.scale.process_end import end_with_pool

        def work(pid):
            end_with_pool()
            pid.value = os.getpid()
            time.sleep(60)

        if __name__ == "__main__":
            context = multiprocessing.get_context("fork")
            pid = context.Value("i", 0)
            context.Process(target=work, args=(pid,)).start()
            while not pid.value:
                time.sleep(0.05)
            print(pid.value, flush=True)
            os._exit(0)
    """
    result = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], cwd=project_root, capture_output=True, text=True, check=True,
        env={**os.environ, "PYTHONPATH": str(project_root)}, timeout=120,
    )  # fmt: skip
    worker = int(result.stdout)
    deadline = time.monotonic() + 20
    while Path(f"/proc/{worker}").exists() and time.monotonic() < deadline:
        time.sleep(0.2)
    assert not Path(f"/proc/{worker}").exists()
