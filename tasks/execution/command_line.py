"""Commands: one step alone, with the same config and store as in a flow and no Prefect server; and how any command is stopped,
and says what ended it."""

from __future__ import annotations

import argparse
import logging
import os
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, TextIO, cast

from tasks.execution.artifact_task import ArtifactTask, TaskCall
from tasks.execution.chain import find_artifacts, find_call, load_chain, outline, ready_inputs
from worldline_core.config import load_config
from worldline_core.errors import ConfigError, StoppedError, WorldLineError
from worldline_core.scale.process import end_with_parent
from worldline_core.store.artifact_files import read_manifest
from worldline_core.store.store import Artifact, ArtifactStore, clear_full_disk
from worldline_core.untrusted_text import shown, visible, without_credentials

if TYPE_CHECKING:
    from worldline_core.data.curation.curate_config import CurateConfig

GRACE_SECONDS = 3.0
"""Time that the work has to end by itself, for example at Prefect's server, before it is killed."""
SAVE_SECONDS = 27.0
"""The same where a scheduler asks (SIGTERM): a training saves its state. Less than the 30 s after which torchrun kills."""


def add_overrides(parser: argparse.ArgumentParser) -> None:
    """The argument that changes values of a configuration."""
    parser.add_argument(
        "--set", action="append", default=[], metavar="a.b=value", dest="overrides", help="change one value"
    )


def add_preset_arguments(parser: argparse.ArgumentParser, default: str) -> None:
    """The arguments that say which configuration a command works on."""
    choice = parser.add_mutually_exclusive_group()
    choice.add_argument("--preset", help=f"a preset in configs/ (default: {default})")
    choice.add_argument("--config", type=Path, help="a configuration file of the same form as a preset")
    add_overrides(parser)


def chosen_preset(arguments: argparse.Namespace, default: str = "demo") -> str | None:
    """The preset that a command works on; None where a file is given instead."""
    return arguments.preset or (None if arguments.config else default)


def add_config_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments that say which configuration and which store a command works on."""
    add_preset_arguments(parser, "demo")
    parser.add_argument(
        "--artifacts", type=Path, default=Path("artifacts"), help="where artifacts live (default: artifacts)"
    )


def add_task_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of a standalone step."""
    add_config_arguments(parser)
    parser.add_argument(
        "--input", action="append", default=[], metavar="NAME=FOLDER", dest="inputs",
        help="feed this folder instead of the artifact that the preset would use; NAME= leaves an optional input out",
    )  # fmt: skip
    parser.add_argument(
        "--runner", choices=("auto", "serial", "processes", "dask", "ray"),
        help="where work on many episodes runs (short for: --set runner.kind=...)",
    )  # fmt: skip
    parser.add_argument(
        "--name", help="which call of the run, when a step occurs more than once (rollout.shipped_stage2)"
    )


