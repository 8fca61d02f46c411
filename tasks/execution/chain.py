"""A chain as data: which call needs what, for whoever must know it without running it.

A chain is a plain function that calls ``task.submit``; `flows/pipeline.py` has the project's. A step run alone, the rehearsal
and the tests walk the same function as an outline instead of a second description of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from pathlib import Path

from tasks.execution.artifact_task import Outline, TaskCall, activated
from worldline_core.errors import ArtifactError, ConfigError
from worldline_core.store.store import Artifact, ArtifactStore


def outline[**P](chain: Callable[P, object], *arguments: P.args, **options: P.kwargs) -> dict[str, TaskCall]:
    """The calls that a chain makes, by name, each after those that it needs. Nothing is run."""
    run = Outline()
    with activated(run):
        chain(*arguments, **options)
    return run.calls


def load_chain() -> Callable[..., object]:
    """The project's chain: the entry point ``chain`` of the group ``worldline``, because tasks do not import flows."""
    (found,) = entry_points(group="worldline", name="chain")
    return found.load()


def calls_after(calls: Mapping[str, TaskCall]) -> dict[str, int]:
    """Length of the longest path from each call of an outline to the end of the run, in calls."""
    after = dict.fromkeys(calls, 0)
    for call in reversed([*calls.values()]):  # each comes after those that it needs
        for source in call.upstream:
            after[source.name] = max(after[source.name], after[call.name] + 1)
    return after


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
    call: TaskCall,
    calls: Mapping[str, TaskCall],
    store: ArtifactStore,
    given: Mapping[str, Path | None] | None = None,
) -> dict[str, Path]:
    """The folders of a call's inputs: finished artifacts of the calls before it, or those that are `given` instead.

    Args:
        given: one of a group (``rollouts.NAME``) takes the place of the whole group; None leaves an input out.

    Raises: ArtifactError when an artifact is not finished; the message names the command that makes it.
    """
    given = given or {}
    groups = {name.partition(".")[0] for name in given if "." in name}
    needed = {
        key: source
        for key, source in call.inputs.items()
        if key not in given and not ("." in key and key.partition(".")[0] in groups)
    }
    before = {name: calls[name] for name in list(calls)[: list(calls).index(call.name)]}
    found = find_artifacts(before, store)
    folders = {key: _folder(source, found) for key, source in needed.items()}
    missing = [source for key, source in needed.items() if folders[key] is None and isinstance(source, TaskCall)]
    if missing:
        raise ArtifactError(
            f"{call.name} needs artifacts that are not finished",
            where=store.root,
            got=f"missing: {', '.join(source.name for source in missing)}",
            next_step=f"run `{missing[0].command}` with the same preset first, or `worldline pipeline`; or give its folder as"
            f" --input (NAME=FOLDER; an empty FOLDER leaves an optional input out)",
        )
    found_here = {key: folder for key, folder in folders.items() if folder is not None}
    return found_here | {name: folder for name, folder in given.items() if folder is not None}


def _folder(source: TaskCall | Path, found: Mapping[str, Artifact]) -> Path | None:
    if not isinstance(source, TaskCall):
        return source
    return found[source.name].path if source.name in found else None
