"""Prefect and the store agree: calls start when their inputs are finished, side by side, cached, rebuilt."""

from __future__ import annotations

import base64
import errno
import json
import pickle
import re
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from PIL import Image
from prefect import Task, flow
from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import FlowFilter, FlowFilterName
from prefect.client.schemas.sorting import ArtifactSort, TaskRunSort
from prefect.settings import PREFECT_LOCAL_STORAGE_PATH, temporary_settings

from flows.pipeline import chain as pipeline_chain
from flows.pipeline import pipeline, prepare
from tasks.execution import run_page
from tasks.execution.artifact_task import ArtifactTask, task_names, variant
from tasks.execution.chain import outline
from tasks.execution.prefect_artifacts import show_in_prefect
from tasks.execution.prefect_run import ArtifactReference, PrefectRun
from tasks.execution.process_pool import process_runner
from tasks.execution.shard_mapper import shared_server
from worldline_core.config import StrictModel
from worldline_core.errors import ConfigError, DataError, WorldLineError
from worldline_core.pipeline import memory_estimate
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.scale.mapping import RunnerConfig


@pytest.fixture
def storage(prefect_server: None, tmp_path: Path) -> Iterator[Path]:
    with temporary_settings({PREFECT_LOCAL_STORAGE_PATH: tmp_path / "prefect"}):
        yield tmp_path / "store"


@pytest.fixture
def two_calls(declare: Any) -> Callable[[str], None]:
    first, following = declare("write_first"), declare("write_next", "before")

    def chain(second: str = "b") -> None:
        one = first.submit(first.load_config()(text="a"), "one")
        following.submit(following.load_config()(text=second), "two", before=one)

    return chain


def run(store: Path, chain: Callable[..., None], *arguments: str, page: bool = False) -> dict[str, ArtifactReference]:
    @flow(name=store.parent.name)
    def some_calls() -> dict[str, ArtifactReference]:
        page_of = outline(chain, *arguments) if page else None
        with PrefectRun(store, RunnerConfig(), page_of) as run:
            chain(*arguments)
        return run.artifacts

    return some_calls()


