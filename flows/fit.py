"""From a folder of recordings to a simulator of them: cameras are estimated where none is known, then the chain runs."""

from __future__ import annotations

import json
from pathlib import Path

from prefect import flow

from flows.pipeline import chain
from tasks.estimate_cameras import estimate_cameras
from tasks.execution.prefect_artifacts import STORE, run_chain
from tasks.execution.prefect_run import ArtifactReference, PrefectRun
from worldline_core.calibration.estimate.estimate_config import CAMERAS, ESTIMATE, EstimateConfig
from worldline_core.data.episodes.conventions import with_image_lags
from worldline_core.evaluation.recordings import HEAD
from worldline_core.pipeline.pipeline_config import PipelineConfig


@flow(name="fit", flow_run_name="fit-{config}", retries=0)
def fit(config: Path, overrides: tuple[str, ...] = (), artifacts: Path = STORE) -> ArtifactReference:
    """Estimated cameras, where recordings have none, and then everything that `pipeline` does. Finished steps are not repeated."""
    settings = PipelineConfig.load(None, config, overrides)
    drawn = settings.render_actions
    wanted = EstimateConfig.of(settings.curate, {} if drawn is None else drawn.description_paths)
    if wanted is not None:
        with PrefectRun(artifacts.resolve(), settings.runner) as run:
            estimate_cameras.submit(wanted, source=settings.sources_of(settings.curate, {}))
        cameras = run.artifacts["estimate_cameras"].folder / CAMERAS
        settings = with_cameras(settings, cameras) if cameras.is_file() else settings
    return run_chain(chain, settings, settings.runner, artifacts.resolve())["report"]


def with_cameras(settings: PipelineConfig, cameras: Path) -> PipelineConfig:
    """The run with the estimate of its one source: controls are drawn into the views of the calibration file, the others take the
    commands (which a model of maps alone does not learn), and pictures are read as late as they were measured to be.
    """
    source = settings.curate.sources[0]
    lags = json.loads((cameras.parent / ESTIMATE).read_text())["image_lags"]
    update = {"calibration": str(cameras), "conventions": with_image_lags(source.conventions, lags)}
    source = source.model_copy(update=update)
    curate = settings.curate.model_copy(update={"sources": (source,)})
    drawn = settings.render_actions or PipelineConfig.load("tiny").render_actions
    views = json.loads(cameras.read_text())["views"]
    stage2, segmenter = settings.train_stage2, settings.train_segmenter if HEAD in views else None
    if set(settings.encode_latents.views) <= set(views):
        stage2 = stage2.model_copy(update={"native_size": None})
    update = {"curate": curate, "render_actions": drawn, "train_segmenter": segmenter, "train_stage2": stage2}
    return settings.model_copy(update=update)
