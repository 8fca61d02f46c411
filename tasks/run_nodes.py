"""The nodes of a run as Prefect tasks: each starts when the artifacts that it needs are finished, some side by side; and the
page that says how far the run is, kept true while they run."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from prefect.client.orchestration import get_client
from prefect.client.schemas.objects import State
from prefect.futures import PrefectConcurrentFuture
from prefect.settings import PREFECT_API_URL, temporary_settings
from prefect.task_runners import ProcessPoolTaskRunner

from tasks.artifact_task import ArtifactReference, FindArtifact, artifact_task
from tasks.shard_mapper import limited_threads, process_runner
from worldline_core.pipeline.plan import Node
from worldline_core.report.progress import FinishedStep, write_finished_page, write_progress_page
from worldline_core.scale.mapping import RunnerConfig, WorkerDiedError

POLL_SECONDS = 0.1
REFRESH_SECONDS = 10.0


class RunPage:
    """Writes ``report/latest/index.html`` in a store: after every node and every ten seconds while the run goes on.

    A context: when it is left, the page leads to the finished report, or shows the error that ended the run.
    """

    def __init__(self, artifacts: Path, nodes: Sequence[str]) -> None:
        self.artifacts = artifacts
        self.folder = artifacts / "report" / "latest"
        self._to_come = list(nodes)
        self._running: dict[str, float] = {}
        self._done: list[FinishedStep] = []
        self._report: Path | None = None
        self._began = time.monotonic()
        self._change = threading.RLock()
        self._over = threading.Event()
        self._clock = threading.Thread(target=self._keep_true, name="run page", daemon=True)

    def __enter__(self) -> Self:
        self._clock.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._clock.join()
        if error is not None:
            self._write(failed=str(error) or type(error).__name__)
        elif self._report is not None:
            write_finished_page(self.folder, self._report)

    def started(self, node: str) -> None:
        """A node has been started."""
        with self._change:
            self._to_come.remove(node)
            self._running[node] = time.monotonic()

    def finished(self, node: str, artifact: ArtifactReference, cached: bool) -> None:
        """A node has ended, or was found finished."""
        with self._change:
            began = self._running.pop(node)
            folder = Path(str(artifact.path))
            self._done.append(FinishedStep(node, folder, 0.0 if cached else time.monotonic() - began, cached))
            if artifact.step == "report":
                self._report = folder
        self._write()

    def _keep_true(self) -> None:
        while not self._over.wait(REFRESH_SECONDS):
            if self._done:
                self._write()

    def _write(self, failed: str = "") -> None:
        with self._change:
            now = time.monotonic()
            write_progress_page(self.folder, self._done, list(self._running), self._to_come, now - self._began, failed)


def run_nodes(
    nodes: Sequence[Node], store_root: Path, runner: RunnerConfig, watcher: RunPage | None = None
) -> dict[str, ArtifactReference]:
    """Run every node, or find its artifact; returns the artifacts by the nodes' names.

    With ``runner.nodes_at_once`` of 1 everything happens in this process. Otherwise nodes that wait for nothing run
    side by side in processes that share the cores, in the order of the plan. When a node fails,
    nothing more is started, what runs is let finish, and its error is raised.
    """
    with ExitStack() as stack:
        run = _Run(store_root, runner, watcher, _pool(runner, stack))
        waiting = list(nodes)
        while waiting or run.running:
            for node in [node for node in waiting if run.has_inputs(node)]:
                if len(run.running) < runner.nodes_at_once:
                    waiting.remove(node)
                    run.start(node)
            run.take_finished()
        return run.done


class _Run:
    """The state of `run_nodes`."""

    def __init__(
        self,
        store_root: Path,
        runner: RunnerConfig,
        watcher: RunPage | None,
        pool: Callable[[], ProcessPoolTaskRunner] | None,
    ) -> None:
        self.store_root = store_root
        self.runner = runner
        self.watcher = watcher
        self.pool = pool
        self.done: dict[str, ArtifactReference] = {}
        self.running: dict[str, PrefectConcurrentFuture[Any]] = {}
        self._find: dict[str, FindArtifact] = {}
        self._ended: dict[str, State[Any]] = {}

    def has_inputs(self, node: Node) -> bool:
        return all(source in self.done for source in node.inputs.values() if isinstance(source, str))

    def start(self, node: Node) -> None:
        if self.watcher is not None:
            self.watcher.started(node.name)
        sources = [source for source in node.inputs.values() if isinstance(source, str)]
        begun, cached, self._find[node.name] = artifact_task(node.step).start(
            node.config,
            {name: self.done[source] if isinstance(source, str) else source for name, source in node.inputs.items()},
            store_root=self.store_root,
            name=node.name,
            runner=self.runner,
            pool=self.pool,
            after=[self._ended[source] for source in sources],
        )
        if isinstance(begun, State):
            self._take(node.name, begun, cached)
        else:
            self.running[node.name] = begun

    def take_finished(self) -> None:
        """Wait until one of the running nodes has ended, if any runs."""
        if not self.running:
            return
        while not (ended := [name for name, future in self.running.items() if future.wrapped_future.done()]):
            time.sleep(POLL_SECONDS)
        for name in ended:
            future = self.running.pop(name)
            try:
                future.wait()
            except BrokenProcessPool as error:
                raise WorkerDiedError(
                    "A process of this run ended without an answer",
                    where=name,
                    got="a crash in compiled code, or killed for its memory",
                    next_step="run the same command again: what is finished is kept; runner.nodes_at_once=1 takes less memory",
                ) from error
            self._take(name, future.state, cached=False)

    def _take(self, name: str, ended: State[Any], cached: bool) -> None:
        if not ended.is_completed():
            ended.result()  # raises what ended it
        artifact = self._find[name]()
        self.done[name], self._ended[name] = artifact, ended
        if self.watcher is not None:
            self.watcher.finished(name, artifact, cached)


def _pool(runner: RunnerConfig, stack: ExitStack) -> Callable[[], ProcessPoolTaskRunner] | None:
    """Makes the pool of processes when it is first asked for: a run that finds everything finished needs none."""
    if runner.nodes_at_once == 1:
        return None
    made: list[ProcessPoolTaskRunner] = []

    def pool() -> ProcessPoolTaskRunner:
        if not made:
            cores = len(os.sched_getaffinity(0))
            stack.enter_context(limited_threads(max(1, cores // runner.nodes_at_once)))
            # The processes speak to this run's server; by themselves each would start a temporary one of its own.
            with get_client(sync_client=True) as client:
                stack.enter_context(temporary_settings({PREFECT_API_URL: str(client.api_url)}))
            made.append(stack.enter_context(process_runner(runner.nodes_at_once)))
        return made[0]

    return pool
