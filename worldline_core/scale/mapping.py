"""How work on many episodes is spread: jobs are data, and one function, importable by name, does a job anywhere.

A job (a shard) is a frozen dataclass of plain values that names some episodes. Its function keeps what it finishes on
disk, episode by episode, so doing a job again only does what is missing: that is what makes a retry, another size of
shards and a resumed run give the same result.
"""

from __future__ import annotations

import errno
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, Self

from worldline_core.errors import ConfigError, UnavailableError, WorldLineError
from worldline_core.scale.transient import UnreachableInputError, is_transient

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
