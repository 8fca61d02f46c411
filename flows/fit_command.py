"""`worldline fit`: one command from recordings of one's own to a simulator that can be driven."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tasks.execution.command_line import add_overrides
from tasks.execution.temporary_server import prepare_prefect, start_server_early

if TYPE_CHECKING:
    from worldline_core.pipeline.pipeline_config import PipelineConfig

SHARES = {
    "train_stage1": 0.2,
    "train_stage2": 0.5,
    "distill.teacher_forcing": 0.15,
    "distill.trajectory_regression": 0.075,
    "distill.distribution_matching": 0.075,
}
"""Parts of the minutes that each training gets."""
ROLLOUTS = ("stage2", "stage2_shuffled", "causal")
IGNORED_AFTER = 300
"""Steps of Stage II after which a small model that listens to its controls does so measurably."""


def add_fit_command(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add it to the command line's parser."""
    fit = commands.add_parser(
        "fit",
        help="from recordings of your own to a simulator that you can drive, in one command",
        description="Look at the recordings (as `init` does), estimate uncalibrated cameras, read, filter, train,"
        " distill, evaluate, report. Interrupted or stopped, the same command continues. It stops, with the next step, where"
        " a person has to decide.",
    )
    fit.add_argument("recordings", metavar="PATH_OR_HUB_ID", help="a folder, an MCAP file, or ORG/NAME of the hub")
    fit.add_argument(
        "--config", type=Path, default=Path("my.yaml"), metavar="FILE",
        help="written by the first call, and read when it is there (default: my.yaml)",
    )  # fmt: skip
    fit.add_argument(
        "--minutes",
        type=float,
        metavar="N",
        help="of training, all stages together (default: 20, on a card what its preset says)",
    )
    fit.add_argument(
        "--gpu", metavar="CARD",
        help="train and predict on the GPU: its memory or name (24GB, RTX 4090); the file extends the preset of this size",
    )  # fmt: skip
    fit.add_argument(
        "--stop-when-ignored", type=int, nargs="?", const=IGNORED_AFTER, metavar="STEPS",
        help=f"end a training in which, from this step on, the controls make no difference (default: {IGNORED_AFTER})",
    )  # fmt: skip
    add_overrides(fit)
    fit.add_argument("--artifacts", type=Path, default=Path("artifacts"), help="root of the store (default: artifacts)")
    fit.set_defaults(run=fit_command)


def overrides_of(
    minutes: float | None, gpu: str | None, ignored_after: int | None, config: Mapping[str, Any]
) -> tuple[str, ...]:
    """The options as changes of a configuration, as it was read."""
    changes: list[str] = []
    names, last = list(SHARES), f"distill.{(config.get('distill') or {}).get('last_step')}"
    names = names[: names.index(last) + 1] if last in names else names
    shares = {name: SHARES[name] for name in names if config.get(name.partition(".")[0]) is not None}
    if minutes is not None:
        whole = sum(shares.values())
        changes += [f"{name}.trainer.steps=null" for name in shares]
        changes += [f"{name}.trainer.minutes={share / whole * minutes:.4g}" for name, share in shares.items()]
    if gpu is not None:
        changes += [f"{key}=cuda" for key in ("encode_latents.device", *(f"{name}.trainer.device" for name in shares))]
        changes += [f"rollouts.{name}.config.device=cuda" for name in ROLLOUTS]
    if ignored_after is not None:
        changes.append(f"train_stage2.action_following.stop_when_ignored={ignored_after}")
    return tuple(changes)


def check_sources(config: PipelineConfig, recordings: Path, file: Path) -> None:
    """Raises: ConfigError: the file is of other recordings, or these have no controls."""
    from worldline_core.errors import ConfigError

    given, named = recordings.resolve(), [Path(str(source.path)).resolve() for source in config.curate.sources]
    if not any(given.is_relative_to(path) or path.is_relative_to(given) for path in named):
        raise ConfigError(
            "The configuration is of other recordings", where=file, expected=str(given), got=", ".join(map(str, named)),
            next_step="give another file (--config other.yaml), or its own recordings",
        )  # fmt: skip
    if {source.kind for source in config.curate.sources} == {"video_folder"}:
        raise ConfigError(
            "Videos alone say nothing about controls, which a simulator is driven by", where=given,
            expected="recordings with states or actions", got="kind: video_folder",
            next_step=f"Stage I learns from them: worldline task curate --config {file}, then filter, encode_latents, train_stage1",
        )  # fmt: skip


def check_card(config: PipelineConfig, file: Path, memory: str) -> None:
    """Raises: UnavailableError: there is no GPU. ConfigError: a training does not fit so much memory."""
    from worldline_core.errors import ConfigError
    from worldline_core.model.tokenizers import require_device
    from worldline_core.pipeline.cards import card_memory
    from worldline_core.pipeline.size_sheet import SizeSheet

    require_device("cuda")
    card = {"config": config, "project": Path.cwd(), "memory": card_memory(memory)}
    sheet = SizeSheet.model_validate(card)
    if too_large := [row.title for row in sheet.rows() if not row.fits(sheet.bytes)]:
        raise ConfigError(
            "A training does not fit this card", where="--gpu", expected=memory, got=", ".join(too_large),
            next_step=f"worldline plan --config {file} --fit --gpus 1 --memory {sheet.bytes / 1e9:g}GB",
        )  # fmt: skip


def fit_command(arguments: argparse.Namespace) -> None:
    """Write the configuration or take the one that is there, check it, and run the flow."""
    from worldline_core.discovery.look import fetch_dataset, hub_id

    recordings = Path(arguments.recordings) if (name := hub_id(arguments.recordings)) is None else fetch_dataset(name)
    if not arguments.config.exists():
        from worldline_core.discovery.findings import as_text, write_config
        from worldline_core.discovery.look import discover
        from worldline_core.pipeline.cards import card_memory, preset_for

        found = discover(recordings)
        preset = preset_for(0 if arguments.gpu is None else card_memory(arguments.gpu))
        write_config(found, arguments.config, arguments.recordings, preset)
        print(as_text(found, arguments.config, []))
    from worldline_core.config import read_config

    options = (arguments.minutes, arguments.gpu, arguments.stop_when_ignored, read_config(None, arguments.config))
    changes = (*overrides_of(*options), *arguments.overrides)
    from worldline_core.pipeline.pipeline_config import PipelineConfig, check_recordings, check_weights

    config = PipelineConfig.load(None, arguments.config, changes)
    check_sources(config, recordings, arguments.config)
    check_recordings(config, Path.cwd())
    check_weights(config, Path.cwd())
    if arguments.gpu is not None:
        check_card(config, arguments.config, arguments.gpu)
    prepare_prefect(arguments.artifacts)
    start_server_early()
    from flows.fit import fit
    from tasks.execution.prefect_artifacts import run_flow

    print(f"how far it is, and then the report: {arguments.artifacts / 'report' / 'latest' / 'index.html'}")
    report = run_flow(fit, arguments.config, changes, arguments.artifacts)
    latest = arguments.artifacts / "latest"
    print(f"report: {report.path / 'index.html'}")
    print(f"drive it: worldline play --set model={latest / 'distill'} --set episodes={latest / 'filter'}")
