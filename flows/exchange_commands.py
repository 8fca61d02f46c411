"""The verbs that hand recordings, predictions and figures to others: card, compare, export, push, pull."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def add_exchange_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add them to the command line's parser."""
    card = commands.add_parser("card", help="write the card of an EpisodeSet or a checkpoint: README.md")
    card.add_argument(
        "artifact", type=Path, metavar="FOLDER", help="an EpisodeSet, curated or filtered, or a checkpoint"
    )
    card.add_argument("--artifacts", type=Path, default=Path("artifacts"), help="the store whose evaluations count")
    card.add_argument("--license", metavar="NAME", help="of a checkpoint's weights, as the hub writes it (apache-2.0)")
    card.add_argument("--output", type=Path, default=None, help="where the card goes (default: FOLDER/run/card)")
    card.add_argument("--title", default=None, help="its heading (default: EpisodeSet and the folder's name)")
    card.set_defaults(run=_card)
    export = commands.add_parser(
        "export", help="write episodes, predictions or a model for others: MCAP, Rerun, video, LeRobotDataset"
    )
    export.add_argument("artifact", type=Path, metavar="FOLDER", help="an EpisodeSet, a RolloutSet or a checkpoint")
    export.add_argument(
        "--format", action="append", required=True, dest="formats",
        choices=("lerobot", "mcap", "mcap-ros2", "rrd", "mp4", "worldarena", "worldarena-archive", "model", "diffusers"),
        help="repeatable; lerobot: EpisodeSets only, mp4 and worldarena (for its metrics, or as an archive to submit): RolloutSets only; mcap: Foxglove's schemas;"
        " model: a checkpoint with its tokenizer; diffusers: Cosmos3 as diffusers and vLLM-Omni run it, without controls",
    )  # fmt: skip
    export.add_argument("--output", type=Path, required=True, help="where the files go")
    export.add_argument(
        "--episode", action="append", default=[], metavar="ID", dest="episodes", help="only this one (repeatable)"
    )
    export.add_argument("--outcome", help="only recordings that ended so: success, failure, ..; EpisodeSets only")
    export.add_argument(
        "--episodes", type=Path, metavar="FOLDER", dest="episode_set", help="the EpisodeSet of predictions"
    )
    export.add_argument(
        "--pretrained", type=Path, metavar="FOLDER", help="diffusers only: the published folder that was imported"
    )
    export.set_defaults(run=_export)
    compare = commands.add_parser(
        "compare", help="compare two runs on the same recordings: paired differences with intervals",
        description="A run is the folder of an evaluation or a report, or HISTORY:NIGHT (artifacts/nightly:2026-11-21).",
    )  # fmt: skip
    compare.add_argument("first", metavar="RUN_A")
    compare.add_argument(
        "second", metavar="RUN_B", nargs="?",
        help="without: what calibrating gains within the first, by rollouts of one checkpoint with cameras and without",
    )  # fmt: skip
    compare.add_argument("--methods", nargs=2, metavar=("A", "B"), help="this method of the first, that of the second")
    compare.add_argument("--metric", action="append", default=[], metavar="NAME", help="only this one (repeatable)")
    compare.add_argument("--json", action="store_true", help="print JSON")
    compare.set_defaults(run=_compare)
    places = "hf://datasets/ORG/NAME (token: HF_TOKEN), a URL such as s3://bucket/folder, or a folder"
    push = commands.add_parser("push", help="publish an EpisodeSet with its dataset card")
    push.add_argument("artifact", type=Path, metavar="FOLDER")
    push.add_argument("where", metavar="WHERE", help=places)
    push.add_argument("--public", action="store_true", help="others may read it there (default: a private repository)")
    push.add_argument(
        "--allow-restricted", action="store_true",
        help="push although a source's licence forbids it or does not say: you have the right",
    )  # fmt: skip
    push.set_defaults(run=_push)
    pull = commands.add_parser("pull", help="fetch a published EpisodeSet and compare every file with its digest")
    pull.add_argument("where", metavar="WHERE", help=places)
    pull.add_argument("folder", type=Path, metavar="FOLDER", help="a new folder")
    pull.set_defaults(run=_pull)


def _card(arguments: argparse.Namespace) -> None:
    output = arguments.output or arguments.artifact / "run" / "card"
    if (arguments.artifact / "checkpoint.json").is_file():
        from worldline_core.model.model_card import write_model_card
        from worldline_core.report.results import evaluations_of_store, measurements

        found = measurements(arguments.artifact, evaluations_of_store(arguments.artifacts))
        print(f"wrote {write_model_card(arguments.artifact, output, found, arguments.license)}")
        return
    from worldline_core.report.data import write_card

    print(f"wrote {write_card(arguments.artifact, output, arguments.title)}")


def _compare(arguments: argparse.Namespace) -> None:
    from worldline_core.report.comparison import as_table, compare_runs, drawn_and_not

    pairs = [None if arguments.methods is None else (arguments.methods[0], arguments.methods[1])]
    if arguments.second is None and arguments.methods is None:
        pairs = drawn_and_not(arguments.first)
        print(
            "What calibrating gains: maps drawn through the cameras - control vectors alone, of one checkpoint",
            file=sys.stderr,
        )
    second = arguments.second or arguments.first
    rows = [row for methods in pairs for row in compare_runs(arguments.first, second, methods, arguments.metric)]
    if arguments.json:
        import json
        from dataclasses import asdict

        print(json.dumps([asdict(row) for row in rows], indent=1))
    else:
        print(as_table(rows))


def _export(arguments: argparse.Namespace) -> None:
    from worldline_core.exports.export import export

    for path in export(
        arguments.artifact,
        arguments.output,
        arguments.formats,
        episode_ids=arguments.episodes,
        outcome=arguments.outcome,
        episodes=arguments.episode_set,
        pretrained=arguments.pretrained,
    ):
        print(f"wrote {path}")


def _push(arguments: argparse.Namespace) -> None:
    from worldline_core.publishing import push

    pushed = push(
        arguments.artifact, arguments.where, public=arguments.public, allow_restricted=arguments.allow_restricted
    )
    print(f"{arguments.where}  {len(pushed.files)} files  {pushed.num_bytes / 2**20:.1f} MiB")


def _pull(arguments: argparse.Namespace) -> None:
    from worldline_core.publishing import pull

    pulled = pull(arguments.where, arguments.folder)
    print(f"{arguments.folder}  {len(pulled.files)} files  {pulled.num_bytes / 2**20:.1f} MiB")
