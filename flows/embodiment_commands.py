"""The verbs that list robots, and compare the kinematics of one with MuJoCo."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_embodiment_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add them to the command line's parser."""
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