@pytest.mark.slow
def test_a_call_starts_when_its_inputs_are_finished_and_is_found_where_nothing_may_be_written(
    storage: Path, two_calls: Callable[..., None], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    done = run(storage, two_calls)
    assert list(done) == ["one", "two"]
    assert (done["two"].folder / "text").read_text() == "ab"
    made = {path: path.stat().st_mtime_ns for path in storage.rglob("text")}
    for number, text, message in ((errno.EROFS, "broken", "cannot work"), (errno.ENOSPC, "full", "No space left")):
        refuse = Mock(side_effect=OSError(number, "the page cannot be written"))
        monkeypatch.setattr(run_page, "write_progress_page", refuse)
        assert run(storage, two_calls, page=True) == done
        with pytest.raises(WorldLineError, match=message):
            run(storage, two_calls, text, page=True)
    assert {path: path.stat().st_mtime_ns for path in storage.rglob("text")} == made
    assert "Traceback" not in capfd.readouterr().err


def test_equal_calls_are_one(declare: Any) -> None:
    task = declare("write_first")
    config = task.load_config()

    def chain() -> None:
        first = task.submit(config(text="a"))
        with variant("other"):
            assert task.submit(config(text="a")) is first
            task.submit(config(text="b"))

    assert list(outline(chain)) == ["write_first", "write_first.other"]
    with pytest.raises(ConfigError, match="write_first"):
        outline(lambda: [task.submit(config(text=text)) for text in "ab"])


@pytest.mark.slow
def test_prefect_shows_the_report_and_the_metrics(prefect_server: None, tmp_path: Path) -> None:
    success = {"mean": 0.75, "low": 0.5, "high": 1.0, "count": 9}
    summary = {"methods": {"causal": {"budgets": {"32": {"success": success}}}}}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    scores = ArtifactReference(step="evaluate_planning", path=tmp_path, digest="0" * 64)
    (tmp_path / "media").mkdir()
    pictures = [tmp_path / "media" / name for name in ("contact_sheet.jpg", "episode0_shipped_head.jpg")]
    for colour, picture in zip(("red", "blue"), pictures, strict=True):
        Image.new("RGB", (8, 6), colour).save(picture)
    verdicts = {"video/gone": "missing", "planning/N=32/causal/success": "worse by 0.200"}

    @flow
    def shown() -> None:
        show_in_prefect(tmp_path / "latest", {"evaluate_planning": scores, "report": scores}, verdicts)

    shown()
    with get_client(sync_client=True) as client:
        read = client.read_artifacts(sort=ArtifactSort.CREATED_DESC)[::-1]
    found = {artifact.key: str(artifact.data) for artifact in read}
    described = {artifact.key: str(artifact.description) for artifact in read}
    assert (tmp_path / "latest" / "index.html").as_uri() in found["report"]
    row = {"metric": "planning/N=32/causal/success", "verdict": "worse by 0.200", "mean": 0.75, "95 % from": 0.5, "to": 1.0,
           "trajectories": 9}  # fmt: skip
    assert json.loads(found["metrics"]) == [{"metric": "video/gone", "verdict": "missing"}, row]
    assert "2 of 2 metrics became worse or are missing" in described["metrics"]
    assert "recorded episodes" in described["picture"]
    for key, picture in zip(("picture", "picture-1"), pictures, strict=True):
        # A browser shows it wherever the page comes from: the picture itself is in its address.
        with urllib.request.urlopen(found[key]) as reply:
            assert (reply.headers["Content-type"], reply.read()) == ("image/jpeg", picture.read_bytes())


FEW = """
extends: smoke
curate:
  sources: [{kind: episode_set, path: artifacts/shipped/recordings, include: ["viperx_pearl-train-s1-0000[12]"]}]
curate_banks:
  sources: [{kind: episode_set, path: artifacts/shipped/banks, include: [bank_lift_viperx-000]}]
"""


@pytest.mark.slow
def test_the_page_shows_the_error_that_ended_the_run(storage: Path, two_calls: Callable[..., None]) -> None:
    with pytest.raises(DataError, match="This task cannot work"):
        run(storage, two_calls, "broken", page=True)
    text = (storage / "report" / "latest" / "index.html").read_text()
    assert all(fact in text for fact in ("This task cannot work", "one"))


@pytest.mark.slow
def test_steps_side_by_side_give_the_artifacts_of_one_process(
    storage: Path, tmp_path: Path, project_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(project_root)
    (tmp_path / "few.yaml").write_text(FEW)
    settings = PipelineConfig.load(None, tmp_path / "few.yaml")

    def chain() -> None:
        prepare(settings)

    @flow(name=tmp_path.name)
    def side_by_side(at_once: int) -> dict[str, ArtifactReference]:
        with PrefectRun(tmp_path / f"store{at_once}", RunnerConfig(steps_at_once=at_once), outline(chain)) as run:
            chain()
        return run.artifacts

    one, two = ({name: made.digest for name, made in side_by_side(n).items()} for n in (1, 2))
    assert set(one) == {"curate", "filter", "render_actions", "curate.banks", "render_actions.banks"}
    assert one == two
    page = (tmp_path / "store2" / "report" / "latest" / "index.html").read_text()
    assert all(name in page for name in one)
    runs = task_runs(tmp_path.name, 10)
    names = {run.id: run.name for run in runs}
    for run in runs:
        sources = {names[source.model_dump()["id"]] for found in run.task_inputs.values() for source in found}
        expected = {"filter": {"curate"}, "render_actions": {"filter"}, "render_actions.banks": {"curate.banks"}}
        assert sources == expected.get(run.name, set()), run.name


@pytest.mark.slow
def test_tasks_that_wait_do_not_keep_back_what_can_start(prefect_server: None, tmp_path: Path) -> None:
    """Two workers, one of them busy, and more tasks waiting for it than there are workers."""
    file = tmp_path / "made"
    until_made = f"for i in $(seq 400); do test -e '{file}' && exit; sleep 0.05; done; exit 1"

    @flow(name=tmp_path.name)
    def some_tasks() -> None:
        with shared_server(), process_runner(2) as runner:
            busy = runner.submit(Task(fn=subprocess.getstatusoutput), {"cmd": until_made})
            waiting = [runner.submit(Task(fn=Path.exists), {"self": file}, wait_for=[busy]) for _ in range(3)]
            made = runner.submit(Task(fn=Path.touch), {"self": file})
            assert [future.result() for future in (busy, made, *waiting)] == [(0, ""), None, True, True, True]

    some_tasks()


@pytest.mark.slow
def test_prefect_draws_the_chain_of_the_pipeline(
    storage: Path, tmp_path: Path, project_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every task run of the real flow, and what it waits for; the work itself is left out."""
    monkeypatch.chdir(project_root)

    def work(_config: StrictModel, _inputs: Mapping[str, Path], output: Path, **_: object) -> dict[str, object]:
        (output / "made").write_text("")
        return {}

    monkeypatch.setattr(ArtifactTask, "load_function", lambda _: work)
    monkeypatch.setattr(memory_estimate, "require_memory", lambda *_: None)
    calls = outline(pipeline_chain, PipelineConfig.load("smoke"))
    pipeline.with_options(name=tmp_path.name)("smoke", None, (), tmp_path / "store")
    runs = task_runs(tmp_path.name, len(calls))
    names = {run.id: run.name for run in runs}
    drawn = {
        run.name: {names[source.model_dump()["id"]] for found in run.task_inputs.values() for source in found}
        for run in runs
    }
    assert drawn == {name: {source.name for source in call.upstream} for name, call in calls.items()}
    steps = (project_root / "README.md").read_text().partition("sources ")[2].partition("```")[0]
    in_readme = {step for step in re.findall(r"[a-z]\w+", steps) if step in task_names()}
    assert in_readme == {call.task.name for call in calls.values()} & in_readme
    assert len(in_readme) == 12


def task_runs(flow_name: str, count: int, states: dict[str, str] | None = None) -> list[Any]:
    """Task runs of a flow, the last ones in these states; they reach the server as events, later."""
    deadline = time.monotonic() + 60
    flows = FlowFilter(name=FlowFilterName(any_=[flow_name]))
    with get_client(sync_client=True) as client:
        while True:
            found: list[Any] = client.read_task_runs(flow_filter=flows, sort=TaskRunSort.EXPECTED_START_TIME_ASC)
            last = {run.name: str(run.state.name) for run in found if run.state is not None}
            if len(found) >= count and states in (None, last):
                return found
            assert time.monotonic() < deadline, last
            time.sleep(0.2)


@pytest.mark.slow
def test_prefect_shows_what_the_store_has(storage: Path, two_calls: Callable[..., None]) -> None:
    def shown(*states: str) -> None:
        task_runs(storage.parent.name, 2, dict(zip(("one", "two"), states, strict=True)))

    done = run(storage, two_calls)
    shown("Completed", "Completed")
    assert run(storage, two_calls) == done
    shown("Cached", "Cached")
    changed = run(storage, two_calls, "c")
    assert (changed["one"], (changed["two"].path / "text").read_text()) == (done["one"], "ac")
    shown("Cached", "Completed")
    shutil.rmtree(done["one"].path)
    assert run(storage, two_calls) == done
    assert (done["one"].path / "text").read_text() == "a"
    shown("Completed", "Cached")


class Trap:
    """Runs code when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


def _records(trap: Path, elsewhere: Path) -> dict[str, Callable[[dict[str, Any]], dict[str, Any]]]:
    """Contents that may have been written in the place of a record."""
    pickled = base64.b64encode(pickle.dumps(Trap(trap))).decode()
    lie = json.dumps({"step": "write_one", "path": str(elsewhere), "digest": "0" * 64})

    def change(result: str | None = None, **serializer: Any) -> Callable[[dict[str, Any]], dict[str, Any]]:
        return lambda record: {
            "metadata": record["metadata"] | {"serializer": record["metadata"]["serializer"] | serializer},
            "result": record["result"] if result is None else result,
        }

    return {
        "pickle": lambda r: {"metadata": r["metadata"] | {"serializer": {"type": "pickle"}}, "result": pickled},
        "a decoder": change(object_decoder="trap_door.anything"), "another place": change(lie), "no record": lambda r: {},
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pickle", "a decoder", "another place", "no record", "a folder"])
def test_prefects_records_are_not_believed(
    storage: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, two_calls: Callable[..., None]
) -> None:
    (tmp_path / "trap_door.py").write_text(f"open({str(tmp_path / 'trap')!r}, 'w')")
    monkeypatch.syspath_prepend(tmp_path)
    done = run(storage, two_calls)
    change = _records(tmp_path / "trap", tmp_path / "elsewhere").get(kind)
    for path in (tmp_path / "prefect").iterdir():
        record = json.loads(path.read_text())
        path.unlink()
        path.mkdir() if change is None else path.write_text(json.dumps(change(record)))
    assert run(storage, two_calls) == done
    assert not (tmp_path / "trap").exists()
