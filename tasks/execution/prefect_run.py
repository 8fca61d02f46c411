"""Calls of a chain as Prefect tasks, whose cache is the artifact store.

Prefect's cache key is the store's own key (step, version, config, digests of the inputs), so Prefect shows a task as cached
exactly when the store has the artifact. Where an artifact is and what its digest is, the store alone decides: a record of
Prefect's that says anything else (its artifact was deleted, the store was moved, it was edited) is not read but
written anew.
"""

from __future__ import annotations

import functools
import json
import multiprocessing
import os
from collections.abc import Mapping
from concurrent.futures import CancelledError
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from pathlib import Path
from queue import SimpleQueue
from types import TracebackType
from typing import Any, Self, cast

from prefect import Task
from prefect.cache_policies import CachePolicy
from prefect.client.schemas.objects import RunInput, State, TaskRunResult
from prefect.context import FlowRunContext, TaskRunContext
from prefect.exceptions import UpstreamTaskError
from prefect.futures import PrefectConcurrentFuture
from prefect.runtime import task_run
from prefect.serializers import JSONSerializer
from prefect.settings import PREFECT_LOCAL_STORAGE_PATH
from prefect.task_runners import ProcessPoolTaskRunner

from tasks.execution.artifact_task import Outline, TaskCall, activated, find_task
from tasks.execution.chain import calls_after
from tasks.execution.command_line import log_to_stderr
from tasks.execution.process_pool import process_runner
from tasks.execution.run_page import LATEST_REPORT, RunPage
from tasks.execution.shard_mapper import (
    limited_threads,
    shard_mapper,
    shared_server,
    shorten_errors,
)
from worldline_core.config import StrictModel
from worldline_core.data.guards.source_paths import SourceFolder, parse_location
from worldline_core.errors import ArtifactError
from worldline_core.progress import running_node
from worldline_core.scale.mapping import RunnerConfig, WorkerDiedError
from worldline_core.scale.process import end_with_pool, keep_freed_memory
from worldline_core.store.remote import is_remote
from worldline_core.store.store import Artifact, ArtifactStore


class ArtifactReference(StrictModel):
    """The result of a task: where its artifact is and what is in it. Small, JSON, no data."""

    step: str
    path: SourceFolder
    digest: str

    @property
    def folder(self) -> Path:
        return Path(str(self.path))

    @classmethod
    def of(cls, artifact: Artifact) -> Self:
        """The reference to an artifact."""
        return cls(step=artifact.step, path=artifact.path, digest=artifact.digest)


