"""The flow of the paper's ablations: every variant is trained and evaluated, and one table is made of all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from prefect import flow

from flows.pipeline import Inputs, choose, evaluate, predict, prepare, prepare_banks, train
from tasks.ablation_table import ablation_table
from tasks.execution.artifact_task import variant
from tasks.execution.prefect_run import ArtifactReference, PrefectRun
from worldline_core.pipeline.ablations import FULL, METHOD, LoadConfig, choose_variants, variant_config
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.report.ablation_table import AblationTableConfig, Variant


@flow(name="ablations")
def ablations(
    preset: str | None = "tiny",
    config: Path | None = None,
    overrides: tuple[str, ...] = (),
    artifacts: Path = Path("artifacts"),
    variants: tuple[str, ...] | None = None,
) -> ArtifactReference:
    """The full model and its variants (default: all five). Returns the table."""
    load = partial(load_changed, preset, config, overrides)
    with PrefectRun(artifacts.resolve(), load([]).runner) as run:
        compare_variants(load, choose_variants(variants))
    return run.artifacts[ablation_table.name]


def compare_variants(load: LoadConfig, variants: Mapping[str, Variant]) -> None:
    """The chain of every variant up to its evaluations, and the table. Equal calls of several variants are one call."""
    scores: dict[str, Inputs] = {}
    for name, changes in variants.items():
        settings = variant_config(load, changes)
        with variant("" if name == FULL else name):
            (_, data), banks = prepare(settings), prepare_banks(settings)
            trained = train(settings, data)
            made = evaluate(settings, data, predict(settings, data, trained))
            made |= choose(settings, banks, predict(settings, banks, trained, banks=True))
            for step, call in made.items():
                scores.setdefault(step, {})[name] = call
    ablation_table.submit(AblationTableConfig(method=METHOD, variants=dict(variants)), **scores)


def load_changed(
    preset: str | None, config: Path | None, overrides: Sequence[str], changes: Sequence[str]
) -> PipelineConfig:
    """The run's configuration with some more overrides."""
    return PipelineConfig.load(preset, config, [*overrides, *changes])
