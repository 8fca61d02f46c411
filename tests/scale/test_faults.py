"""What is tried again, what ends a run, and that nothing is lost from the account."""

from __future__ import annotations

import errno
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import pytest
from safetensors import SafetensorError

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.errors import ConfigError, DataError, UnavailableError
from worldline_core.scale.account import InputRow, check_account, read_account, write_account, write_shard_account
from worldline_core.scale.mapping import ends_the_run
from worldline_core.store import remote as transient
from worldline_core.store.remote import UnreachableInputError, is_transient, with_retries


class ClientError(Exception):
    """As botocore's: the status is in the response."""

    def __init__(self, status: int) -> None:
        super().__init__(f"status {status}")
        self.response = {"ResponseMetadata": {"HTTPStatusCode": status}}


class ClientPayloadError(Exception):
    __module__ = "aiohttp.client_exceptions"


@pytest.mark.parametrize(
    "error",
    [
        ConnectionResetError(), TimeoutError(), OSError(errno.EIO, "I/O error"), OSError(errno.ESTALE, "stale"), ClientError(503),
        ClientError(429), ClientPayloadError("cut"), UnreachableInputError("away"),
    ],
)  # fmt: skip
def test_what_passes_is_tried_again_and_ends_no_run(error: Exception) -> None:
    assert is_transient(error)
    assert not ends_the_run(error)


@pytest.mark.parametrize(
    ("error", "ends"),
    [
        (ClientError(404), False), (ClientError(403), False), (FileNotFoundError(errno.ENOENT, "none"), False),
        (PermissionError(errno.EACCES, "no"), False), (RejectedInputError("truncated_video", "cut"), False),
        (OSError("file signature not found"), False),  # h5py, of a damaged file
        (DataError("bad"), False), (MemoryError(), False), (ConfigError("wrong"), True), (UnavailableError("h5py"), True),
        *((OSError(number, "full"), True) for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)),
        (SafetensorError("I/O error: No space left on device (os error 28)"), True),
        (DataError("a text with (os error 28)"), False),
    ],
)  # fmt: skip
def test_bad_data_is_not_tried_again_and_what_every_episode_would_meet_ends_the_run(
    error: Exception, ends: bool
) -> None:
    assert not is_transient(error)
    assert ends_the_run(error) is ends


def test_a_readers_own_words_do_not_hide_the_network() -> None:
    def read() -> None:
        try:
            raise OSError(errno.ESTALE, "stale file handle")
        except OSError as error:
            raise RejectedInputError("unreadable", "Parquet file cannot be read") from error

    with pytest.raises(RejectedInputError, match="Parquet file cannot be read") as caught:
        read()
    assert is_transient(caught.value)


def test_attempts_are_counted_and_bad_data_gets_one(monkeypatch: pytest.MonkeyPatch) -> None:
    waited: list[float] = []
    monkeypatch.setattr(transient.time, "sleep", waited.append)
    calls: list[str] = []

    def fails(error: Exception, times: int) -> Any:
        def action() -> str:
            calls.append("call")
            if len(calls) <= times:
                raise error
            return "read"

        return action

    assert with_retries(fails(ConnectionResetError(), 3), "a file") == "read"
    assert waited == [0.2, 0.4, 0.8]
    calls.clear()
    with pytest.raises(UnreachableInputError, match="A store could not be reached"):
        with_retries(fails(ConnectionResetError(), 99), "a file")
    assert len(calls) == 1 + len(transient.PAUSES)
    calls.clear()
    with pytest.raises(ValueError, match="bad"):
        with_retries(fails(ValueError("bad"), 99), "a file")
    assert len(calls) == 1


def rows(*statuses: Literal["kept", "quarantined"]) -> list[InputRow]:
    return [
        InputRow(
            episode_id=f"e{n}",
            source="s",
            status=status,
            reason=None if status == "kept" else "too_short",
            stored_bytes=10,
            seconds=0.5,
        )
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
    from flows.pipeline import chain
    from tasks.execution.chain import outline
    from worldline_core.pipeline.pipeline_config import PipelineConfig

    configs = [PipelineConfig.load("tiny", None, changed) for changed in ((), ("runner.kind=dask", "runner.workers=3"))]
    plain, dask = (outline(chain, config) for config in configs)
    assert {name: call.config for name, call in plain.items()} == {name: call.config for name, call in dask.items()}
