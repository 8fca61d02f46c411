"""Processes many episodes in shards, in any process or on any machine that sees the same folders.

A step says what it does with one episode (`EpisodeWork`); this module does the rest for all steps: which episodes are left,
retries, crashes, dead workers, and the record of what was done. An episode's result (or a shard's) appears on disk whole or not
at all, so running a shard again only adds what is missing: a retry, another shard size and a resumed run give the same result.
Where the work runs never changes a result and is part of no cache key.
"""

from __future__ import annotations

import errno
import logging
import time
import uuid
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol

from pydantic import Field, model_validator

from worldline_core.config import StrictModel
from worldline_core.errors import ArtifactError, ConfigError, DataError, UnavailableError, WorldLineError
from worldline_core.progress import Progress
from worldline_core.scale.account import InputRow, crash_evidence, portable_message, write_shard_account
from worldline_core.store.artifact_files import VerifyMode
from worldline_core.store.remote import UnreachableInputError, first_line, is_transient
from worldline_core.store.store import clear_store_errors, disk_full

logger = logging.getLogger(__name__)

_MACHINE_UNUSABLE = frozenset({errno.EROFS, errno.EMFILE, errno.ENFILE})


class WorkerDiedError(WorldLineError):
    """The worker process of a shard ended without an answer: it crashed in compiled code or was killed for its memory."""


@dataclass(frozen=True)
class EpisodeWork[E, R: InputRow](ABC):
    """Work of one step on its episodes; E names an episode (a hashable plain value), R is its result.

    Subclasses are frozen dataclasses. Their fields are sent to the workers; what they open (`cached_property`) is
    opened in each process once per run.

    Attributes:
        output: the step's folder.
        run: names one call of the step, so that what one call opened does not serve the next.
    """

    step: ClassVar[str]
    doing: ClassVar[str]
    """First words of a crash message: "Filtering" of "Filtering ended with ..."."""

    output: Path
    run: str = field(default_factory=lambda: uuid.uuid4().hex, kw_only=True)

    def __getstate__(self) -> dict[str, Any]:
        return {own.name: getattr(self, own.name) for own in fields(self)}

    @property
    def processes(self) -> int | None:
        """Processes of a machine that can do this at once, one for each device; None: as many as it has cores."""
        return None

    @abstractmethod
    def remaining(self, number: int, episodes: Sequence[E]) -> Sequence[E]:
        """The episodes of shard `number` that are not done yet."""

    @abstractmethod
    def do(self, episode: E) -> R:
        """Process one episode: keep it or quarantine it.

        Raises: transient errors (`is_transient`) and those that end the run (`ends_the_run`); for any other error the caller
            quarantines the episode as crashed.
        """

    @abstractmethod
    def quarantine_crashed(self, episode: E, detail: str, evidence: Mapping[str, Any]) -> R:
        """Quarantine an episode whose processing ended in an unforeseen way."""

    def finish_shard(self, number: int, results: Sequence[R]) -> None:  # noqa: B027 - most steps have nothing to write
        """Write the files that belong to a shard as a whole, once all of its episodes are done. Nothing by default."""


@dataclass(frozen=True)
class Shard[E]:
    """Some episodes of a step: what a worker is given at a time.

    Attributes:
        alone: the shard is one episode that may have killed a worker, run by itself to find out; the shard that it came from
            is finished afterwards.
        crashed: evidence of the crash, by episode that killed its worker: these are quarantined, not processed.
    """

    work: EpisodeWork[E, Any]
    number: int
    episodes: tuple[E, ...]
    alone: bool = False
    crashed: Mapping[E, Mapping[str, Any]] = field(default_factory=dict[E, Mapping[str, Any]])

    @property
    def label(self) -> str:
        """Shown in logs and by Prefect."""
        return f"{self.work.step} shard {self.number}"

    def __len__(self) -> int:
        return len(self.episodes)


_current_work: dict[str, EpisodeWork[Any, Any]] = {}
"""The work of the present run by the run's name, at most one: all shards of a run share what it has opened."""


