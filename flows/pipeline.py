"""The main flow: from recordings to a report."""

from __future__ import annotations

from pathlib import Path

from prefect import flow

from tasks.artifact_task import ArtifactReference, artifact_task
from worldline_core.config import load_config
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.pipeline.plan import plan


@flow(name="pipeline", flow_run_name="pipeline-{preset}", retries=0)
def pipeline(
    preset: str | None = "tiny",
    config: Path | None = None,
    overrides: tuple[str, ...] = (),
    artifacts: Path = Path("artifacts"),
) -> ArtifactReference:
    """Curate, filter, render actions, encode latents, train, distill, roll out, evaluate, report.

    Each node of the plan is one Prefect task; finished artifacts are found, not made again. Returns the report.
    """
    settings = load_config(PipelineConfig, preset=None if config else preset, path=config, overrides=overrides)
    done: dict[str, ArtifactReference] = {}
    for node in plan(settings, Path.cwd()):
        inputs = {name: done[source] if isinstance(source, str) else source for name, source in node.inputs.items()}
        done[node.name] = artifact_task(node.step)(
            node.config, inputs, store_root=artifacts.resolve(), name=node.name, runner=settings.runner
        )
    return done["report"]
