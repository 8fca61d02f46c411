"""One step as a flow: what the single-step deployments run."""

from __future__ import annotations

from pathlib import Path

from prefect import flow

from tasks.artifact_task import ArtifactReference, artifact_task
from worldline_core.config import load_config
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.pipeline.plan import choose_node, plan, ready_node
from worldline_core.store.store import ArtifactStore


@flow(name="step", flow_run_name="{step}-{preset}")
def run_step(
    step: str,
    preset: str | None = "tiny",
    config: Path | None = None,
    overrides: tuple[str, ...] = (),
    artifacts: Path = Path("artifacts"),
    node: str | None = None,
    inputs: dict[str, Path] | None = None,
) -> ArtifactReference:
    """One step on the finished artifacts of those before it, as ``worldline task`` runs it.

    ``node`` names one of several nodes of a step (``rollout.shipped_stage2``); ``inputs`` are folders taken instead of the
    artifacts that the run would use. What is not finished yet is named, with the command that makes it.
    """
    settings = load_config(PipelineConfig, preset=None if config else preset, path=config, overrides=overrides)
    nodes, store = plan(settings, Path.cwd()), ArtifactStore(artifacts.resolve(), settings.runner.verify)
    chosen, folders = ready_node(choose_node(step, node, nodes), nodes, store, inputs)
    return artifact_task(step)(chosen.config, folders, store_root=store.root, name=chosen.name, runner=settings.runner)
