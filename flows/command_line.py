"""The ``worldline`` command. Nothing heavy is imported before it is known what is wanted: help answers at once."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from worldline_core.pipeline.steps import STEPS


def build_parser() -> argparse.ArgumentParser:
    """The parser of the whole command line."""
    parser = argparse.ArgumentParser(
        prog="worldline", description="From robot recordings to an action-driven visual simulator."
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    pipeline = commands.add_parser("pipeline", help="run every step, from recordings to the report")
    pipeline.set_defaults(run=_pipeline)
    nightly = commands.add_parser("nightly", help="evaluate the shipped checkpoints and compare with earlier nights")
    nightly.set_defaults(run=_nightly)
    for parser_with_config in (pipeline, nightly):
        _add_config_arguments(parser_with_config)
    task = commands.add_parser("task", help="run one step alone", formatter_class=argparse.RawDescriptionHelpFormatter)
    task.add_argument("step", choices=sorted(STEPS), metavar="STEP", help="one of: " + ", ".join(STEPS))
    _add_task_arguments(task)
    task.set_defaults(run=_task)
    rollout = commands.add_parser("rollout", help="predict videos (short for: task rollout)")
    _add_task_arguments(rollout)
    rollout.set_defaults(run=_task, step="rollout")
    report = commands.add_parser("report", help="write the report of what is finished (short for: task report)")
    _add_task_arguments(report)
    report.set_defaults(run=_task, step="report")
    record = commands.add_parser("record", help="record episodes and candidate banks in simulation (extra: sim)")
    record.add_argument(
        "--config", type=Path, default=Path("configs/recording/sample.yaml"), help="recording configuration"
    )
    record.add_argument(
        "--set", action="append", default=[], metavar="a.b=value", dest="overrides", help="change one value"
    )
    record.add_argument("--output", type=Path, required=True, help="folder of the new EpisodeSet")
    record.set_defaults(run=_record)
    inspect = commands.add_parser("inspect", help="say what an artifact holds, with pictures")
    inspect.add_argument("artifact", type=Path)
    inspect.add_argument(
        "--output", type=Path, default=None, help="where the pictures go (default: the artifact's run/)"
    )
    inspect.set_defaults(run=_inspect)
    doctor = commands.add_parser("doctor", help="say what this machine can do")
    doctor.add_argument("--json", action="store_true", help="print JSON")
    doctor.set_defaults(run=_doctor)
    return parser


def _add_config_arguments(parser: argparse.ArgumentParser) -> None:
    from tasks.command_line import add_config_arguments

    add_config_arguments(parser)


def _add_task_arguments(parser: argparse.ArgumentParser) -> None:
    from tasks.command_line import add_task_arguments

    add_task_arguments(parser)


def _use_local_prefect_storage(artifacts: Path) -> None:
    """Prefect's cache records belong to the artifacts that they speak of. Must happen before Prefect is imported."""
    os.environ.setdefault("PREFECT_LOCAL_STORAGE_PATH", str((artifacts / "prefect").resolve()))
    os.environ.setdefault("PREFECT_SERVER_ANALYTICS_ENABLED", "false")
    os.environ.setdefault("PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS", "180")


def _pipeline(arguments: argparse.Namespace) -> None:
    _use_local_prefect_storage(arguments.artifacts)
    from flows.pipeline import pipeline

    preset = arguments.preset or (None if arguments.config else "tiny")
    report = pipeline(preset, arguments.config, tuple(arguments.overrides), arguments.artifacts)
    print(f"report: {report.path / 'index.html'}")


def _nightly(arguments: argparse.Namespace) -> None:
    _use_local_prefect_storage(arguments.artifacts)
    from flows.nightly_evaluation import nightly_evaluation

    preset = arguments.preset or (None if arguments.config else "tiny")
    print(f"nightly: {nightly_evaluation(preset, arguments.config, tuple(arguments.overrides), arguments.artifacts)}")


def _task(arguments: argparse.Namespace) -> None:
    from tasks.command_line import print_artifact, run_task

    print_artifact(run_task(arguments.step, arguments))


def _record(arguments: argparse.Namespace) -> None:
    from worldline_core.config import read_yaml
    from worldline_core.recorder.record_command import record_command

    kind = "banks" if "banks" in read_yaml(arguments.config) else "episodes"
    print(record_command(kind, arguments.config, arguments.overrides, arguments.output))


def _inspect(arguments: argparse.Namespace) -> None:
    from worldline_core.report.inspect import inspect

    print(inspect(arguments.artifact, arguments.output))


def _doctor(arguments: argparse.Namespace) -> None:
    from worldline_core.doctor import examine_machine, format_findings

    findings = examine_machine(Path.cwd())
    if arguments.json:
        import json

        print(json.dumps(findings, indent=1))
    else:
        print(format_findings(findings))


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of the console command."""
    from tasks.command_line import exit_with_clear_errors

    # Threads that spin at barriers take the cores from the video decoders beside them. Read when torch is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    arguments = build_parser().parse_args(argv)
    exit_with_clear_errors(lambda: arguments.run(arguments))


if __name__ == "__main__":
    main()
