"""How work on many episodes is spread: jobs are data, and one function, importable by name, does a job anywhere.

A job (a shard) is a frozen dataclass of plain values that names some episodes. Its function keeps what it finishes on
disk, episode by episode, so doing a job again only does what is missing: that is what makes a retry, another size of
shards and a resumed run give the same result.

Where mapped work runs. It never changes a result, and is therefore no part of any cache key.

What is known about an episode whose processing ended in an unforeseen way, without this machine's paths.
"""

from __future__ import annotations

import errno
import logging
import re
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, Self

from pydantic import Field, model_validator

from worldline_core.config import StrictModel
from worldline_core.errors import ConfigError, UnavailableError, WorldLineError
from worldline_core.store.remote import UnreachableInputError, is_transient

logger = logging.getLogger(__name__)

DEFAULT_EPISODES_PER_SHARD = 16
DEFAULT_RETRIES = 2
DEFAULT_RETRY_SECONDS = 5.0
_MACHINE_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EMFILE, errno.ENFILE})


class WorkerDiedError(WorldLineError):
    """The process that did a job ended without an answer: a crash in compiled code, or killed for its memory."""


class Job(Protocol):
    """Some episodes to work on."""

    @property
    def label(self) -> str:
        """What the job is called where people look: the step and the number of the shard."""
        ...

    def __len__(self) -> int:
        """How many episodes it has."""
        ...

    def split(self) -> list[Self]:
        """One job an episode."""
        ...


@dataclass(frozen=True)
class Outcome[J, R]:
    """What became of a job: its result, or the error that ended it."""

    job: J
    result: R | None = None
    error: Exception | None = None


class ShardMapper(Protocol):
    """Does jobs somewhere, a bounded number at a time, and says what became of each."""

    @property
    def episodes_per_shard(self) -> int: ...

    def map[J: Job, R](
        self,
        function: Callable[[J], R],
        jobs: Sequence[J],
        take: Callable[[Outcome[J, R]], None],
        *,
        one_at_a_time: bool = False,
    ) -> None:
        """Do the jobs in any order.

        Args:
            function: a module's function, so that another process can import it.
            take: is given the outcome of each job, here, as they come; an error that it raises ends the work.
            one_at_a_time: no two jobs at once, so that a dying worker can only be the doing of the one job.
        """
        ...


class SerialMapper:
    """Does the jobs in this process, one after the other.

    Args:
        retries: further attempts at a job that could not reach its input, the first after `retry_seconds`.
    """

    def __init__(
        self,
        episodes_per_shard: int = DEFAULT_EPISODES_PER_SHARD,
        retries: int = DEFAULT_RETRIES,
        retry_seconds: float = DEFAULT_RETRY_SECONDS,
    ) -> None:
        self._episodes_per_shard = episodes_per_shard
        self._pauses = retry_pauses(retries, retry_seconds)

    @property
    def episodes_per_shard(self) -> int:
        return self._episodes_per_shard

    def map[J: Job, R](
        self,
        function: Callable[[J], R],
        jobs: Sequence[J],
        take: Callable[[Outcome[J, R]], None],
        *,
        one_at_a_time: bool = False,
    ) -> None:
        del one_at_a_time  # always
        for job in jobs:
            take(self._outcome(function, job))

    def _outcome[J: Job, R](self, function: Callable[[J], R], job: J) -> Outcome[J, R]:
        waiting = iter(self._pauses)
        while True:
            try:
                return Outcome(job, function(job))
            except Exception as error:  # noqa: BLE001 - handed to the caller, which knows what ends the run
                pause = next(waiting, None) if is_transient(error) else None
                if pause is None:
                    return Outcome(job, error=error)
                logger.warning("%s: %s; trying again in %.1f s", job.label, _first_line(error), pause)
                time.sleep(pause)


def retry_pauses(retries: int, first_seconds: float) -> list[float]:
    """Seconds before each further attempt at a shard, doubling."""
    return [first_seconds * 2**number for number in range(retries)]


def ends_the_run(error: BaseException) -> bool:
    """Whether every other job would fail as well, for a reason that the user must remove first."""
    if isinstance(error, UnreachableInputError):
        return False
    if isinstance(error, OSError) and error.errno in _MACHINE_FULL:
        return True
    return isinstance(error, ConfigError | UnavailableError)