def do_shard(shard: Shard[Any]) -> None:
    """Process the episodes of a shard that are not done yet and record what became of them; runs in any process.

    Raises: UnreachableInputError when inputs of some episodes could not be read for a temporary reason (all others are done);
        errors that end the run.
    """
    if shard.work.run not in _current_work:
        _current_work.clear()
    work = _current_work.setdefault(shard.work.run, shard.work)
    results: list[InputRow] = []
    unreachable: list[Exception] = []
    todo = work.remaining(shard.number, shard.episodes)
    for episode in todo:
        clock = time.perf_counter()
        try:
            result = _do_episode(work, episode, shard.crashed.get(episode))
        except Exception as error:
            if not is_transient(error):
                raise
            unreachable.append(error)
            continue
        results.append(replace(result, seconds=time.perf_counter() - clock))
    if todo and not unreachable and not shard.alone:
        work.finish_shard(shard.number, results)
    if results:
        write_shard_account(work.output, shard.number, results)
    if unreachable:
        raise UnreachableInputError(
            f"{len(unreachable)} of {len(shard)} episodes could not be read",
            where=shard.label,
            got=str(unreachable[0]).splitlines()[0],
        ) from unreachable[0]


def _do_episode[E](work: EpisodeWork[E, Any], episode: E, crash: Mapping[str, Any] | None) -> InputRow:
    if crash is not None:
        return work.quarantine_crashed(episode, f"{work.doing} this episode alone ended its process, twice", crash)
    try:
        return work.do(episode)
    except Exception as error:
        if is_transient(error) or ends_the_run(error):
            raise
        detail = f"{work.doing} ended with {type(error).__name__}: {portable_message(str(error))}"
        return work.quarantine_crashed(episode, detail, crash_evidence(error))


@contextmanager
def reading_input(where: object) -> Iterator[None]:
    """Wraps the reading of an earlier step's output: an error there ends the run and never quarantines an episode.

    Raises: ArtifactError; transient errors and those that end the run pass unchanged.
    """
    try:
        yield
    except Exception as error:
        if is_transient(error) or ends_the_run(error):
            raise
        raise ArtifactError(
            "An input of this step is missing or damaged", where=where, got=f"{type(error).__name__}: {error}",
            next_step="worldline verify names the damaged artifact and how to rebuild it",
        ) from error  # fmt: skip


def ends_the_run(error: BaseException) -> bool:
    """Returns whether every other episode would fail as well until the user removes the cause (a full disk, a wrong setting)."""
    if isinstance(error, UnreachableInputError):
        return False
    if disk_full(error) or (isinstance(error, OSError) and error.errno in _MACHINE_UNUSABLE):
        return True
    return isinstance(error, ConfigError | UnavailableError | ArtifactError)


type Outcome = tuple[Shard[Any], Exception | None]
"""A shard, and the error that it ended with; None: it is done."""


class ShardMapper(Protocol):
    """Runs shards here, in processes or on a cluster, a bounded number at a time."""

    @property
    def episodes_per_shard(self) -> int: ...

    def run(self, shards: Sequence[Shard[Any]], *, one_at_a_time: bool = False) -> Iterator[Outcome]:
        """Call `try_shard` for each shard, and yield the outcomes.

        Args:
            one_at_a_time: never run two shards at once, nor in this process: shows which one kills its worker.
        """
        ...


