"""Episodes that fail, flicker or kill their worker are tried again or quarantined, and all are accounted for."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import replace
from importlib.util import find_spec
from itertools import batched
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import pytest
from number_work import NumberFileWork, NumberWork, attempts
from safetensors import SafetensorError

from flows.pipeline import chain
from tasks.execution.chain import outline
from tasks.execution.shard_mapper import shard_mapper
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.errors import ConfigError, DataError, UnavailableError
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.scale.account import InputRow, check_account, read_account, write_account, write_shard_account
from worldline_core.scale.mapping import (
    Outcome,
    RunnerConfig,
    SerialMapper,
    Shard,
    WorkerDiedError,
    do_shard,
    ends_the_run,
    map_episodes,
)
from worldline_core.store.remote import UnreachableInputError, is_transient


def run(folder: Path, values: Sequence[int], size: int, kind: str, **settings: Any) -> None:
    config = RunnerConfig.model_validate({"kind": kind, "workers": 2, "retry_seconds": 0.1, **settings})
    map_episodes(shard_mapper(config), NumberWork(folder), list(batched(values, size)))


def results(folder: Path) -> dict[int, int | str]:
    texts = {int(path.name): path.read_text() for path in folder.iterdir() if path.name.isdigit()}
    return {value: int(text) if text.isdigit() else text for value, text in texts.items()}


def squares(*values: int) -> dict[int, int | str]:
    return {value: value**2 for value in values}


def processes(folder: Path) -> set[str]:
    return {line.split()[1] for line in (folder / "log.txt").read_text().splitlines()}


SEVEN = {7: "Squaring ended with ZeroDivisionError: seven"}
THIRTEEN = {13: "Squaring this episode alone ended its process, twice"}


@pytest.mark.slow
@pytest.mark.usefixtures("prefect_server")
@pytest.mark.parametrize("kind", ["processes", "dask", "ray"])
def test_bad_episodes_and_dying_workers_cost_an_episode_each(tmp_path: Path, kind: str) -> None:
    # Asked without importing: what Ray reads at its import is set by the mapper.
    if kind in ("dask", "ray") and find_spec(f"prefect_{kind}") is None:
        pytest.skip(f"prefect_{kind} is not installed")
    # 5 flickers, 7 fails, 3 is never reached, 13 kills its worker.
    with pytest.raises(UnreachableInputError, match="1 of 3 shards could not read all of their inputs"):
        run(tmp_path, (4, 5, 7, 12, 13, 14, 15, 3, 6), 3, kind, workers=1)
    assert results(tmp_path) == squares(4, 5, 12, 14, 15, 6) | SEVEN | THIRTEEN
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


@pytest.mark.slow
def test_a_shard_with_one_file_is_made_again_without_the_episode_that_kills(tmp_path: Path) -> None:
    map_episodes(ForkingMapper(), NumberFileWork(tmp_path), [[8, 9], [12, 13, 14]])
    assert (tmp_path / "-1").read_text() == "8:kept 9:kept"
    assert (tmp_path / "-2").read_text() == "12:kept 13:quarantined 14:kept"
    assert attempts(tmp_path, 13) == 2


@pytest.mark.parametrize("settings", [{"kind": "serial"}, {"kind": "auto", "serial_below": 20}])
def test_in_this_process_errors_cost_an_episode_and_an_unreachable_one_is_said_after_all_else_is_done(
    tmp_path: Path, settings: dict[str, Any]
) -> None:
    with pytest.raises(UnreachableInputError, match="1 of 3 shards could not read all of their inputs"):
        run(tmp_path, range(3, 12), 3, **settings)
    assert results(tmp_path) == squares(4, 5, 6, 8, 9, 10, 11) | SEVEN
    assert [attempts(tmp_path, value) for value in (3, 5, 7)] == [3, 3, 1]
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


class ClientError(Exception):
    """As the hub's: the status is in the response."""

    def __init__(self, status: int) -> None:
        super().__init__(f"status {status}")
        self.response = SimpleNamespace(status_code=status)


