"""Shards of a step as tasks of Prefect's task runners: processes of this machine, Dask or Ray.

A shard is a task run named after it. Few are handed out at a time, so memory does not grow with the number of episodes.
"""

from __future__ import annotations

import logging
import os
import pickle
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import httpx

from tasks.execution.process_pool import process_runner
from tasks.execution.temporary_server import private_server, set_up_temporary_server
from worldline_core.errors import WorldLineError, needing
from worldline_core.scale.mapping import (
    Outcome,
    RunnerConfig,
    SerialMapper,
    Shard,
    ShardMapper,
    WorkerDiedError,
    try_shard,
)
from worldline_core.scale.process import end_with_pool
from worldline_core.store.store import helper_lock

_DEATHS = frozenset(
    {"BrokenProcessPool", "KilledWorker", "WorkerCrashedError", "OutOfMemoryError", "NodeDiedError", "OwnerDiedError"}
)
"""Errors of the runners for a worker that ended without an answer (concurrent.futures, distributed, ray)."""
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def shard_mapper(config: RunnerConfig) -> ShardMapper:
    """Returns the configured mapper."""
    return SerialMapper(config) if config.kind == "serial" else PrefectMapper(config)


class PrefectMapper:
    """Does shards as tasks of a Prefect task runner. `auto` does few episodes in this process, without Prefect."""

    def __init__(self, config: RunnerConfig) -> None:
        self.config = config
        self.episodes_per_shard = config.episodes_per_shard

    def run(self, shards: Sequence[Shard[Any]], *, one_at_a_time: bool = False) -> Iterator[Outcome]:
        config = self.config
        workers = self._workers(shards)
        few = config.kind == "auto" and (sum(map(len, shards)) < config.serial_below or workers == 1)
        # A shard that killed a worker must not get the chance to kill this process.
        if few and not one_at_a_time:
            yield from SerialMapper(config).run(shards)
            return
        limit = 1 if one_at_a_time else 2 * workers
        waiting = deque(shards)
        while waiting:  # a pool of processes ends with the worker that it loses: the next round has a new one
            set_up_temporary_server()
            with limited_threads(1), shared_server(), self._task_runner(min(workers, limit)) as runner:
                handed_out: deque[tuple[Shard[Any], Any]] = deque()
                broken = False
                while handed_out or (waiting and not broken):
                    while waiting and not broken and len(handed_out) < limit:
                        handed_out.append((waiting[0], self._submit(runner, waiting.popleft())))
                    shard, future = handed_out.popleft()
                    error = _outcome(shard, future)
                    broken = broken or isinstance(error, WorkerDiedError)
                    yield shard, error

    def _workers(self, shards: Sequence[Shard[Any]]) -> int:
        """As many as are configured, but no more than the work has devices for."""
        wanted = self.config.workers or len(os.sched_getaffinity(0))
        most = shards[0].work.processes if shards else None
        return wanted if most is None else max(1, min(wanted, most))

    def _submit(self, runner: Any, shard: Shard[Any]) -> Any:
        from prefect import Task

        task = Task(fn=_work, name="shard", task_run_name=shard.label, persist_result=False, log_prints=False)
        parameters = {"payload": pickle.dumps(shard), "pauses": self.config.pauses}
        if self.config.kind != "ray":
            return runner.submit(task, parameters)
        from prefect_ray.context import remote_options

        # Doing a shard again after its worker died is the business of `map_episodes`.
        with remote_options(max_retries=0):
            return runner.submit(task, parameters)

    def _task_runner(self, workers: int) -> Any:
        match self.config.kind:
            case "dask":
                return _dask_runner(workers, self.config.address)
            case "ray":
                return _ray_runner(workers, self.config.address)
            case _:
                return process_runner(workers)


def shorten_errors() -> None:
    """Let Prefect say once, in the state of a run, how an error of this project or the end of its server ended it."""
    for name in ("prefect.flow_runs", "prefect.task_runs"):
        logging.getLogger(name).addFilter(_is_unforeseen)


def _is_unforeseen(record: logging.LogRecord) -> bool:
    return not (record.exc_info and isinstance(record.exc_info[1], WorldLineError | httpx.TransportError))


def _work(payload: bytes, pauses: list[float]) -> None:
    """The body of every shard's task, in a worker: one thread per worker, since there is one worker per core."""
    import cv2

    cv2.setNumThreads(1)
    shorten_errors()
    shard: Shard[Any] = pickle.loads(payload)  # noqa: S301 - made by `PrefectMapper` in this same run
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    with helper_lock(shard.work.output):
        end_with_pool()  # with the lock held: a process that takes this work over waits until this one has ended
        if (error := try_shard(shard, pauses)) is not None:
            raise error


def _outcome(shard: Shard[Any], future: Any) -> Exception | None:
    try:
        future.result()
    except Exception as error:  # noqa: BLE001 - handed to `map_episodes`, which decides whether it ends the run
        if type(error).__name__ not in _DEATHS:
            return error
        return WorkerDiedError(
            "A worker ended without an answer",
            where=shard.label,
            got="a crash in compiled code, or killed for its memory",
        )
    return None


def _dask_runner(workers: int, address: str | None) -> Any:
    with needing("dask", "A library of the runner dask", where="runner.kind", otherwise="runner.kind=processes"):
        from dask import config as dask_config
        from prefect_dask.task_runners import DaskTaskRunner
    # Doing a shard again after its worker died is this module's business.
    dask_config.set({"distributed.scheduler.allowed-failures": 0})
    if address is not None:
        return DaskTaskRunner(address=address)
    cluster = {"n_workers": workers, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    return DaskTaskRunner(cluster_kwargs=cluster)


def _ray_runner(workers: int, address: str | None) -> Any:
    if address is None:
        # Read when Ray is imported. Started by `uv run`, it would have every worker build an environment of its own from
        # a copy of the working directory; workers of this machine have this one.
        os.environ.setdefault("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
    with needing("ray", "A library of the runner ray", where="runner.kind", otherwise="runner.kind=processes"):
        from prefect_ray import RayTaskRunner
    if address is not None:
        return RayTaskRunner(address=address)
    # Ray's workers are nice to all others, up to getting nothing on a busy machine; here they are the work.
    os.environ.setdefault("RAY_worker_niceness", "0")
    return RayTaskRunner(init_kwargs={"num_cpus": workers, "include_dashboard": False})


@contextmanager
def shared_server() -> Iterator[None]:
    """Processes that are started within speak to the server of this one, a temporary one too: each would start its own, which
    does not know their runs."""
    from prefect.client.orchestration import get_client
    from prefect.settings import PREFECT_API_URL, temporary_settings

    if PREFECT_API_URL.value():
        yield
        return
    with private_server():
        with get_client(sync_client=True) as client:
            url = str(client.api_url)
        with temporary_settings({PREFECT_API_URL: url}):
            yield


@contextmanager
def limited_threads(threads: int) -> Iterator[None]:
    """Processes that are started within have this many threads for linear algebra; read when they import numpy."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, str(threads)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
