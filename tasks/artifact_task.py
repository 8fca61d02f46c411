"""A step of the core as a Prefect task whose cache is the artifact store."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from prefect import Task
from prefect.cache_policies import CachePolicy
from prefect.client.schemas.objects import RunInput, State, TaskRunResult
from prefect.context import TaskRunContext
from prefect.futures import PrefectConcurrentFuture
from prefect.runtime import task_run
from prefect.serializers import JSONSerializer
from prefect.settings import PREFECT_LOCAL_STORAGE_PATH
from prefect.task_runners import ProcessPoolTaskRunner

from tasks.command_line import log_to_stderr, run_task_command
from tasks.shard_mapper import shard_mapper
from worldline_core.config import StrictModel
from worldline_core.data.guards.source_paths import SourceFolder, parse_location
from worldline_core.errors import ArtifactError
from worldline_core.pipeline.steps import Step, get_step, run_step
from worldline_core.progress import running_node
from worldline_core.scale.mapping import RunnerConfig
from worldline_core.scale.process_end import end_with_pool
from worldline_core.store.remote import is_remote
from worldline_core.store.store import ArtifactStore


class ArtifactReference(StrictModel):
    """What travels between tasks: where an artifact lies and what is in it. Small, JSON, no data."""

    step: str
    path: SourceFolder
    digest: str


class ArtifactTask:
    """Calls one step through Prefect.

    Prefect's cache key is the store's own key (step, version, config, digests of the inputs), so Prefect shows a
    task as cached exactly when the store has the artifact. Where an artifact lies and what its digest is the store says
    alone: a record of Prefect's that says anything else (its artifact was deleted, the store was moved, somebody wrote
    it) is not read but written anew.
    """

    def __init__(self, step: Step) -> None:
        self.step = step
        self._task = Task(
            fn=_run_step,
            name=step.name,
            description=step.summary,
            cache_policy=CachePolicy.from_cache_key_fn(_cache_key),
            persist_result=True,
            result_serializer="json",
        )

    def __call__(
        self,
        config: StrictModel,
        inputs: Mapping[str, Path | ArtifactReference],
        *,
        store_root: Path,
        name: str | None = None,
        runner: RunnerConfig | None = None,
    ) -> ArtifactReference:
        """Run the step (or find it done). ``name`` is what Prefect shows; the step's name by default. ``runner`` says
        where a step that maps its episodes works on them."""
        task, parameters, _, find = self._prepared(config, inputs, store_root, name, runner)
        task(**parameters)
        return find()

    def start(
        self,
        config: StrictModel,
        inputs: Mapping[str, Path | ArtifactReference],
        *,
        store_root: Path,
        name: str,
        runner: RunnerConfig,
        pool: Callable[[], ProcessPoolTaskRunner] | None,
        after: Sequence[State[Any]] = (),
    ) -> tuple[PrefectConcurrentFuture[Any] | State[Any], bool, FindArtifact]:
        """Start the step in a pool's process, or, where it is finished or there is no pool, do it here and now.

        Args:
            after: how the tasks ended whose artifacts it uses, so that Prefect shows what depends on what.

        Returns:
            The running task, or how it ended; whether the artifact was there already; and what finds it afterwards.
        """
        task, parameters, finished, find = self._prepared(config, inputs, store_root, name, runner)
        if pool is None or finished:
            ended: State[Any] = task(**parameters, wait_for=list(after), return_state=True)  # pyright: ignore[reportAssignmentType]
            return ended, finished, find
        ids = [state.state_details.task_run_id for state in after]
        runs: set[RunInput] = {TaskRunResult(id=run) for run in ids if run}  # pyright: ignore[reportUnhashable] - frozen
        return pool().submit(task, parameters, dependencies={"inputs": runs}), False, find

    def main(self) -> None:
        """Run the step alone, without a Prefect server: ``python -m tasks.<step>``."""
        run_task_command(self.step.name)

    def _prepared(
        self,
        config: StrictModel,
        inputs: Mapping[str, Path | ArtifactReference],
        store_root: Path,
        name: str | None,
        runner: RunnerConfig | None,
    ) -> tuple[Task[..., dict[str, Any]], dict[str, Any], bool, FindArtifact]:
        """Prefect's task, its parameters, whether the store has the artifact, and what finds it there."""
        store = ArtifactStore(store_root, (runner or RunnerConfig()).verify)
        references = {key: _reference(value, store) for key, value in inputs.items()}
        key = _key(store, self.step, config, references)
        find = partial(_stored, store, self.step, key)
        finished = store.find(self.step.name, key) is not None
        recorded = finished and _is_recorded(f"{self.step.name}-{key}", find())
        task = self._task.with_options(refresh_cache=not recorded, task_run_name=name or self.step.name)
        parameters = {
            "step_name": self.step.name,
            "config": config.model_dump(mode="json"),
            "inputs": {key: value.model_dump(mode="json") for key, value in references.items()},
            "store_root": str(store.root),
            "runner": (runner or RunnerConfig()).model_dump(mode="json"),
        }
        return task, parameters, finished, find