def run_jobs[J: Job, R](
    mapper: ShardMapper,
    function: Callable[[J], R],
    jobs: Sequence[J],
    *,
    done: Callable[[R], object],
    crashed: Callable[[J, Exception], None],
) -> None:
    """Do all jobs; one that fails does not keep the others from being done.

    A job that fails, or whose worker died, is done again episode by episode, one at a time: `crashed` is told the
    episodes that fail again.

    Args:
        done: is given each result.
        crashed: quarantines the one episode of a job.

    Raises: UnreachableInputError, after everything else is done, when inputs could not be read for a reason that
        passes; at once, what ends the run (a wrong configuration, a full disk).
    """
    suspects: list[J] = []
    unreachable: list[Exception] = []

    def taking(failed: Callable[[J, Exception], None]) -> Callable[[Outcome[J, R]], None]:
        def take(outcome: Outcome[J, R]) -> None:
            if outcome.error is None:
                done(outcome.result)  # type: ignore[arg-type]
            elif ends_the_run(outcome.error):
                raise outcome.error
            elif is_transient(outcome.error):
                unreachable.append(outcome.error)
            else:
                failed(outcome.job, outcome.error)

        return take

    def suspect(job: J, error: Exception) -> None:
        logger.warning("%s: %s; its episodes are done again one at a time", job.label, _first_line(error))
        suspects.append(job)

    mapper.map(function, jobs, taking(suspect))
    singles = [single for job in suspects for single in job.split()]
    if singles:
        mapper.map(function, singles, taking(crashed), one_at_a_time=True)
    if unreachable:
        raise UnreachableInputError(
            f"{len(unreachable)} of {len(jobs)} shards could not read all of their inputs; all else is done",
            got=_first_line(unreachable[0]),
            next_step="run the same command again when the store answers: only what is missing is read",
        ) from unreachable[0]


def _first_line(error: BaseException) -> str:
    lines = str(error).splitlines()
    return f"{type(error).__name__}: {lines[0] if lines else ''}"


def cut[T](items: Sequence[T], size: int) -> list[Sequence[T]]:
    """Consecutive pieces of `size`, the last one shorter."""
    return [items[start : start + size] for start in range(0, len(items), size)]


class RunnerConfig(StrictModel):
    """What does the work on many episodes.

    `auto` takes this process for few episodes, since starting others takes longer than the work, and processes for many.
    """

    kind: Literal["auto", "serial", "processes", "dask", "ray"] = "auto"
    workers: int | None = Field(default=None, ge=1, description="processes; null: one for each core of this machine")
    address: str | None = Field(
        default=None, description="scheduler of a Dask or Ray cluster; null: a cluster of its own on this machine"
    )
    episodes_per_shard: int = Field(default=DEFAULT_EPISODES_PER_SHARD, ge=1)
    in_flight: int | None = Field(default=None, ge=1, description="shards handed out at a time; null: two for a worker")
    serial_below: int = Field(default=256, ge=0, description="auto: fewer episodes than this are done in this process")
    retries: int = Field(
        default=DEFAULT_RETRIES, ge=0, description="further attempts at a shard that could not reach its input"
    )
    retry_seconds: float = Field(
        default=DEFAULT_RETRY_SECONDS, ge=0, description="pause before the first of them; doubles"
    )
    remote_cache_gb: float = Field(default=8.0, gt=0, description="room for copies of remote files, each worker")
    nodes_at_once: int = Field(
        default=1,
        ge=1,
        description="nodes of a run side by side, each in a process with its share of the cores; for runs on a CPU",
    )

    @model_validator(mode="after")
    def _address_is_of_a_cluster(self) -> RunnerConfig:
        if self.address is not None and self.kind not in ("dask", "ray"):
            raise ValueError(f"an address is that of a Dask or Ray cluster; the kind is {self.kind}")
        return self


_ADDRESS = re.compile(r"0x[0-9a-fA-F]{4,}")
_ABSOLUTE = re.compile(r"(?<![\w.:/])/(?:[^\s'\":,;()]+/)+")
_FRAMES = 5
_PACKAGE_ROOT = Path(__file__).parents[2]


def crash_evidence(error: BaseException) -> dict[str, Any]:
    """{"type", "message", "trace"}: the trace is the innermost frames as `file:line function`, innermost last."""
    frames = traceback.extract_tb(error.__traceback__)[-_FRAMES:]
    return {
        "type": type(error).__name__,
        "message": portable_message(str(error)),
        "trace": [f"{_short(frame.filename)}:{frame.lineno} {frame.name}" for frame in frames],
    }


def portable_message(text: str) -> str:
    """A message without addresses in memory and without folders: it must not differ from run to run."""
    return _ABSOLUTE.sub("", _ADDRESS.sub("0x…", text))


def _short(filename: str) -> str:
    """A file within its package."""
    path = Path(filename)
    if path.is_relative_to(_PACKAGE_ROOT) and "site-packages" not in path.parts:
        return path.relative_to(_PACKAGE_ROOT).as_posix()
    parts = path.parts
    if "site-packages" in parts:
        return "/".join(parts[parts.index("site-packages") + 1 :])
    return path.name
