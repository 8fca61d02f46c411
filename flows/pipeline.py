"""The main flow: from recordings to a report."""

from __future__ import annotations

from pathlib import Path

from prefect import flow

from tasks.artifact_task import ArtifactReference
from tasks.prefect_artifacts import report_pictures, show_in_prefect
from tasks.run_nodes import RunPage, run_nodes
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

    Each node of the plan is one Prefect task; finished artifacts are found, not made again. From the first finished node
    on ``artifacts/report/latest`` shows how far the run is; in the end it leads to the report. Prefect's page of the
    run links to it and has a table of the metrics. Returns the report.
    """
    settings = load_config(PipelineConfig, preset=None if config else preset, path=config, overrides=overrides)
    nodes = plan(settings, Path.cwd())
    with RunPage(artifacts.resolve(), [node.name for node in nodes]) as page:
        done = run_nodes(nodes, artifacts.resolve(), settings.runner, page)
    show_in_prefect(page.folder, done, report_pictures(Path(str(done["report"].path))))
    return done["report"]