def run_task(task: ArtifactTask, arguments: argparse.Namespace) -> Artifact:
    """Run one task on the finished artifacts of those before it in the chain.

    Of a file that does not describe a whole run, and of a task that the chain does not call by this name, the task's own section is
    read; nothing is looked up then.
    """
    chosen = (arguments.config, arguments.preset, arguments.name, *arguments.overrides)
    if task.name == "curate" and not any(chosen):
        raise ConfigError(
            "Nothing says which recordings to read", expected="--config FILE or --preset NAME", got="neither",
            next_step="write their source into a file (docs/sources.md); --preset demo reads the shipped ones",
        )  # fmt: skip
    preset = chosen_preset(arguments)
    from tasks.execution.shard_mapper import shard_mapper
    from worldline_core.pipeline.pipeline_config import PipelineConfig, source_folders
    from worldline_core.scale.mapping import RunnerConfig

    overrides = [*arguments.overrides, *([f"runner.kind={arguments.runner}"] if arguments.runner else [])]
    runner = load_config(RunnerConfig, preset=preset, path=arguments.config, overrides=overrides, section="runner")
    store, mapper = ArtifactStore(arguments.artifacts, runner.verify), shard_mapper(runner)
    given = dict(_parse_input(text) for text in arguments.inputs)
    calls: dict[str, TaskCall] = {}
    lacking = PipelineConfig.lacking(preset, arguments.config)
    missing = task.lacks(given)
    if lacking and (arguments.name is not None or missing):
        steps = (
            [f"give {' '.join(f'--input {name.replace("*", "NAME")}=FOLDER' for name in missing)}"] if missing else []
        )
        steps += ["leave --name out"] if arguments.name is not None else []
        raise ConfigError(
            f"The file describes no whole run in which {arguments.name or f'inputs of {task.name}'} could be looked up",
            where=arguments.config,
            got=f"no sections {', '.join(lacking)}",
            next_step=f"{' and '.join(steps)}, or begin the file with `extends: tiny`",
        )
    if (task.name != "curate" and not lacking) or arguments.name is not None:
        calls = outline(load_chain(), PipelineConfig.load(preset, arguments.config, overrides))
    if not calls or (arguments.name is None and task.name not in calls and not task.lacks(given)):
        config = load_config(
            task.load_config(), preset=preset, path=arguments.config, overrides=overrides, section=task.name
        )
        if task.name == "curate":
            given = {f"source.{n}": path for n, path in source_folders(cast("CurateConfig", config)).items()} | given
        folders = {name: folder for name, folder in given.items() if folder is not None}
        return store.linked(task.name, task.run(store, config, folders, mapper))
    call = find_call(calls, task.name, arguments.name)
    task.check_inputs({**call.inputs, **given})
    return store.linked(call.name, task.run(store, call.config, ready_inputs(call, calls, store, given), mapper))


def _parse_input(text: str) -> tuple[str, Path | None]:
    name, separator, folder = text.partition("=")
    if not separator or not name:
        raise ConfigError("An input has the form NAME=FOLDER", got=text)
    return name, Path(folder) if folder else None


def run_task_command(task: ArtifactTask) -> None:
    """Run a task with the arguments of this process, which can be stopped."""
    parser = argparse.ArgumentParser(prog=f"python -m tasks.{task.name}", description=task.summary)
    add_task_arguments(parser)
    arguments = parser.parse_args()
    run_supervised(
        lambda: exit_with_clear_errors(lambda: print_artifact(run_task(task, arguments))),
        continues=True,
    )


def print_artifact(artifact: Artifact) -> None:
    """Print where the artifact is, its digest, whether it was there already, and the figures of an evaluation."""
    print(f"{artifact.path}  {artifact.digest[:16]}  {'cached' if artifact.cached else 'built'}")
    if artifact.step.startswith("evaluate_"):
        from worldline_core.report.comparison import figures_of

        print(figures_of(artifact.step, artifact.path))


def list_artifacts(arguments: argparse.Namespace) -> None:
    """Print the calls of a run by name, and the artifacts of those that are finished."""
    from worldline_core.pipeline.pipeline_config import PipelineConfig
    from worldline_core.report.comparison import aligned

    config = PipelineConfig.load(chosen_preset(arguments), arguments.config, arguments.overrides)
    calls = outline(load_chain(), config)
    store = ArtifactStore(arguments.artifacts)
    found = find_artifacts(calls, store)
    lines = [("name", "artifact", "seconds", "finished")]
    for name in calls:
        made = read_manifest(found[name].path) if name in found else {}
        place = str(arguments.artifacts / found[name].step / found[name].key) if name in found else "not finished"
        lines.append((name, place, str(made.get("wall_seconds", "")), str(made.get("finished_at", ""))))
    print(aligned(lines))


