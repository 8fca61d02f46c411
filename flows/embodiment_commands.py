"""The verbs that list robots, show one, and prove its kinematics."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_embodiment_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add them to the command line's parser."""
    embodiment = commands.add_parser("embodiment", help="list robots, show one, prove its kinematics")
    actions = embodiment.add_subparsers(dest="embodiment_command", required=True, metavar="ACTION")
    listing = actions.add_parser("list", help="all robots: arms, state size, whether the description is here, verified")
    listing.set_defaults(run=_embodiment_list)
    show = actions.add_parser("show", help="state columns, limits, grippers, tools and cameras of a robot")
    show.set_defaults(run=_embodiment_show)
    check = actions.add_parser(
        "check",
        help="compare forward kinematics with MuJoCo (extra: sim)",
        description="Compare forward kinematics with MuJoCo at random joint positions within the limits. Exit status:"
        " 0 all frames agree, 1 not (or nothing could be compared), 2 wrong usage.",
    )
    check.add_argument("--samples", type=int, default=1000, help="random joint positions (default: 1000)")
    check.add_argument("--seed", type=int, default=0)
    check.set_defaults(run=_embodiment_check)
    for action in (show, check):
        action.add_argument("name", metavar="NAME", help="a name of the list, or a YAML file")
        action.add_argument("--description", type=Path, metavar="FILE", help="the kinematic description to use")
    for action in (listing, check):
        action.add_argument("--json", action="store_true", help="print JSON")


def _embodiment_list(arguments: argparse.Namespace) -> None:
    from worldline_core.geometry.embodiment_report import format_list, list_embodiments

    rows = list_embodiments()
    if arguments.json:
        import json

        print(json.dumps(rows, indent=1))
    else:
        print(format_list(rows))


def _embodiment_show(arguments: argparse.Namespace) -> None:
    from worldline_core.geometry.embodiment import load_embodiment
    from worldline_core.geometry.embodiment_report import describe_embodiment

    print(describe_embodiment(load_embodiment(arguments.name, arguments.description)))


def _embodiment_check(arguments: argparse.Namespace) -> None:
    from worldline_core.geometry.embodiment import load_embodiment
    from worldline_core.geometry.embodiment_report import check_embodiment, format_check

    check = check_embodiment(load_embodiment(arguments.name, arguments.description), arguments.samples, arguments.seed)
    if arguments.json:
        import json

        print(json.dumps(check, indent=1))
    else:
        print(format_check(check))
    if not check["passed"]:
        raise SystemExit(1)
