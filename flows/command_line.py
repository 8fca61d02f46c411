"""The ``worldline`` command. Nothing heavy is imported before it is known what is wanted: help answers at once."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path

from flows.exchange_commands import add_exchange_commands
from flows.fit_command import add_fit_command
from flows.full_size_commands import add_plan_command, add_rehearse_command
from tasks.execution.artifact_task import find_task, task_names
from tasks.execution.command_line import (
    add_config_arguments,
    add_overrides,
    add_task_arguments,
    chosen_preset,
    exit_with_clear_errors,
    list_artifacts,
    print_artifact,
    run_supervised,
    run_task,
)
from tasks.execution.temporary_server import prepare_prefect, start_server_early


def build_parser() -> argparse.ArgumentParser:
    """The parser of the whole command line."""
    parser = argparse.ArgumentParser(
        prog="worldline", description="From robot recordings to an action-driven visual simulator."
    )
    parser.add_argument("--version", action="version", version=f"worldline {metadata.version('worldline')}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_init(commands)
    add_fit_command(commands)
    pipeline = commands.add_parser("pipeline", help="run every step, from recordings to the report")
    pipeline.set_defaults(run=_pipeline)
    nightly = commands.add_parser("nightly", help="evaluate the shipped checkpoints and compare with earlier nights")
    nightly.set_defaults(run=_nightly)
    nightly.add_argument("--night", metavar="NAME", help="its name in the history (default: the date)")
    nightly.add_argument(
        "--accept", metavar="NAME", help="evaluate nothing: hold later nights against this one, though it became worse"
    )
    ablations = commands.add_parser("ablations", help="train and evaluate the paper's ablations, print their table")
    ablations.add_argument("--variant", action="append", metavar="NAME", help="only this one and the full model")
    ablations.add_argument("--variants", type=Path, metavar="FILE", help="other variants than the paper's (YAML)")
    ablations.add_argument(
        "--seeds", type=int, nargs="+", default=(), help="train every variant with each of these seeds"
    )
    ablations.set_defaults(run=_ablations)
    for parser_with_config in (pipeline, nightly, ablations):
        add_config_arguments(parser_with_config)
    task = commands.add_parser("task", help="run one step alone", formatter_class=argparse.RawDescriptionHelpFormatter)
    task.add_argument("step", choices=task_names(), metavar="STEP", help="one of: " + ", ".join(task_names()))
    add_task_arguments(task)
    task.set_defaults(run=_task)
    record = commands.add_parser("record", help="record episodes and candidate banks in simulation (extra: sim)")
    record.add_argument(
        "--config", type=Path, default=Path("configs/recording/sample.yaml"), help="recording configuration"
    )
    add_overrides(record)
    record.add_argument("--output", type=Path, required=True, help="folder of the new EpisodeSet")
    record.set_defaults(run=_record)
    inspect = commands.add_parser("inspect", help="verify and describe an artifact, with a page of pictures")
    inspect.add_argument("artifact", type=Path)
    inspect.add_argument("--output", type=Path, help="folder of the page (default: the artifact's run/inspect)")
    inspect.add_argument(
        "--episodes",
        type=Path,
        metavar="FOLDER",
        help="the EpisodeSet of tracks or predictions (default: see manifest)",
    )
    inspect.add_argument("--episode", metavar="ID", help="the episode to show (default: the first one)")
    inspect.set_defaults(run=_inspect)
    listing = commands.add_parser("list", help="name the artifacts of a run: what is finished, and where it is")
    add_config_arguments(listing)
    listing.set_defaults(run=list_artifacts)
    verify = commands.add_parser("verify", help="compare the files of finished artifacts with what was written")
    verify.add_argument(
        "artifact", type=Path, nargs="*", help="only these, shipped ones too (default: all of the store)"
    )
    verify.add_argument("--artifacts", type=Path, default=Path("artifacts"), help="the store (default: artifacts)")
    verify.set_defaults(run=_verify)
    add_plan_command(commands)
    add_exchange_commands(commands)
    add_rehearse_command(commands)
    _add_embodiment(commands)
    _add_serve(commands)
    _add_calibrate(commands)
    doctor = commands.add_parser("doctor", help="say what this machine can do")
    doctor.add_argument("--json", action="store_true", help="print JSON")
    doctor.add_argument("--licences", action="store_true", help="list the licences of what is installed and shipped")
    doctor.set_defaults(run=_doctor)
    return parser


def _add_embodiment(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    embodiment = commands.add_parser("embodiment", help="list robots, check the kinematics of one")
    actions = embodiment.add_subparsers(dest="embodiment_command", required=True, metavar="ACTION")
    listing = actions.add_parser("list", help="all robots: arms, state size, whether the description is here, verified")
    listing.set_defaults(run=_embodiment_list)
    check = actions.add_parser(
        "check",
        help="compare forward kinematics with MuJoCo (extra: sim)",
        description="Compare forward kinematics with MuJoCo at random joint positions within the limits. Exit status:"
        " 0 all frames agree, 1 not (or nothing could be compared), 2 wrong usage.",
    )
    check.add_argument("name", metavar="NAME", help="a name of the list, or a YAML file")
    check.add_argument("--description", type=Path, metavar="FILE", help="the kinematic description to use")
    check.add_argument("--samples", type=int, default=1000, help="random joint positions (default: 1000)")
    check.set_defaults(run=_embodiment_check)


def _add_serve(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    texts = {
        "serve": "offer the simulator over a websocket (extra: serve)",
        "play": "drive the simulator by hand: serve, and say where its page is (extra: serve)",
    }
    for name, text in texts.items():
        parser = commands.add_parser(name, help=text)
        parser.add_argument(
            "--config", type=Path, metavar="FILE", help="what differs from the defaults (docs/serve.md)"
        )
        add_overrides(parser)
        parser.set_defaults(run=_serve)


def _add_init(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    init = commands.add_parser(
        "init",
        help="look at recordings of your own and write a configuration for them",
        description="Find out kind, robot, columns, units, cameras and rate of recordings, and write a commented file that extends"
        " the preset my_robot. What cannot be known becomes a TODO line in it.",
    )
    init.add_argument(
        "recordings",
        metavar="PATH_OR_HUB_ID",
        help="a folder, an MCAP file, or ORG/NAME of a LeRobotDataset on the hub",
    )
    init.add_argument(
        "--output", type=Path, default=Path("my.yaml"), metavar="FILE", help="the file to write (default: my.yaml)"
    )
    init.add_argument("--json", action="store_true", help="print the findings as JSON")
    init.set_defaults(run=_init)


def _add_calibrate(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    calibrate = commands.add_parser("calibrate", help="find out whether recordings agree with their calibration")
    actions = calibrate.add_subparsers(dest="calibrate_command", required=True, metavar="ACTION")
    check = actions.add_parser(
        "check",
        help="diagnose episodes, name the mistake, print the line that repairs it",
        description="Diagnose every episode of a source, or of an EpisodeSet. Exit status: 0 consistent, 1 something"
        " was found (or nothing could be judged), 2 wrong usage.",
    )
    what = check.add_mutually_exclusive_group(required=True)
    what.add_argument("config", nargs="?", type=Path, metavar="SOURCE_CONFIG.yaml", help="a file with a curate section")
    what.add_argument("--artifact", type=Path, metavar="FOLDER", help="an EpisodeSet instead of a source")
    add_overrides(check)
    check.add_argument(
        "--episode", action="append", default=[], metavar="ID", dest="episodes", help="only this one (repeatable)"
    )
    check.add_argument(
        "--output", type=Path, help="where pictures and diagnoses.json go (default: artifacts/calibration/<name>)"
    )
    check.add_argument("--json", action="store_true", help="print JSON instead of the table")
    check.set_defaults(run=_calibrate_check)
    estimate = actions.add_parser(
        "estimate",
        help="estimate uncalibrated cameras from the recorded episodes alone",
        description="Estimate the cameras of a source: of the views that have none, or of those named. Exit status: 0 all"
        " are sure, 1 at least one is not, 2 wrong usage.",
    )
    estimate.add_argument("config", type=Path, metavar="SOURCE_CONFIG.yaml", help="a file with a curate section")
    add_overrides(estimate)
    estimate.add_argument("--view", action="append", default=[], dest="views", help="only this one (repeatable)")
    estimate.add_argument(
        "--output",
        type=Path,
        help="where cameras.json and pictures go (default: artifacts/calibration/<name>_estimate)",
    )
    estimate.add_argument(
        "--segmenter",
        choices=("sam3", "learned", "colour"),
        help="use its masks of the robot as well, in views that stand still",
    )
    estimate.add_argument("--weights", type=Path, metavar="FOLDER", help="weights of that segmenter")
    estimate.add_argument("--json", action="store_true", help="print JSON instead of lines")
    estimate.set_defaults(run=_calibrate_estimate)


def _begin_run(
    arguments: argparse.Namespace, *, weights: bool = False
) -> tuple[str | None, Path | None, tuple[str, ...], Path]:
    """Preset, file, overrides and store of a run. Its configuration is sound, and its recordings and ``weights`` are there: mistakes are
    reported before Prefect and its server start."""
    from worldline_core.config import preset_path

    preset = chosen_preset(arguments)
    if preset is not None:
        preset_path(preset)  # answers before torch is imported
    from worldline_core.pipeline.pipeline_config import PipelineConfig, check_recordings, check_weights

    config = PipelineConfig.load(preset, arguments.config, arguments.overrides)
    check_recordings(config, Path.cwd())
    if weights:
        check_weights(config, Path.cwd())
    prepare_prefect(arguments.artifacts)
    start_server_early()
    return preset, arguments.config, tuple(arguments.overrides), arguments.artifacts


def _pipeline(arguments: argparse.Namespace) -> None:
    values = _begin_run(arguments, weights=True)
    from flows.pipeline import pipeline
    from tasks.execution.prefect_artifacts import run_flow

    print(f"how far it is, and then the report: {arguments.artifacts / 'report' / 'latest' / 'index.html'}")
    report = run_flow(pipeline, *values)
    print(f"report: {report.path / 'index.html'}")


def _nightly(arguments: argparse.Namespace) -> None:
    if arguments.accept is not None:
        from worldline_core.report.comparison import accept_night

        accept_night(arguments.artifacts / "nightly", arguments.accept)
        print(f"later nights are held against {arguments.accept}")
        return
    values = _begin_run(arguments)
    from flows.nightly_evaluation import nightly_evaluation
    from tasks.execution.prefect_artifacts import run_flow

    print(f"nightly: {run_flow(nightly_evaluation, *values, arguments.night) / 'index.html'}")


def _ablations(arguments: argparse.Namespace) -> None:
    values = _begin_run(arguments, weights=True)
    from flows.ablations import ablations
    from tasks.execution.prefect_artifacts import run_flow

    variants = None if arguments.variant is None else tuple(arguments.variant)
    table = run_flow(ablations, *values, variants, arguments.variants, tuple(arguments.seeds))
    print((Path(str(table.path)) / "table.md").read_text(), f"table: {table.path / 'table.md'}", sep="\n")


def _task(arguments: argparse.Namespace) -> None:
    prepare_prefect(arguments.artifacts)
    print_artifact(run_task(find_task(arguments.step), arguments))


def _init(arguments: argparse.Namespace) -> None:
    from worldline_core.discovery.findings import as_json, as_text, write_config
    from worldline_core.discovery.look import discover, fetch_sample, hub_id

    hub = None if (name := hub_id(arguments.recordings)) is None else fetch_sample(name)
    found = discover(Path(arguments.recordings) if hub is None else hub.folder)
    write_config(found, arguments.output, arguments.recordings)
    commands = ([hub.command] if hub is not None else []) + [f"worldline task curate --config {arguments.output}"]
    print(
        json.dumps(as_json(found, arguments.output, commands), indent=1)
        if arguments.json
        else as_text(found, arguments.output, commands)
    )


def _record(arguments: argparse.Namespace) -> None:
    from tasks.record import record
    from worldline_core.recorder.attempts import load_recording, record_into

    print(record_into(load_recording(arguments.config, arguments.overrides), arguments.output, record.version))


def _inspect(arguments: argparse.Namespace) -> None:
    from worldline_core.report.inspect import inspect

    print(inspect(arguments.artifact, arguments.output, episodes=arguments.episodes, episode_id=arguments.episode))


def _verify(arguments: argparse.Namespace) -> None:
    from worldline_core.errors import ArtifactError
    from worldline_core.store.artifact_files import MANIFEST_NAME, check_artifacts, finished_artifacts, how_to_rebuild

    for folder in arguments.artifact:
        if not (folder / MANIFEST_NAME).is_file():
            raise ArtifactError("Not a finished artifact", where=folder, expected=MANIFEST_NAME, got="no such file")
    checked = check_artifacts(arguments.artifact or finished_artifacts(arguments.artifacts))
    damaged = sum(map(bool, checked.values()))
    for folder, damage in checked.items():
        print(f"{'damaged' if damage else 'whole'}  {folder}", *damage, sep="\n  ")
        if damage:
            print(f"  next step: {how_to_rebuild(folder)}")
    print(f"{len(checked)} artifacts, {damaged} damaged")
    raise SystemExit(1 if damaged else 0)


def _calibrate_check(arguments: argparse.Namespace) -> None:
    from worldline_core.store.store import clear_full_disk

    with _unusable_is_2():  # 1 says that something was found
        from worldline_core.calibration.check import as_json, check_command, table_text

        with clear_full_disk():
            found = check_command(
                arguments.artifact or arguments.config,
                artifact=arguments.artifact is not None,
                overrides=arguments.overrides,
                episodes=arguments.episodes,
                output=arguments.output,
            )
    print(json.dumps(as_json(found), indent=1) if arguments.json else table_text(found))
    raise SystemExit(0 if found.consistent else 1)


def _calibrate_estimate(arguments: argparse.Namespace) -> None:
    with _unusable_is_2():  # 1 says that a camera is not sure
        from worldline_core.calibration.estimate.estimate import estimate_command
        from worldline_core.calibration.estimate.estimate_report import as_json, estimate_text

        mask_robot = None
        if arguments.segmenter is not None:
            from worldline_core.errors import ConfigError
            from worldline_core.evaluation.segmenters.segmenter import open_segmenter

            weights = arguments.weights
            if weights is None and arguments.segmenter != "colour":
                raise ConfigError(
                    "This segmenter needs its weights", got=arguments.segmenter, next_step="give --weights FOLDER"
                )
            mask_robot = open_segmenter(arguments.segmenter, learned=weights, sam3=weights).segment
        found = estimate_command(
            arguments.config,
            overrides=arguments.overrides,
            views=arguments.views,
            output=arguments.output,
            mask_robot=mask_robot,
        )
    print(json.dumps(as_json(found), indent=1) if arguments.json else estimate_text(found))
    raise SystemExit(0 if found.sure else 1)


@contextmanager
def _unusable_is_2() -> Iterator[None]:
    """Exit with status 2 where the command cannot answer."""
    from worldline_core.errors import WorldLineError

    try:
        yield
    except WorldLineError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from error


def _embodiment_list(_arguments: argparse.Namespace) -> None:
    from worldline_core.geometry.embodiment_report import list_embodiments

    print(list_embodiments())


def _embodiment_check(arguments: argparse.Namespace) -> None:
    from worldline_core.geometry.embodiment import load_embodiment
    from worldline_core.geometry.embodiment_report import check_embodiment, format_check

    check = check_embodiment(load_embodiment(arguments.name, arguments.description), arguments.samples)
    print(format_check(check))
    if not check["passed"]:
        raise SystemExit(1)


def _serve(arguments: argparse.Namespace) -> None:
    """Load the model and serve until interrupted."""
    from worldline_core.config import apply_overrides, load_config, validate
    from worldline_core.errors import needing
    from worldline_core.serving.serve_config import ServeConfig

    overrides = tuple(arguments.overrides)
    if arguments.config is not None:
        config = load_config(ServeConfig, path=arguments.config, overrides=overrides)
    else:
        config = validate(ServeConfig, apply_overrides({}, overrides), where="--set")
    with needing("serve", "The server"):
        import msgpack  # noqa: F401

        from worldline_core.serving.app import listening_socket, make_server, server_token
    from worldline_core.rollout.worldline import WorldLine
    from worldline_core.shipped import project_path

    token, project = server_token(config), Path.cwd()
    folders = [name for name in ("model", "tokenizer", "decoder", "episodes") if getattr(config, name) is not None]
    config = config.model_copy(update={name: project_path(project, getattr(config, name)) for name in folders})
    listening = listening_socket(config)  # before the model is loaded: whether there is a port is known at once
    world = WorldLine.from_pretrained(
        config.model,
        tokenizer=config.tokenizer,
        decoder=config.decoder,
        device=config.device,
        bfloat16=config.bfloat16,
        compiled=config.compile,
        steps=config.steps,
    )
    server = make_server(world, config, token)
    host, port = f"[{config.host}]" if ":" in config.host else config.host, listening.getsockname()[1]
    print(f"{config.model} at ws://{host}:{port}/v1", flush=True)
    hint = "" if token is None else "#token=..., with the token of WORLDLINE_TOKEN"
    print(f"drive it by hand at http://{host}:{port}/play{hint}", flush=True)
    server.run(sockets=[listening])


def _doctor(arguments: argparse.Namespace) -> None:
    from worldline_core.doctor import examine_machine, format_findings, third_party_licences

    if arguments.licences:
        print("\n".join(third_party_licences(Path.cwd())))
        return
    findings = examine_machine(Path.cwd())
    if arguments.json:
        from dataclasses import asdict

        print(json.dumps([asdict(finding) for finding in findings], indent=1))
    else:
        print(format_findings(findings))


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of the console command, which works in a child process; with `argv` it works in this one."""
    from worldline_core.scale.process import keep_freed_memory

    # Early: threads that have allocated keep the arena that they have.
    keep_freed_memory()
    # Threads that spin at barriers take the cores from video decoders, browsers and servers beside them. Read when torch is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    arguments = build_parser().parse_args(argv)
    if argv is None:
        continues = arguments.run in (_pipeline, _nightly, _ablations, _task, _record)
        run_supervised(lambda: exit_with_clear_errors(lambda: arguments.run(arguments)), continues=continues)
    else:
        exit_with_clear_errors(lambda: arguments.run(arguments))


if __name__ == "__main__":
    main()