FindArtifact = Callable[[], ArtifactReference]
"""Finds the artifact of a task that has ended. Raises ArtifactError where there is none."""


def _stored(store: ArtifactStore, step: Step, key: str) -> ArtifactReference:
    artifact = store.find(step.name, key)
    if artifact is None:
        raise ArtifactError(
            "A task ended without its artifact", where=store.root / step.name / key, next_step="run the command again"
        )
    return ArtifactReference(step=artifact.step, path=artifact.path, digest=artifact.digest)


def _is_recorded(key: str, reference: ArtifactReference) -> bool:
    """Whether Prefect's record of a task is, to the word, what this module lets it write: a record names the code that
    reads it."""
    try:
        record = json.loads((PREFECT_LOCAL_STORAGE_PATH.value() / key).read_bytes())
        same = json.loads(record["result"]) == reference.model_dump(mode="json")
        return same and record["metadata"]["serializer"] == JSONSerializer().model_dump(mode="json")
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return False


def _run_step(
    step_name: str, config: dict[str, Any], inputs: dict[str, dict[str, Any]], store_root: str, runner: dict[str, Any]
) -> dict[str, Any]:
    """The body of every task: plain JSON in and out, so that any task runner can carry it."""
    if multiprocessing.parent_process() is not None:
        end_with_pool()
        log_to_stderr()
    folders = {name: parse_location(value["path"]) for name, value in inputs.items()}
    model = get_step(step_name).load_config().model_validate(config)
    runner_config = RunnerConfig.model_validate(runner)
    store = ArtifactStore(Path(store_root), runner_config.verify)
    before = running_node.set(task_run.name or step_name)
    try:
        artifact = run_step(store, step_name, model, folders, shard_mapper(runner_config))
    finally:
        running_node.reset(before)
    return ArtifactReference(step=artifact.step, path=artifact.path, digest=artifact.digest).model_dump(mode="json")


def _cache_key(_context: TaskRunContext, parameters: dict[str, Any]) -> str:
    step = get_step(parameters["step_name"])
    config = step.load_config().model_validate(parameters["config"])
    inputs = {name: ArtifactReference.model_validate(value) for name, value in parameters["inputs"].items()}
    return f"{step.name}-{_key(ArtifactStore(Path(parameters['store_root'])), step, config, inputs)}"


def _key(store: ArtifactStore, step: Step, config: StrictModel, inputs: Mapping[str, ArtifactReference]) -> str:
    digests = {name: reference.digest for name, reference in sorted(inputs.items())}
    return store.key(step.name, step.version, config, digests)


def _reference(value: Path | ArtifactReference, store: ArtifactStore) -> ArtifactReference:
    if isinstance(value, ArtifactReference):
        return value
    return ArtifactReference(
        step="folder", path=value if is_remote(value) else value.resolve(), digest=store.input_digest(value)
    )


def artifact_task(step_name: str) -> ArtifactTask:
    """The Prefect task of a step."""
    return ArtifactTask(get_step(step_name))
