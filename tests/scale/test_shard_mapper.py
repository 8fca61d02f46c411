"""What becomes of episodes that fail, flicker or kill their worker, with each of the runners."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from copy import copy
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from number_work import NumberFileWork, NumberWork, attempts, do_numbers

from tasks.execution.shard_mapper import shard_mapper
from worldline_core.errors import DataError
from worldline_core.scale.mapping import (
    Outcome,
    RunnerConfig,
    SerialMapper,
    Shard,
    WorkerDiedError,
    do_shard,
    map_episodes,
)
from worldline_core.store.remote import UnreachableInputError


def run(folder: Path, values: Sequence[int], size: int, kind: str, **settings: Any) -> None:
    config = RunnerConfig.model_validate({"kind": kind, "workers": 2, "retry_seconds": 0.1, **settings})
    do_numbers(shard_mapper(config), folder, values, size)


def results(folder: Path) -> dict[int, int]:
    texts = {int(path.name): path.read_text() for path in folder.iterdir() if path.name.isdigit()}
    return {value: int(text) for value, text in texts.items() if text.isdigit()}


def crashed(folder: Path) -> dict[int, str]:
    texts = {int(path.name): path.read_text() for path in folder.iterdir() if path.name.isdigit()}
    return {value: text for value, text in texts.items() if not text.isdigit()}


def processes(folder: Path) -> set[str]:
    return {line.split()[1] for line in (folder / "log.txt").read_text().splitlines()}


SEVEN = "Squaring ended with ZeroDivisionError: seven"
THIRTEEN = "Squaring this episode alone ended its process, twice"


@pytest.mark.slow
@pytest.mark.usefixtures("prefect_server")
@pytest.mark.parametrize("kind", ["processes", "dask", "ray"])
def test_bad_episodes_and_dying_workers_cost_an_episode_each(tmp_path: Path, kind: str) -> None:
    # Asked without importing: what Ray reads at its import is set by the mapper.
    if kind in ("dask", "ray") and find_spec(f"prefect_{kind}") is None:
        pytest.skip(f"prefect_{kind} is not installed")
    # 5 flickers, 7 fails, 3 is never reached, 13 kills its worker.
    values = (4, 5, 7, 12, 13, 14, 15, 3, 6)
    with pytest.raises(UnreachableInputError, match="1 of 3 shards could not read all of their inputs"):
        run(tmp_path, values, 3, kind, workers=1)
    assert crashed(tmp_path) == {7: SEVEN, 13: THIRTEEN}
    assert results(tmp_path) == {value: value**2 for value in values if value not in (3, 7, 13)}
    assert attempts(tmp_path, 5) == 3  # retried: it passes
    # Bad data is not retried. A dying worker may take along the shard (a pool ends as a whole).
    assert attempts(tmp_path, 7) in {"processes": (1, 2), "dask": (1, 2), "ray": (1,)}[kind]
    assert attempts(tmp_path, 13) == 2
    assert str(os.getpid()) not in processes(tmp_path)


class ForkingMapper:
    """Does each shard in a process of its own, forked: what kills one is seen, and costs no second to start."""

    episodes_per_shard = 4

    def run(self, shards: Sequence[Shard[Any]], *, one_at_a_time: bool = False) -> Iterator[Outcome]:
        for shard in shards:
            if not (process := os.fork()):
                status = 1
                try:
                    do_shard(shard)
                    status = 0
                finally:
                    os._exit(status)
            _, status = os.waitpid(process, 0)
            yield shard, WorkerDiedError("A worker ended without an answer") if status else None


def test_a_shard_with_one_file_is_made_again_without_the_episode_that_kills(tmp_path: Path) -> None:
    map_episodes(ForkingMapper(), NumberFileWork(tmp_path), [[8, 9], [12, 13, 14]])
    assert (tmp_path / "shard-0.txt").read_text() == "8:kept 9:kept"
    assert (tmp_path / "shard-1.txt").read_text() == "12:kept 13:quarantined 14:kept"
    assert attempts(tmp_path, 13) == 2


def test_in_this_process_an_unforeseen_error_costs_one_episode(tmp_path: Path) -> None:
    run(tmp_path, range(4, 12), 4, "serial")
    assert crashed(tmp_path) == {7: SEVEN}
    assert results(tmp_path) == {value: value**2 for value in (4, 5, 6, 8, 9, 10, 11)}
    assert (attempts(tmp_path, 5), attempts(tmp_path, 7)) == (3, 1)
    assert processes(tmp_path) == {str(os.getpid())}


def test_an_unreachable_input_is_said_after_all_else_is_done(tmp_path: Path) -> None:
    with pytest.raises(UnreachableInputError, match="1 of 3 shards could not read all of their inputs"):
        run(tmp_path, [0, 1, 2, 3, 4, 6, 8, 9, 10], 3, "serial")
    assert results(tmp_path) == {value: value**2 for value in (0, 1, 2, 4, 6, 8, 9, 10)}
    assert attempts(tmp_path, 3) == 3


def test_few_episodes_stay_in_this_process(tmp_path: Path) -> None:
    run(tmp_path, range(8, 12), 2, "auto", serial_below=5)
    assert processes(tmp_path) == {str(os.getpid())}


def test_workers_get_what_a_step_states_and_not_what_it_opened(tmp_path: Path) -> None:
    work = NumberWork(tmp_path)
    object.__setattr__(work, "opened", object())  # as a cached property leaves it
    sent = copy(work)  # by the same protocol as pickle
    assert sent == work
    assert "opened" not in vars(sent)


def test_a_shard_that_cannot_be_finished_is_an_error(tmp_path: Path) -> None:
    class Unfinished(NumberWork):
        def remaining(self, number: int, episodes: Sequence[int]) -> list[int]:
            return list(episodes)

        def finish_shard(self, number: int, results: Sequence[Any]) -> None:
            raise ZeroDivisionError("no end")

    with pytest.raises(DataError, match=r"Some episodes could not be processed[\s\S]*numbers shard 0"):
        map_episodes(SerialMapper(), Unfinished(tmp_path), [[8, 9]])
