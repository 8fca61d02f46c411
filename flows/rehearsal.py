"""`worldline rehearse`: the whole of a full-size preset at small size, on the processor, before it runs on many GPUs."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from tasks.command_line import add_preset_arguments
from tasks.temporary_server import prepare_prefect


def add_rehearse_command(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add it to the command line's parser."""
    rehearse = commands.add_parser(
        "rehearse",
        help="run a full-size preset at small size, with small random versions of every outside model",
        description="Make small random-weight versions of every outside model and small recordings in a folder, and run"
        " the preset's own plan on them, from the import of the backbone to the report, a second distillation that reads"
        " clips the other way, and the five ablations. Sizes alone change; each change is printed. Nothing is learnt: what"
        " ends with an error here ends with it on many GPUs too.",
    )
    add_preset_arguments(rehearse, "cosmos3-nano")
    rehearse.add_argument(
        "--output", type=Path, default=Path("rehearsal"), help="folder of weights, recordings and artifacts"
    )
    rehearse.add_argument("--processes", type=int, default=2, help="that share each training (default: 2)")
    rehearse.add_argument(
        "--without-ablations", action="store_true", help="end with the report of the preset's own plan"
    )
    rehearse.set_defaults(run=rehearse_command)


def rehearse_command(arguments: argparse.Namespace) -> None:
    """Prepare the folder, train in several processes, let the flow do the rest, and report."""
    from tasks.rehearse import train_in_processes
    from worldline_core.rehearsal.rehearsal import prepare, table

    path = None if arguments.config is None else arguments.config.resolve()
    preset = arguments.preset or (None if path else "cosmos3-nano")
    with_ablations = not arguments.without_ablations
    changes, again, besides = prepare(arguments.output, preset, path, arguments.overrides, ablations=with_ablations)
    print(table(changes))
    overrides = (*arguments.overrides, *(change.override for change in changes))
    os.chdir(arguments.output)
    artifacts = Path("artifacts")
    train_in_processes(preset, path, overrides, artifacts, arguments.processes)
    print("\nbesides, in a second distillation, which reads clips the other way:", table(again), sep="\n")
    distilled_again = (*overrides, *(change.override for change in again))
    train_in_processes(preset, path, distilled_again, artifacts, arguments.processes)
    prepare_prefect(artifacts)
    from flows.pipeline import pipeline

    report = pipeline(preset, path, overrides, artifacts)
    print(f"report: {report.path / 'index.html'}")
    if not with_ablations:
        return
    from flows.ablations import ablations

    print("\nbesides, in the ablations:", table(besides), sep="\n")
    ablated = ablations(preset, path, (*overrides, *(change.override for change in besides)), artifacts)
    print((Path(ablated.path) / "table.md").read_text(), f"ablations: {ablated.path / 'index.html'}", sep="\n")