class ClientPayloadError(Exception):
    __module__ = "aiohttp.client_exceptions"


# A reader's own words do not hide the network.
UNREADABLE = RejectedInputError("unreadable", "Parquet file cannot be read")
UNREADABLE.__cause__ = OSError(errno.ESTALE, "stale file handle")
PASSING = [
    UNREADABLE, ConnectionResetError(), TimeoutError(), OSError(errno.EIO, "I/O error"), OSError(errno.ESTALE, "stale"), ClientError(503),
    ClientError(429), ClientPayloadError("cut"), UnreachableInputError("away"),
]  # fmt: skip
BAD_DATA = [
    ClientError(404), ClientError(403), FileNotFoundError(errno.ENOENT, "none"), PermissionError(errno.EACCES, "no"),
    RejectedInputError("truncated_video", "cut"), OSError("file signature not found"),  # h5py, of a damaged file
    DataError("bad"), MemoryError(), DataError("a text with (os error 28)"),
]  # fmt: skip
OF_EVERY_EPISODE = [
    ConfigError("wrong"), UnavailableError("h5py"), SafetensorError("I/O error: No space left on device (os error 28)"),
    *(OSError(number, "full") for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)),
]  # fmt: skip


@pytest.mark.parametrize(
    ("error", "passes", "ends"),
    [
        *((error, True, False) for error in PASSING),
        *((error, False, False) for error in BAD_DATA),
        *((error, False, True) for error in OF_EVERY_EPISODE),
    ],
)
def test_what_passes_is_tried_again_and_what_every_episode_would_meet_ends_the_run(
    error: Exception, passes: bool, ends: bool
) -> None:
    assert (is_transient(error), ends_the_run(error)) == (passes, ends)


def rows(*statuses: Literal["kept", "quarantined"]) -> list[InputRow]:
    reasons = {"kept": None, "quarantined": "too_short"}
    return [
        InputRow(episode_id=f"e{n}", source="s", status=status, reason=reasons[status], stored_bytes=10, seconds=0.5)
        for n, status in enumerate(statuses)
    ]


def test_the_account_is_complete_or_an_error(tmp_path: Path) -> None:
    whole = rows("kept", "quarantined", "kept")
    write_account(tmp_path, whole)
    check_account(tmp_path, 3, {"e0", "e2"}, {"e1"})
    for found, kept, quarantined, account in (
        (4, {"e0", "e2"}, {"e1"}, whole),  # an input in no row
        (3, {"e0"}, {"e1"}, whole),  # kept by the account, not in the index
        (3, {"e0", "e2"}, {"e1"}, whole[:2]),
        (3, {"e0", "e1"}, {"e2"}, whole),  # the other way round
        (3, {"e0", "e2"}, {"e1"}, [*whole[:2], whole[0]]),  # one twice
    ):
        write_account(tmp_path, account)
        with pytest.raises(DataError, match="Inputs were lost"):
            check_account(tmp_path, found, kept, quarantined)


def test_shards_are_merged_and_the_row_with_the_work_counts(tmp_path: Path) -> None:
    first, second = rows("kept", "quarantined")
    unknown = replace(first, seconds=None)
    write_shard_account(tmp_path, 0, [unknown, second])
    write_shard_account(tmp_path, 1, [first])
    write_account(tmp_path, [unknown, replace(second, seconds=None)])
    assert read_account(tmp_path) == [first, second]
    written = list(tmp_path.rglob("*.parquet"))
    assert len(written) == 3
    assert all(path.relative_to(tmp_path).parts[0] == "run" for path in written)


def test_the_runner_is_no_part_of_a_key() -> None:
    configs = [PipelineConfig.load("tiny", None, changed) for changed in ((), ("runner.kind=dask", "runner.workers=3"))]
    plain, dask = ({name: call.config for name, call in outline(chain, config).items()} for config in configs)
    assert plain == dask
