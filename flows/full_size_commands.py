"""Commands before a full-size run: `worldline plan` estimates what every stage takes; `worldline
rehearse`, the whole of a preset at small size, on the processor."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from tasks.execution.command_line import add_config_arguments, add_preset_arguments, chosen_preset
from tasks.execution.temporary_server import prepare_prefect


def add_plan_command(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of the whole command line."""
    plan = commands.add_parser(
        "plan",
        help="memory that every stage of a preset takes, and planned hours",
        description="Memory a device of every stage and, of a card that is known, planned seconds, hours and frames a second, from the configuration"
        " alone; nothing is loaded. Exit status: 0 everything fits, 1 something does not.",
    )
    add_config_arguments(plan)
    plan.add_argument("--gpus", type=int, default=1, help="devices that share the trainings (default: 1)")
    plan.add_argument(
        "--card", metavar="NAME", help="RTX 4090, H100, ... (default: the preset's own, without --memory)"
    )
    plan.add_argument("--memory", metavar="SIZE", help="memory of each (default: the card's)")
    plan.add_argument(
        "--fit",
        action="store_true",
        help="propose the largest setting that fits, not larger than the preset's; without a preset, of the one made for"
        " such a card (a minute or more)",
    )
    plan.set_defaults(run=_plan)


def _plan(arguments: argparse.Namespace) -> None:
    from worldline_core.config import preset_path, validate
    from worldline_core.pipeline.cards import card_memory, preset_for

    preset, machine = arguments.preset, arguments.memory or arguments.card
    if preset is None and arguments.config is None:
        preset = preset_for(card_memory(machine)) if arguments.fit and machine else "demo"
    if preset is not None:
        preset_path(preset)  # answers before torch is imported
    from worldline_core.pipeline.memory_estimate import Estimate
    from worldline_core.pipeline.pipeline_config import PipelineConfig
    from worldline_core.pipeline.size_sheet import SizeSheet

    def load(changes: Sequence[str] = ()) -> PipelineConfig:
        return PipelineConfig.load(preset, arguments.config, [*arguments.overrides, *changes])

    def sheet(config: PipelineConfig) -> SizeSheet:
        card = arguments.card or (None if arguments.memory else config.card)
        values = {"config": config, "project": Path.cwd(), "devices": arguments.gpus}
        return validate(SizeSheet, {**values, "memory": arguments.memory, "card": card}, where="worldline plan")

    config, rows = load(), None
    if arguments.fit:
        from worldline_core.pipeline.smaller import largest_fitting

        fitting: list[list[Estimate]] = []

        def fits(smaller: PipelineConfig) -> bool:
            found = sheet(smaller).fitting_rows()
            fitting.extend([] if found is None else [found])
            return found is not None

        changes = largest_fitting(load, fits)
        shown = [f"--set '{one}'" for one in changes] or ["nothing"]
        print(f"what changes of {preset or arguments.config}:", *shown, sep="\n  ")
        config, rows = load(changes), fitting[-1]  # of settings that fit the largest is tried last
    planned = sheet(config)
    rows, rollouts = planned.rows_and_rollouts(rows)
    print(planned.as_text(rows, rollouts))
    raise SystemExit(0 if all(row.fits(planned.bytes) for row in rows) else 1)


def add_rehearse_command(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add it to the command line's parser."""
    rehearse = commands.add_parser(
        "rehearse",
        help="run a full-size preset at small size, with small random versions of every outside model",
        description="Make small random-weight versions of every outside model and small recordings in a folder, and run"
        " the preset's own plan on them, from the import of the backbone to the report, and the five ablations. Sizes alone change; each change is printed. Nothing is learnt: what"
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
    prepare_prefect(arguments.output / "artifacts")  # before the imports below, which import Prefect
    from flows.rehearse import train_in_processes
    from worldline_core.rehearsal.rehearsal import prepare, table

    path = None if arguments.config is None else arguments.config.resolve()
    preset = chosen_preset(arguments, "cosmos3-nano")
    with_ablations = not arguments.without_ablations
    changes, besides = prepare(arguments.output, preset, path, arguments.overrides, ablations=with_ablations)
    print(table(changes))
    overrides = (*arguments.overrides, *(change.override for change in changes))
    os.chdir(arguments.output)
    artifacts = Path("artifacts")
    train_in_processes(preset, path, overrides, artifacts, arguments.processes)
    from flows.pipeline import pipeline

    report = pipeline(preset, path, overrides, artifacts)
    print(f"report: {report.path / 'index.html'}")
    if not with_ablations:
        return
    from flows.ablations import ablations

    print("\nbesides, in the ablations:", table(besides), sep="\n")
    ablated = ablations(preset, path, (*overrides, *(change.override for change in besides)), artifacts)
    print((Path(ablated.path) / "table.md").read_text(), f"ablations: {ablated.path / 'table.md'}", sep="\n")
