"""The nightly flow: roll out and evaluate the shipped checkpoints, and compare with the nights before."""

from __future__ import annotations

from pathlib import Path

from prefect import flow, task

from tasks.prefect_artifacts import show_in_prefect
from tasks.run_nodes import run_nodes
from worldline_core.config import load_config
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.pipeline.plan import plan, without_training
from worldline_core.report.comparison import NightlyComparison
from worldline_core.report.nightly import compare_with_history, refuse_regressions


@task(name="compare_nights", persist_result=False)
def compare_nights(done: dict[str, Path], history: Path, night: str | None) -> NightlyComparison:
    """Append this night's scores to the history and write the comparison."""
    scores = {name: path for name, path in done.items() if name.startswith("evaluate_")}
    return compare_with_history(scores, history, night, done)


@flow(name="nightly-evaluation")
def nightly_evaluation(
    preset: str | None = "tiny",
    config: Path | None = None,
    overrides: tuple[str, ...] = (),
    artifacts: Path = Path("artifacts"),
    night: str | None = None,
) -> Path:
    """Rollouts and evaluations of the shipped checkpoints; returns the folder of the comparison.

    A night that became worse than the last good one ends in the state Failed, with the metrics named.
    """
    settings = load_config(PipelineConfig, preset=None if config else preset, path=config, overrides=overrides)
    done = run_nodes(without_training(plan(settings, Path.cwd())), artifacts.resolve(), settings.runner)
    history = artifacts.resolve() / "nightly"
    compared = compare_nights({name: Path(str(reference.path)) for name, reference in done.items()}, history, night)
    show_in_prefect(history, done, [history / file for file in compared.pictures.values()])
    refuse_regressions(compared, history)
    return history
