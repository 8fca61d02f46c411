"""Prefect's cache and the artifact store agree: cached, rebuilt after deletion, rerun after a change."""

from __future__ import annotations

import base64
import json
import pickle
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from prefect import flow
from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import FlowFilter, FlowFilterName
from prefect.client.schemas.sorting import TaskRunSort
from prefect.settings import PREFECT_LOCAL_STORAGE_PATH, temporary_settings

from tasks.execution.artifact_task import ArtifactTask
from tasks.execution.prefect_run import ArtifactReference, PrefectRun
from worldline_core.scale.mapping import RunnerConfig


def _run(
    root: Path, tasks: tuple[ArtifactTask, ArtifactTask], first: str, second: str
) -> tuple[ArtifactReference, ArtifactReference]:
    @flow
    def two_steps() -> dict[str, ArtifactReference]:
        with PrefectRun(root, RunnerConfig()) as run:
            one = tasks[0].submit(tasks[0].load_config()(text=first), "one")
            tasks[1].submit(tasks[1].load_config()(text=second), "two", before=one)
        return run.artifacts

    made = two_steps()
    return made["one"], made["two"]


@pytest.fixture
def writers(declare: Any) -> tuple[ArtifactTask, ArtifactTask]:
    return declare("write_one"), declare("write_two", "before")


def _last_states() -> dict[str, str]:
    with get_client(sync_client=True) as client:
        runs = client.read_task_runs(
            flow_filter=FlowFilter(name=FlowFilterName(any_=["two-steps"])), sort=TaskRunSort.EXPECTED_START_TIME_ASC
        )
    return {run.name: str(run.state.name) for run in runs if run.state is not None}


def _shown(expected: dict[str, str]) -> dict[str, str]:
    """What Prefect shows, once it has what is expected or half a minute has passed: states reach it as events, later."""
    deadline = time.monotonic() + 30
    while (states := _last_states()) != expected and time.monotonic() < deadline:
        time.sleep(0.2)
    return states


@pytest.mark.slow
def test_prefect_shows_what_the_store_has(
    prefect_server: None, tmp_path: Path, writers: tuple[ArtifactTask, ArtifactTask]
) -> None:
    with temporary_settings({PREFECT_LOCAL_STORAGE_PATH: tmp_path / "prefect"}):
        one, two = _run(tmp_path, writers, "a", "b")
        assert (two.path / "text").read_text() == "ab"
        assert _shown(expected := {"one": "Completed", "two": "Completed"}) == expected

        assert _run(tmp_path, writers, "a", "b") == (one, two)
        assert _shown(expected := {"one": "Cached", "two": "Cached"}) == expected

        changed_one, changed_two = _run(tmp_path, writers, "a", "c")
        assert (changed_one, (changed_two.path / "text").read_text()) == (one, "ac")
        assert _shown(expected := {"one": "Cached", "two": "Completed"}) == expected

        shutil.rmtree(one.path)
        assert _run(tmp_path, writers, "a", "b") == (one, two)
        assert (one.path / "text").read_text() == "a"
        assert _shown(expected := {"one": "Completed", "two": "Cached"}) == expected


class Trap:
    """Runs code when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


def _records(trap: Path, elsewhere: Path) -> dict[str, Callable[[dict[str, Any]], dict[str, Any]]]:
    """What somebody may have written in the place of a record."""
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
@pytest.mark.parametrize("kind", ["pickle", "a decoder", "another place", "no record"])
def test_prefects_records_are_not_believed(
    prefect_server: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
    writers: tuple[ArtifactTask, ArtifactTask],
) -> None:
    (tmp_path / "trap_door.py").write_text(f"open({str(tmp_path / 'trap')!r}, 'w')")
    monkeypatch.syspath_prepend(tmp_path)
    with temporary_settings({PREFECT_LOCAL_STORAGE_PATH: tmp_path / "prefect"}):
        one, two = _run(tmp_path, writers, "a", "b")
        change = _records(tmp_path / "trap", tmp_path / "elsewhere").get(kind)
        for path in (tmp_path / "prefect").iterdir():
            record = json.loads(path.read_text())
            path.unlink()
            path.mkdir() if change is None else path.write_text(json.dumps(change(record)))
        assert _run(tmp_path, writers, "a", "b") == (one, two)
    assert not (tmp_path / "trap").exists()