def map_episodes[E](mapper: ShardMapper, work: EpisodeWork[E, Any], pieces: Sequence[Sequence[E]]) -> None:
    """Process all episodes, each of `pieces` as a shard. An episode that fails does not stop the others.

    When a shard fails or its worker dies, its episodes are run again one at a time; those that fail again are quarantined
    as crashed.

    Raises: UnreachableInputError, after everything else is done, when inputs could not be read for a temporary reason; at
        once, errors that end the run (a wrong configuration, a full disk).
    """
    shards = [Shard(work, number, tuple(piece)) for number, piece in enumerate(pieces)]
    unfinished = [shard for shard in shards if work.remaining(shard.number, shard.episodes)]
    unreachable: dict[int, Exception] = {}
    total = sum(map(len, shards))
    with Progress(work.step, total, "episode", done=total - sum(map(len, unfinished))) as progress:

        def failures(
            shards: Sequence[Shard[E]], *, one_at_a_time: bool = False
        ) -> Iterator[tuple[Shard[E], Exception]]:
            """Run shards; yields those that failed."""
            with closing(mapper.run(shards, one_at_a_time=one_at_a_time)) as outcomes:  # pyright: ignore[reportArgumentType]
                for shard, error in outcomes:
                    if error is None:
                        progress.advance(0 if shard.alone else len(shard))
                    elif ends_the_run(error):
                        raise error
                    elif is_transient(error):
                        unreachable[shard.number] = error
                    else:
                        yield shard, error

        try:
            suspects: list[Shard[E]] = []
            for shard, error in failures(unfinished):
                logger.warning("%s: %s; its episodes are done again one at a time", shard.label, first_line(error))
                suspects.append(shard)
            singles = [replace(shard, episodes=(one,), alone=True) for shard in suspects for one in shard.episodes]
            crashed = {s.episodes[0]: crash_evidence(error) for s, error in failures(singles, one_at_a_time=True)}
            again = [replace(s, crashed={e: crashed[e] for e in s.episodes if e in crashed}) for s in suspects]
            for shard, error in failures(again):
                raise DataError(
                    "Some episodes could not be processed",
                    where=shard.label,
                    got=first_line(error),
                    next_step="run the step again; if it fails again, check how much memory the machine has left",
                ) from error
        finally:
            _current_work.pop(work.run, None)
    if unreachable:
        first = next(iter(unreachable.values()))
        raise UnreachableInputError(
            f"{len(unreachable)} of {len(unfinished)} shards could not read all of their inputs; all else is done",
            got=first_line(first),
            next_step="run the same command again when the store answers: only what is missing is read",
        ) from first


class RunnerConfig(StrictModel):
    """Settings of the work on many episodes.

    `auto`: in this process for few episodes, because starting others would take longer than the work; else in several.
    """

    kind: Literal["auto", "serial", "processes", "dask", "ray"] = "auto"
    workers: int | None = Field(default=None, ge=1, description="processes; null: one per core of this machine")
    address: str | None = Field(
        default=None, description="scheduler of a Dask or Ray cluster; null: a cluster of its own on this machine"
    )
    episodes_per_shard: int = Field(default=16, ge=1)
    serial_below: int = Field(default=256, ge=0, description="auto: fewer episodes than this are done in this process")
    retries: int = Field(default=2, ge=0, description="further attempts at a shard that could not reach its input")
    retry_seconds: float = Field(default=5.0, ge=0, description="pause before the first of them; doubles")
    verify: VerifyMode = Field(
        default="full",
        description="how a step's inputs are compared with what was written. full: the digest of every file, once a process;"
        " fast: sizes, and the digests of files changed after their manifest; off",
    )
    steps_at_once: int = Field(
        default=1,
        ge=1,
        description="steps of a run side by side, each in a process with its share of the cores; for runs on a CPU, whose"
        " last bits depend on the number of threads",
    )

    @model_validator(mode="after")
    def _address_is_of_a_cluster(self) -> RunnerConfig:
        if self.address is not None and self.kind not in ("dask", "ray"):
            raise ValueError(f"an address is that of a Dask or Ray cluster; the kind is {self.kind}")
        return self

    @property
    def pauses(self) -> list[float]:
        """Seconds before each further attempt at a shard."""
        return [self.retry_seconds * 2**number for number in range(self.retries)]


def try_shard(shard: Shard[Any], pauses: Sequence[float]) -> Exception | None:
    """Do a shard, again after each of `pauses` seconds while its input cannot be reached; returns what it ends with."""
    for pause in (*pauses, None):
        try:
            with clear_store_errors(shard.work.output):
                do_shard(shard)
            break
        except Exception as error:  # noqa: BLE001 - returned to `map_episodes`, which decides whether it ends the run
            if pause is None or not is_transient(error):
                return error
            logger.warning("%s: %s; trying again in %.1f s", shard.label, first_line(error), pause)
            time.sleep(pause)
    return None


class SerialMapper:
    """Does the shards in this process, one after the other."""

    def __init__(self, config: RunnerConfig | None = None) -> None:
        self._config = config or RunnerConfig()
        self.episodes_per_shard = self._config.episodes_per_shard

    def run(self, shards: Sequence[Shard[Any]], *, one_at_a_time: bool = False) -> Iterator[Outcome]:
        del one_at_a_time  # always
        for shard in shards:
            yield shard, try_shard(shard, self._config.pauses)
