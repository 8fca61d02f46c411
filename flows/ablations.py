"""The flow of the paper's ablations: every variant is trained and evaluated, and one table is made of all."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from prefect import flow

from tasks.artifact_task import ArtifactReference
from tasks.run_nodes import run_nodes
from worldline_core.config import load_config
from worldline_core.pipeline.ablations import TABLE, ablation_plan
from worldline_core.pipeline.pipeline_config import PipelineConfig


@flow(name="ablations")
def ablations(
    preset: str | None = "tiny",
    config: Path | None = None,
    overrides: tuple[str, ...] = (),
    artifacts: Path = Path("artifacts"),
    variants: tuple[str, ...] | None = None,
) -> ArtifactReference:
    """The full model and its variants (default: all five); what a variant shares with others is made once.

    Returns the table.
    """

    def load(changes: Sequence[str]) -> PipelineConfig:
        return load_config(
            PipelineConfig, preset=None if config else preset, path=config, overrides=[*overrides, *changes]
        )

    nodes = ablation_plan(load, Path.cwd(), variants)
    return run_nodes(nodes, artifacts.resolve(), load([]).runner)[TABLE]
