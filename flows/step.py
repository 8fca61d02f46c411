"""One step as a flow: what the single-step deployments run."""

from __future__ import annotations

from pathlib import Path

from prefect import flow

from flows.pipeline import chain
from tasks.execution.chain import find_call, outline, ready_inputs
from tasks.execution.prefect_run import ArtifactReference, PrefectRun
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.store.store import ArtifactStore


@flow(name="step", flow_run_name="{step}-{preset}")
def run_step(
    step: str,
    preset: str | None = "tiny",
    config: Path | None = None,
    overrides: tuple[str, ...] = (),
    artifacts: Path = Path("artifacts"),
    name: str | None = None,
    inputs: dict[str, Path] | None = None,
) -> ArtifactReference:
    """One step on the finished artifacts of those before it, as ``worldline task`` runs it.

    ``name`` selects one of several calls of a step (``rollout.shipped_stage2``); ``inputs`` are folders used instead of the
    artifacts of the run. An artifact that is not finished yet is named, with the command that makes it.
    """
    settings = PipelineConfig.load(preset, config, overrides)
    calls = outline(chain, settings)
    chosen = find_call(calls, step, name)
    folders = ready_inputs(chosen, calls, ArtifactStore(artifacts, settings.runner.verify), inputs)
    with PrefectRun(artifacts, settings.runner) as run:
        chosen.task.submit(chosen.config, chosen.name, **folders)
    return run.artifacts[chosen.name]
