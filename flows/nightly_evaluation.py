"""The nightly flow: roll out and evaluate the shipped checkpoints, and compare with the nights before."""

from __future__ import annotations

from pathlib import Path

from prefect import flow, task

from flows.pipeline import evaluate, predict, prepare
from tasks.execution.artifact_task import Inputs
from tasks.execution.prefect_artifacts import show_in_prefect
from tasks.execution.prefect_run import PrefectRun
from tasks.report import report
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.report.comparison import NightlyComparison, compare_with_history, refuse_regressions


@task(name="compare_nights", persist_result=False)
def compare_nights(done: dict[str, Path], history: Path, night: str | None) -> NightlyComparison:
    """Append this night's scores to the history and write the comparison."""
    scores = {name: path for name, path in done.items() if name.startswith("evaluate_")}
    return compare_with_history(scores, history, night)


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
    settings = PipelineConfig.load(preset, config, overrides)
    settings.check_night()
    with PrefectRun(artifacts.resolve(), settings.runner) as run:
        curated, data, banks = prepare(settings)
        models: Inputs = {**settings.model_folders()}
        predicted = predict(settings, data, banks, models, trained={})
        scores = evaluate(settings, data, banks, models, predicted)
        made = {"curate": curated, "filter": data["episodes"], "render_actions": data["tracks"], **scores}
        report.submit(settings.report, **made, rollout=predicted, models=models)
    history = artifacts.resolve() / "nightly"
    compared = compare_nights({name: made.folder for name, made in run.artifacts.items()}, history, night)
    show_in_prefect(history, run.artifacts, compared.verdicts)
    refuse_regressions(compared, history)
    return history
