"""``worldline plan``: what every stage of a preset takes, before anything is there."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_plan_command(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of the whole command line."""
    from tasks.command_line import add_config_arguments

    plan = commands.add_parser(
        "plan",
        help="what every stage of a preset takes: memory, time, and the setting that would fit",
        description="Memory a device, seconds a step and hours of every stage, from the configuration alone; nothing is"
        " loaded. Exit status: 0 everything fits, 1 something does not.",
    )
    add_config_arguments(plan)
    plan.add_argument("--gpus", type=int, default=8, help="devices that share the trainings (default: 8)")
    plan.add_argument("--memory", default="80GB", metavar="SIZE", help="memory of each (default: 80GB)")
    plan.add_argument("--card", default="H100", help="whose peak rates: A100, H100, H200, B200 (default: H100)")
    plan.add_argument(
        "--utilisation", type=float, default=0.4, help="share of the card's peak that is reached (default: 0.4)"
    )
    plan.add_argument("--json", action="store_true", help="print JSON")
    plan.set_defaults(run=_plan)


def _plan(arguments: argparse.Namespace) -> None:
    import json

    from worldline_core.config import load_config, preset_path

    preset = arguments.preset or (None if arguments.config else "demo")
    if preset is not None:
        preset_path(preset)  # answers before torch is imported
    from worldline_core.pipeline.pipeline_config import PipelineConfig
    from worldline_core.pipeline.planner import Planner
    from worldline_core.pipeline.sheet import Machine, as_json, as_text

    machine = Machine.of(arguments.gpus, arguments.memory, arguments.card, arguments.utilisation)
    config = load_config(PipelineConfig, preset=preset, path=arguments.config, overrides=arguments.overrides)
    rows = list(Planner(config, Path.cwd(), machine).rows())
    print(json.dumps(as_json(machine, rows), indent=1) if arguments.json else as_text(machine, rows))
    raise SystemExit(0 if all(row.fits for row in rows) else 1)
