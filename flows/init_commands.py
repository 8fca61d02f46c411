"""The verb that looks at recordings and writes a configuration for them."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_init_command(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add it to the command line's parser."""
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


def _init(arguments: argparse.Namespace) -> None:
    import json

    from worldline_core.discovery.configuration import write_config
    from worldline_core.discovery.hub import fetch_sample, hub_id
    from worldline_core.discovery.look import discover
    from worldline_core.discovery.report import as_json, as_text

    hub = None if (name := hub_id(arguments.recordings)) is None else fetch_sample(name)
    found = discover(Path(arguments.recordings) if hub is None else hub.folder)
    write_config(found, arguments.output, arguments.recordings)
    commands = ([hub.command] if hub is not None else []) + [f"worldline task curate --config {arguments.output}"]
    print(
        json.dumps(as_json(found, arguments.output, commands), indent=1)
        if arguments.json
        else as_text(found, arguments.output, commands)
    )