class PrefectRun(Outline):
    """A context in a flow: every call in it becomes a task of the flow run; leaving it waits for all of them.

    With ``runner.steps_at_once`` of 1 each call is made at once, in this process. Otherwise calls whose artifact is not
    there yet go to Prefect's pool of processes, where each starts when its inputs are finished; among those that are ready, the
    one on the longest remaining path starts first. When a task fails, those that have not started are cancelled, what runs is
    allowed to finish, and the error is raised.

    Args:
        page_of: an outline of the run; its page then shows how far the run is, and remaining paths order the tasks.

    Attributes:
        artifacts: results by the calls' names; complete when the context has been left.
    """

    def __init__(self, artifacts: Path, runner: RunnerConfig, page_of: Mapping[str, TaskCall] | None = None) -> None:
        super().__init__()
        self.artifacts: dict[str, ArtifactReference] = {}
        self._store = ArtifactStore(artifacts, runner.verify)
        self._runner = runner
        self._page = None if page_of is None else RunPage(artifacts, page_of, runner.steps_at_once)
        self._calls_after = calls_after(page_of or {})
        self._ended: dict[str, State[Any]] = {}
        self._futures: dict[str, PrefectConcurrentFuture[Any]] = {}
        self._results: SimpleQueue[tuple[str, BaseException | None]] = SimpleQueue()
        self._stack = ExitStack()

    @property
    def page_folder(self) -> Path:
        """Folder of the page of the run, which becomes its report."""
        return self._store.root / LATEST_REPORT

    def __enter__(self) -> Self:
        keep_freed_memory()
        shorten_errors()
        if self._page is not None:
            self._stack.enter_context(self._page)
        self._stack.enter_context(activated(self))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stack:
            if error is not None:
                self._cancel()
                for _ in self._futures:
                    self._results.get()
                raise error
            self._wait()
            for name, made in self.artifacts.items():
                self._store.linked(name, Artifact(made.step, made.folder, made.digest, cached=True))

    def begin(self, call: TaskCall) -> None:
        """Make the call a Prefect task: here and now, or in the pool of processes."""
        pending = [source for source in call.upstream if source.name in self._futures]
        if not pending:
            references: dict[str, ArtifactReference] = self._sources(call)
            key = call.task.key(self._store, call.config, {name: r.digest for name, r in references.items()})
            found = self._store.find(call.task.name, key)
            if found is not None or self._runner.steps_at_once == 1:
                self._call_here(call, key, references)
                return
        self._futures[call.name] = self._pool.submit(
            _prefect_task(call, refresh=True),
            {**self._parameters(call), "inputs": _as_json(self._sources(call))},
            wait_for=[self._futures[source.name] for source in pending],
            dependencies={"inputs": self._run_inputs(call)},
        )
        self._futures[call.name].add_done_callback(functools.partial(self._take, call))

    def _call_here(self, call: TaskCall, key: str, inputs: Mapping[str, ArtifactReference]) -> None:
        found = self._store.find(call.task.name, key)
        recorded = found is not None and _is_recorded(f"{call.task.name}-{key}", ArtifactReference.of(found))
        if (flow_run := FlowRunContext.get()) is not None:
            # Prefect takes parameters for results of tasks by the ids of plain objects, which equal strings share; what a
            # call waits for is stated below.
            flow_run.run_results.clear()
        state = cast(
            "State[Any]",
            _prefect_task(call, refresh=not recorded)(
                **self._parameters(call),
                inputs=_as_json(inputs),
                wait_for=[self._ended[source.name] for source in call.upstream],
                return_state=True,
            ),
        )
        if not state.is_completed():
            state.result()  # raises what ended it
        made = self._store.find(call.task.name, key)
        if made is None:
            raise ArtifactError(
                "A task ended without its artifact",
                where=self._store.root / call.task.name / key,
                next_step="run the command again",
            )
        self._ended[call.name] = state
        self.artifacts[call.name] = ArtifactReference.of(made)
        if self._page is not None:
            self._page.finished(call, made.path, cached=found is not None)

    def _take(self, call: TaskCall, future: Any) -> None:
        """Receive a task of the pool that has ended; called in a thread of Prefect's."""
        error: BaseException | None = None
        try:
            state = future.wrapped_future.result()
            self.artifacts[call.name] = ArtifactReference.model_validate(state.result())
            if self._page is not None:
                self._page.finished(call, self.artifacts[call.name].folder, cached=False)
        except BaseException as caught:  # noqa: BLE001 - raised where the run waits
            error = caught
        self._results.put((call.name, error))

    def _wait(self) -> None:
        """Wait for the tasks of the pool. Raises the first error that one of them ends with, once no other runs."""
        errors: list[tuple[str, BaseException]] = []
        for _ in range(len(self._futures)):
            name, error = self._results.get()
            if error is not None:
                errors.append((name, error))
                self._cancel()
        # What waited for a task that failed may end before it.
        own = [(name, error) for name, error in errors if not isinstance(error, UpstreamTaskError | CancelledError)]
        for name, error in own or errors:
            if isinstance(error, BrokenProcessPool):
                raise WorkerDiedError(
                    "A process of this run ended without an answer",
                    where=name,
                    got="a crash in compiled code, or killed for its memory",
                    next_step="run the same command again: what is finished is kept; runner.steps_at_once=1 takes less memory",
                ) from error
            raise error

    def _cancel(self) -> None:
        """Cancel what has not started; what runs is allowed to finish."""
        for future in self._futures.values():
            future.wrapped_future.cancel()

    def _parameters(self, call: TaskCall) -> dict[str, Any]:
        return {
            "task_name": call.task.name,
            "config": call.config.model_dump(mode="json"),
            "store_root": str(self._store.root),
            "runner": self._runner.model_dump(mode="json"),
        }

    def _sources(self, call: TaskCall) -> dict[str, Any]:
        """Inputs as Prefect resolves them: futures of tasks in the pool, references of those that have ended and of folders."""
        sources: dict[str, Any] = {}
        for name, source in call.inputs.items():
            if isinstance(source, TaskCall):
                sources[name] = self._futures.get(source.name) or self.artifacts[source.name]
            else:
                path = source if is_remote(source) else source.resolve()
                sources[name] = ArtifactReference(step="folder", path=path, digest=self._store.input_digest(source))
        return sources

    def _run_inputs(self, call: TaskCall) -> set[RunInput]:
        """Task runs whose results the call uses: what Prefect draws as arrows."""
        ids = [
            self._futures[source.name].task_run_id
            if source.name in self._futures
            else self._ended[source.name].state_details.task_run_id
            for source in call.upstream
        ]
        return {TaskRunResult(id=run) for run in ids if run}  # pyright: ignore[reportUnhashable] - frozen

    @functools.cached_property
    def _pool(self) -> ProcessPoolTaskRunner:
        """Started when first needed: a run that finds everything in the store needs no processes."""
        cores = len(os.sched_getaffinity(0))
        self._stack.enter_context(limited_threads(max(1, cores // self._runner.steps_at_once)))
        self._stack.enter_context(shared_server())
        return self._stack.enter_context(process_runner(self._runner.steps_at_once, self._calls_after))


def _prefect_task(call: TaskCall, *, refresh: bool) -> Task[..., dict[str, Any]]:
    return Task(
        fn=_run_task,
        name=call.task.name,
        description=call.task.summary,
        task_run_name=call.name,
        cache_policy=CachePolicy.from_cache_key_fn(_cache_key),
        persist_result=True,
        result_serializer="json",
        refresh_cache=refresh,
    )


def _run_task(
    task_name: str, config: dict[str, Any], inputs: dict[str, dict[str, Any]], store_root: str, runner: dict[str, Any]
) -> dict[str, Any]:
    """The body of every task: plain JSON in and out, so that any task runner can carry it."""
    if multiprocessing.parent_process() is not None:
        end_with_pool()
        keep_freed_memory()
        shorten_errors()
        log_to_stderr()
    task = find_task(task_name)
    folders = {name: parse_location(value["path"]) for name, value in inputs.items()}
    settings = RunnerConfig.model_validate(runner)
    store = ArtifactStore(Path(store_root), settings.verify)
    before = running_node.set(task_run.name or task_name)
    try:
        artifact = task.run(store, task.load_config().model_validate(config), folders, shard_mapper(settings))
    finally:
        running_node.reset(before)
    return ArtifactReference.of(artifact).model_dump(mode="json")


def _cache_key(_context: TaskRunContext, parameters: dict[str, Any]) -> str:
    task = find_task(parameters["task_name"])
    config = task.load_config().model_validate(parameters["config"])
    digests = {name: ArtifactReference.model_validate(value).digest for name, value in parameters["inputs"].items()}
    return f"{task.name}-{task.key(ArtifactStore(Path(parameters['store_root'])), config, digests)}"


def _is_recorded(key: str, reference: ArtifactReference) -> bool:
    """Returns whether Prefect's record of a task is exactly what this module writes: a record names the code that reads it."""
    path = PREFECT_LOCAL_STORAGE_PATH.value() / key
    try:
        record = json.loads(path.read_text())
        return record["metadata"]["serializer"] == JSONSerializer().model_dump(mode="json") and json.loads(
            record["result"]
        ) == reference.model_dump(mode="json")
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return False


def _as_json(sources: Mapping[str, Any]) -> dict[str, Any]:
    """Inputs with their references as plain JSON."""
    return {n: s.model_dump(mode="json") if isinstance(s, ArtifactReference) else s for n, s in sources.items()}
