"""The flow of the ablations: every variant is trained and evaluated with every seed, and one table is made of all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from prefect import flow

from flows.pipeline import evaluate, predict, prepare, prepare_models, train
from tasks.ablation_table import ablation_table
from tasks.execution.artifact_task import Inputs, variant
from tasks.execution.prefect_run import ArtifactReference, PrefectRun
from worldline_core.pipeline.ablations import METHOD, LoadConfig, choose_variants, variant_config
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.report.ablation_table import FULL, AblationTableConfig, Variant


@flow(name="ablations")
def ablations(
    preset: str | None = "tiny",
    config: Path | None = None,
    overrides: tuple[str, ...] = (),
    artifacts: Path = Path("artifacts"),
    variants: tuple[str, ...] | None = None,
    variants_file: Path | None = None,
    seeds: tuple[int, ...] = (),
) -> ArtifactReference:
    """The full model and its variants (default: the paper's five). Returns the table.

    ``variants_file`` holds other variants, of the same form as the paper's (`worldline_core/report/ablations.yaml`).
    ``seeds``: of the trainings, each of which is made with every seed; none: the configured ones, once.
    """
    load = partial(load_changed, preset, config, overrides)
    with PrefectRun(artifacts.resolve(), load([]).runner) as run:
        compare_variants(load, choose_variants(variants, variants_file), seeds)
    return run.artifacts[ablation_table.name]


def compare_variants(load: LoadConfig, variants: Mapping[str, Variant], seeds: Sequence[int] = ()) -> None:
    """The chain of every variant up to its evaluations, and the table. Equal calls of several variants are one call."""
    scores: dict[str, Inputs] = {}
    runs = [(name, seed) for seed in seeds or (None,) for name in variants]  # a table of the first seed comes first
    for name, seed in runs:
        c = variant_config(load, variants[name], seed)
        suffix = [] if name == FULL else [name]
        with variant(".".join([*suffix, *([] if seed is None else [f"seed_{seed}"])])):
            _, data, banks = prepare(c)
            models = prepare_models(c, data)
            predicted = predict(c, data, banks, models, train(c, data, models))
            for step, call in evaluate(c, data, banks, models, predicted).items():
                scores.setdefault(step, {})[f"{name}.{seed or 0}"] = call
    table = AblationTableConfig(method=METHOD, variants=dict(variants), seeds=tuple(seeds) or (0,))
    ablation_table.submit(table, **scores)


def load_changed(
    preset: str | None, config: Path | None, overrides: Sequence[str], changes: Sequence[str]
) -> PipelineConfig:
    """The run's configuration with some more overrides."""
    return PipelineConfig.load(preset, config, [*overrides, *changes])