class _StoppedError(BaseException):
    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def run_supervised(action: Callable[[], object], *, continues: bool) -> None:
    """Do the work in a process group of its own, and end with its exit status.

    Ctrl-C in a terminal reaches this process alone: Prefect's temporary server, which is in the group, would end first and the flow wait
    minutes for it. Killed, this process takes the group with it, and torchrun takes this process. SIGINT ends the group within
    `GRACE_SECONDS`, SIGTERM within `SAVE_SECONDS`, with exit status 130 or 143. ``continues``: the same command, called again, goes on.
    """
    if not hasattr(os, "fork"):
        action()
        return
    child = os.fork()
    if child == 0:
        os.setpgid(0, 0)
        end_with_parent(lambda: os.killpg(0, signal.SIGKILL))
        action()
        return
    if "TORCHELASTIC_RUN_ID" in os.environ:  # in a session of its own, which nothing ends when torchrun is killed
        end_with_parent(lambda: (_kill_group(child), os._exit(1)))

    def stop(number: int, _frame: FrameType | None) -> None:
        raise _StoppedError(number)

    again = "; the same command continues" if continues else ""
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, stop)
        _, status = os.waitpid(child, 0)
    except _StoppedError as stopped:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        _end_group(child, GRACE_SECONDS if stopped.number == signal.SIGINT else SAVE_SECONDS)
        print(f"stopped{again}", file=sys.stderr)
        raise SystemExit(128 + stopped.number) from None
    code = os.waitstatus_to_exitcode(status)
    if code < 0:
        _kill_group(child)
        name = signal.Signals(-code).name
        print(f"error: the work was ended by {name}, perhaps for its memory{again}", file=sys.stderr)
    raise SystemExit(code if code >= 0 else 128 - code)


def _end_group(child: int, seconds: float) -> None:
    os.kill(child, signal.SIGTERM)
    deadline = time.monotonic() + seconds
    while os.waitpid(child, os.WNOHANG) == (0, 0):
        if time.monotonic() > deadline:
            _kill_group(child)
            os.waitpid(child, 0)
            return
        time.sleep(0.05)
    _kill_group(child)


def _kill_group(child: int) -> None:
    try:
        os.killpg(child, signal.SIGKILL)
    except ProcessLookupError:
        return  # no process is left


def exit_with_clear_errors(action: Callable[[], object]) -> None:
    """Run a command; a WorldLineError is printed without a traceback and ends it with status 1."""
    log_to_stderr()
    sys.excepthook = _print_traceback
    try:
        with clear_full_disk():
            action()
            sys.stdout.flush()
    except StoppedError as stopped:
        print(stopped, file=sys.stderr)
        raise SystemExit(128 + signal.SIGTERM) from stopped
    except WorldLineError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from error
    except BrokenPipeError as error:
        if not _output_closed():
            raise
        raise SystemExit(128 + signal.SIGPIPE) from error


def _output_closed() -> bool:
    """Returns whether the reader of stdout has ended (`worldline ... | head`); then nothing is written at the exit either."""
    watched = select.poll()
    watched.register(sys.stdout.fileno(), 0)
    if not any(event & select.POLLERR for _, event in watched.poll(0)):
        return False
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return True


def _print_traceback(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """An unforeseen error, as Python prints it, without credentials."""
    sys.stderr.write(visible(without_credentials("".join(traceback.format_exception(kind, error, trace)))))


class _StderrHandler(logging.StreamHandler[TextIO]):
    """Prints a message, without credentials and control characters, unless the root logger's handler of Prefect prints it."""

    def handle(self, record: logging.LogRecord) -> bool:
        record.msg, record.args = shown(record.getMessage()), None
        return super().handle(record)

    def emit(self, record: logging.LogRecord) -> None:
        if not any(type(handler).__name__ == "PrefectConsoleHandler" for handler in logging.getLogger().handlers):
            super().emit(record)


def log_to_stderr() -> None:
    """Show this project's messages; Prefect and the libraries keep their own handlers."""
    handler = _StderrHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(asctime)s | %(levelname)-7s | %(message)s", datefmt="%H:%M:%S"))
    for name in ("worldline_core", "tasks", "flows"):
        project_logger = logging.getLogger(name)
        project_logger.handlers = [handler]
        project_logger.setLevel(logging.INFO)
