"""Calls of tasks in a chain, and the runs that receive them.

A chain is a plain function that calls ``task.submit``; `flows/pipeline.py` has the project's. What a call does is the
business of the active run: `PrefectRun` makes Prefect tasks of them, `Outline` writes them down, so that whoever must know
the chain (a step run alone, the rehearsal, a test) walks the same function instead of a second description of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

from worldline_core.config import StrictModel
from worldline_core.errors import ArtifactError, ConfigError
from worldline_core.store.store import Artifact, ArtifactStore

if TYPE_CHECKING:
    from tasks.execution.artifact_task import ArtifactTask


@dataclass(frozen=True, eq=False)
class TaskCall:
    """One call of a task: its name in the run, its configuration, and where its inputs come from."""

    name: str
    task: ArtifactTask
    config: StrictModel
    inputs: Mapping[str, TaskCall | Path]

    @property
    def upstream(self) -> list[TaskCall]:
        """The calls whose results this one needs."""
        return [source for source in self.inputs.values() if isinstance(source, TaskCall)]

    @property
    def command(self) -> str:
        """The command that runs this call alone."""
        return f"worldline task {self.task.name}" + ("" if self.name == self.task.name else f" --name {self.name}")


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


def outline[**P](chain: Callable[P, object], *arguments: P.args, **options: P.kwargs) -> dict[str, TaskCall]:
    """The calls that a chain makes, by name, each after those that it needs. Nothing is run."""
    run = Outline()
    with activated(run):
        chain(*arguments, **options)
    return run.calls


def load_chain() -> Callable[..., object]:
    """The project's chain, a function of its configuration: the entry point ``chain`` of the group ``worldline``.

    Tasks do not import flows; a task that runs alone asks the installed package for the chain that it belongs to.
    """
    (found,) = entry_points(group="worldline", name="chain")
    return found.load()


def find_call(calls: Mapping[str, TaskCall], task: str, name: str | None = None) -> TaskCall:
    """The call of a task: the named one, or the only one.

    Raises: ConfigError when there is no such call, or several and none is named.
    """
    candidates = [call.name for call in calls.values() if call.task.name == task]
    chosen = name or (task if task in candidates or len(candidates) != 1 else candidates[0])
    if chosen not in candidates:
        problem = "occurs more than once in this run" if name is None and candidates else "does not occur in this run"
        raise ConfigError(f"{chosen} {problem}", expected=f"--name with one of {candidates}", got=name or "no name")
    return calls[chosen]


def find_artifacts(calls: Mapping[str, TaskCall], store: ArtifactStore) -> dict[str, Artifact]:
    """The finished artifacts of an outline, by the calls' names. One whose inputs are unfinished cannot be found."""
    found: dict[str, Artifact] = {}
    for call in calls.values():
        folders = {key: _folder(source, found) for key, source in call.inputs.items()}
        inputs = {key: folder for key, folder in folders.items() if folder is not None and folder.is_dir()}
        if len(inputs) == len(call.inputs):
            digests = {key: store.input_digest(path) for key, path in inputs.items()}
            artifact = store.find(call.task.name, call.task.key(store, call.config, digests))
            if artifact is not None:
                found[call.name] = artifact
    return found


def ready_inputs(
    call: TaskCall, calls: Mapping[str, TaskCall], store: ArtifactStore, given: Mapping[str, Path] | None = None
) -> dict[str, Path]:
    """The folders of a call's inputs: finished artifacts of the calls before it, or those that are `given` instead.

    Raises: ArtifactError when an artifact is not finished; the message names the command that makes it.
    """
    needed = {key: source for key, source in call.inputs.items() if key not in (given or {})}
    before = {name: calls[name] for name in list(calls)[: list(calls).index(call.name)]}
    found = find_artifacts(before, store)
    folders = {key: _folder(source, found) for key, source in needed.items()}
    missing = [source for key, source in needed.items() if folders[key] is None and isinstance(source, TaskCall)]
    if missing:
        raise ArtifactError(
            f"{call.name} needs artifacts that are not finished",
            where=store.root,
            got=f"missing: {', '.join(source.name for source in missing)}",
            next_step=f"run `{missing[0].command}` with the same preset first, or `worldline pipeline`",
        )
    return {key: folder for key, folder in folders.items() if folder is not None} | dict(given or {})


def _folder(source: TaskCall | Path, found: Mapping[str, Artifact]) -> Path | None:
    if not isinstance(source, TaskCall):
        return source
    return found[source.name].path if source.name in found else None
