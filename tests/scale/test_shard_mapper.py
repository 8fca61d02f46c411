"""What becomes of jobs that fail, flicker or kill their worker, with each of the runners."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from scale_jobs import NumbersJob, attempts, jobs_of, write_numbers

from tasks.shard_mapper import shard_mapper
from worldline_core.errors import UnavailableError
from worldline_core.scale.mapping import Job, RunnerConfig, run_jobs
from worldline_core.store.remote import UnreachableInputError

pytestmark = pytest.mark.usefixtures("prefect_server")


class Record:
    """Takes what `run_jobs` reports."""

    def __init__(self) -> None:
        self.done = 0
        self.crashed: dict[int, str] = {}

    def add(self, count: int) -> None:
        self.done += count

    def crash(self, job: NumbersJob, error: Exception) -> None:
        (value,) = job.values
        self.crashed[value] = type(error).__name__


def run(folder: Path, jobs: list[Any], kind: str, **settings: Any) -> Record:
    record = Record()
    config = RunnerConfig.model_validate({"kind": kind, "workers": 2, "retry_seconds": 0.1, **settings})
    run_jobs(shard_mapper(config), write_numbers, jobs, done=record.add, crashed=record.crash)
    return record


def results(folder: Path) -> dict[int, int]:
    return {int(path.name): int(path.read_text()) for path in folder.iterdir() if path.name.isdigit()}


def processes(folder: Path) -> set[str]:
    return {line.split()[1] for line in (folder / "log.txt").read_text().splitlines()}


SLOW = [pytest.param(kind, marks=pytest.mark.slow) for kind in ("dask", "ray")]


@pytest.mark.parametrize("kind", ["processes", *SLOW])
def test_bad_episodes_and_dying_workers_cost_an_episode_each(tmp_path: Path, kind: str) -> None:
    # Asked without importing: what Ray reads at its import is set by the mapper.
    if kind in ("dask", "ray") and find_spec(f"prefect_{kind}") is None:
        pytest.skip(f"prefect_{kind} is not installed")
    record = run(tmp_path, jobs_of(tmp_path, range(4, 24), 4), kind)  # 5 flickers, 7 fails, 13 kills its worker
    assert record.crashed == {7: "ZeroDivisionError", 13: "WorkerDiedError"}
    assert results(tmp_path) == {value: value**2 for value in range(4, 24) if value not in (7, 13)}
    assert attempts(tmp_path, 5) == 3  # retried: it passes
    # In its shard and alone, which retries would make six: bad data is not retried. A dying worker may take along the shard
    # (a pool ends as a whole) or an answer that it gave before (Dask then does that shard again).
    assert attempts(tmp_path, 7) in {"processes": (1, 2), "dask": (2, 3), "ray": (2,)}[kind]
    assert attempts(tmp_path, 13) == 2
    assert str(os.getpid()) not in processes(tmp_path)


def test_in_this_process_an_unforeseen_error_costs_one_episode(tmp_path: Path) -> None:
    record = run(tmp_path, jobs_of(tmp_path, range(4, 12), 4), "serial")
    assert record.crashed == {7: "ZeroDivisionError"}
    assert results(tmp_path) == {value: value**2 for value in (4, 5, 6, 8, 9, 10, 11)}
    assert (attempts(tmp_path, 5), attempts(tmp_path, 7)) == (3, 2)
    assert processes(tmp_path) == {str(os.getpid())}


@pytest.mark.parametrize("kind", ["serial", "processes"])
def test_an_unreachable_input_is_said_after_all_else_is_done(tmp_path: Path, kind: str) -> None:
    with pytest.raises(UnreachableInputError, match="1 of 3 shards could not read all of their inputs"):
        run(tmp_path, jobs_of(tmp_path, [0, 1, 2, 3, 4, 6, 8, 9, 10], 3), kind)
    assert results(tmp_path) == {value: value**2 for value in (0, 1, 2, 8, 9, 10)}
    assert attempts(tmp_path, 3) == 3


def test_few_episodes_stay_in_this_process(tmp_path: Path) -> None:
    run(tmp_path, jobs_of(tmp_path, range(8, 12), 2), "auto", serial_below=5)
    assert processes(tmp_path) == {str(os.getpid())}


def test_a_bounded_number_of_shards_is_handed_out(tmp_path: Path) -> None:
    """Ten jobs wait as plain values; no more than `in_flight` are with the runner when one is answered."""
    begun_before_taken: list[int] = []
    config = RunnerConfig.model_validate({"kind": "processes", "workers": 1, "in_flight": 3})
    record = Record()

    def taken(count: int) -> None:
        begun_before_taken.append(len((tmp_path / "log.txt").read_text().splitlines()) - record.done)
        record.add(count)

    jobs = jobs_of(tmp_path, range(20, 40), 2)
    run_jobs(shard_mapper(config), write_numbers, jobs, done=taken, crashed=record.crash)
    assert len(results(tmp_path)) == record.done == 20
    assert max(begun_before_taken) <= 3 * 2


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "prefect_ray", None)
    with pytest.raises(UnavailableError, match="the extra `ray`"):
        run(tmp_path, jobs_of(tmp_path, range(8, 10), 1), "ray")


def test_jobs_satisfy_the_protocol(tmp_path: Path) -> None:
    job: Job = jobs_of(tmp_path, range(2), 2)[0]
    assert [len(single) for single in job.split()] == [1, 1]
