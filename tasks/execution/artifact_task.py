"""A verb of the pipeline as one object: declared in its file in `tasks`, called in a flow or run alone.

`submit` belongs to a chain (`tasks.execution.chain`): the active run decides whether the call becomes a Prefect task
or is only written down. `run` does the work at once, without Prefect. All of them meet in the artifact store.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tasks
from worldline_core.config import StrictModel
from worldline_core.errors import ConfigError
from worldline_core.scale.process import same_threads
from worldline_core.store.store import Artifact, ArtifactStore

if TYPE_CHECKING:
    from worldline_core.scale.mapping import ShardMapper


@dataclass(frozen=True, eq=False)
class ArtifactTask:
    """One verb. Functions and configs are named, not imported: declaring a task costs nothing.

    Attributes:
        name: the verb; the task's file and the section of a configuration have the same name.
        version: part of the cache key; raised whenever the core function changes what it produces.
        function: ``module:name`` of ``function(config, inputs, output) -> metrics`` in the core.
        config: ``module:name`` of its configuration.
        inputs, optional_inputs: names of the artifacts that it needs or can use; ``rollouts.*`` stands for any number.
        distributed: whether the processes that torchrun starts share the work.
        mapped: whether the function takes a ``mapper`` and hands it shards of episodes.
    """

    name: str
    version: int
    function: str
    config: str
    inputs: tuple[str, ...] = ()
    optional_inputs: tuple[str, ...] = ()
    distributed: bool = False
    mapped: bool = False

    @property
    def summary(self) -> str:
        """The first line of its file."""
        return importlib.import_module(f"tasks.{self.name}").__doc__ or ""

    def submit(
        self,
        config: StrictModel,
        name: str | None = None,
        /,
        **inputs: TaskCall | Path | Mapping[str, TaskCall | Path] | None,
    ) -> TaskCall:
        """Call the verb in the active run; returns at once.

        Args:
            name: the call's name in the run, where a verb is called more than once (``rollout.stage2``).
            inputs: results of earlier calls, or folders. A mapping gives several: ``rollouts={"stage2": ...}`` is the
                input ``rollouts.stage2``. None leaves an optional input out.

        Raises: ConfigError: an input is missing or unknown.
        """
        flat: dict[str, TaskCall | Path] = {}
        for key, value in inputs.items():
            if isinstance(value, Mapping):
                flat |= {f"{key}.{variant}": one for variant, one in value.items()}
            elif value is not None:
                flat[key] = value
        self.check_inputs(flat)
        return active_run().call(self, config, name or self.name, flat)

    def run(
        self, store: ArtifactStore, config: StrictModel, inputs: Mapping[str, Path], mapper: ShardMapper | None = None
    ) -> Artifact:
        """Do the work now, in this process, or find its finished artifact.

        ``mapper`` does the episodes of a task that maps them; by default this process.
        """
        self.check_inputs(inputs)
        options = {"mapper": mapper} if self.mapped else {}

        def work(config: StrictModel, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
            function = self.load_function()
            if self.distributed:
                from worldline_core.pipeline.memory_estimate import require_memory

                require_memory(config, inputs)
            with same_threads(output):
                return function(config, inputs, output, **options)

        return store.run(self.name, self.version, work, config, inputs, distributed=self.distributed)

    def main(self) -> None:
        """Entry point of ``python -m tasks.<name>``."""
        load_object("tasks.execution.command_line:run_task_command")(self)

    def lacks(self, names: Iterable[str]) -> list[str]:
        """Required inputs that are not among the names."""
        given = list(names)
        return [pattern for pattern in self.inputs if not any(_matches(name, pattern) for name in given)]

    def key(self, store: ArtifactStore, config: StrictModel, digests: Mapping[str, str]) -> str:
        """Content key of the artifact, given the digests of its inputs."""
        return store.key(self.name, self.version, config, dict(sorted(digests.items())))

    def load_function(self) -> Callable[..., dict[str, Any]]:
        return load_object(self.function)

    def load_config(self) -> type[StrictModel]:
        return load_object(self.config)

    def check_inputs(self, names: Mapping[str, Any]) -> None:
        """Raises ConfigError for a missing or an unknown input."""
        unknown = [name for name in names if not any(_matches(name, p) for p in (*self.inputs, *self.optional_inputs))]
        missing = self.lacks(names)
        if unknown or missing:
            optional = f"; optional: {', '.join(self.optional_inputs)}" if self.optional_inputs else ""
            raise ConfigError(
                f"The inputs of {self.name} do not fit",
                expected=f"{', '.join(self.inputs) or 'none'}{optional}",
                got=f"missing {missing}, unknown {unknown}",
                next_step=f"give each as --input NAME=FOLDER, or run the steps before {self.name} with the same preset",
            )


@dataclass(frozen=True, eq=False)
class TaskCall:
    """One call of a task: its name in the run, its configuration, and where its inputs come from."""

    name: str
    task: ArtifactTask
    config: StrictModel
    inputs: Mapping[str, TaskCall | Path]

    @property
    def upstream(self) -> list[TaskCall]:
        return [source for source in self.inputs.values() if isinstance(source, TaskCall)]

    @property
    def command(self) -> str:
        """The command that runs this call alone."""
        return f"worldline task {self.task.name}" + ("" if self.name == self.task.name else f" --name {self.name}")


type Inputs = dict[str, TaskCall | Path]
"""Inputs of a call by name: another call, or a folder."""


class Outline:
    """The calls of a chain, by name and in order. Equal calls are one call, so that variants share what they can.

    Attributes:
        suffix: appended to the names of new calls (``.head_only``): tells the variants of a run apart.
    """

    def __init__(self) -> None:
        self.calls: dict[str, TaskCall] = {}
        self.suffix = ""
        self._by_content: dict[tuple[Any, ...], TaskCall] = {}

    def call(
        self, task: ArtifactTask, config: StrictModel, name: str, inputs: Mapping[str, TaskCall | Path]
    ) -> TaskCall:
        sources = sorted((key, s.name if isinstance(s, TaskCall) else s) for key, s in inputs.items())
        content = (task.name, config.model_dump_json(), tuple(map(str, sources)))
        if content not in self._by_content:
            new = TaskCall(name + self.suffix, task, config, dict(inputs))
            if new.name in self.calls:
                raise ConfigError("Two different calls have one name", got=new.name, next_step="give one a name")
            self._by_content[content] = self.calls[new.name] = new
            self.begin(new)
        return self._by_content[content]

    def begin(self, call: TaskCall) -> None:
        """Receive a new call; an outline only keeps it."""


_active: ContextVar[Outline] = ContextVar("active_run")


def active_run() -> Outline:
    """The run that receives calls now. Raises ConfigError outside of a run."""
    run = _active.get(None)
    if run is None:
        raise ConfigError(
            "A task was submitted outside of a run", next_step="call it in a flow of this project, or use `run`"
        )
    return run


@contextmanager
def activated(run: Outline) -> Iterator[None]:
    """Let `run` receive the calls made in the context."""
    token = _active.set(run)
    try:
        yield
    finally:
        _active.reset(token)


@contextmanager
def variant(name: str) -> Iterator[None]:
    """Append a variant to the names of new calls in the context: ``train_stage2.<name>``; none for the empty name."""
    run = active_run()
    before, run.suffix = run.suffix, f".{name}" if name else ""
    try:
        yield
    finally:
        run.suffix = before


def task_names() -> list[str]:
    """Names of all verbs: the files of `tasks`."""
    return sorted(module.name for module in pkgutil.iter_modules(tasks.__path__) if not module.ispkg)


def find_task(name: str) -> ArtifactTask:
    """The task that `tasks/<name>.py` declares. Raises ConfigError for an unknown name."""
    try:
        module = importlib.import_module(f"tasks.{name}")
    except ModuleNotFoundError as error:
        if error.name != f"tasks.{name}":
            raise
        raise ConfigError("Unknown step", expected=f"one of {', '.join(task_names())}", got=name) from error
    return next(value for value in vars(module).values() if isinstance(value, ArtifactTask))


def load_object(address: str) -> Any:
    """The object at ``module:name``."""
    module, _, name = address.partition(":")
    return getattr(importlib.import_module(module), name)


def _matches(name: str, pattern: str) -> bool:
    return pattern == "*" or (name.startswith(pattern[:-1]) if pattern.endswith(".*") else name == pattern)
