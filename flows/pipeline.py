"""The pipeline: `chain` is its only description, a call for each step. Nightly evaluation and ablations compose its parts."""

from pathlib import Path

from prefect import flow

from tasks.curate import curate
from tasks.distill import distill
from tasks.encode_latents import encode_latents
from tasks.evaluate_planning import evaluate_planning
from tasks.evaluate_policy import evaluate_policy
from tasks.evaluate_video import evaluate_video
from tasks.execution.artifact_task import Inputs, TaskCall
from tasks.execution.prefect_artifacts import STORE, ArtifactReference, run_chain
from tasks.filter import filter_episodes
from tasks.import_rollouts import import_rollouts
from tasks.record import record
from tasks.render_actions import render_actions
from tasks.report import report
from tasks.rollout import rollout
from tasks.train_judge import train_judge
from tasks.train_segmenter import train_segmenter
from tasks.train_stage1 import train_stage1
from tasks.train_stage2 import train_stage2
from tasks.train_tokenizer import train_tokenizer
from worldline_core.pipeline.pipeline_config import PipelineConfig


@flow(name="pipeline", flow_run_name="pipeline-{preset}", retries=0)
def pipeline(
    preset: str | None = "tiny", config: Path | None = None, overrides: tuple[str, ...] = (), artifacts: Path = STORE
) -> ArtifactReference:
    """From recordings to the report. Finished steps are not repeated; ``artifacts/report/latest`` shows how far it is."""
    settings = PipelineConfig.load(preset, config, overrides)
    return run_chain(chain, settings, settings.runner, artifacts.resolve())["report"]


def chain(c: PipelineConfig) -> None:
    """The whole chain."""
    curated, data, banks = prepare(c)
    models = prepare_models(c, data)
    trained = train(c, data, models)
    clips = {**data, **c.clips_of(c.distill, models | trained), "tokenizer": models["tokenizer"]}
    trained["distill"] = distill.submit(c.distill, **clips, stage2=trained["train_stage2"])
    predicted = predict(c, data, banks, models, trained)
    made = {"curate": curated, "filter": data["episodes"], "render_actions": data.get("tracks"), **trained}
    report.submit(c.report, **made, **evaluate(c, data, banks, models, predicted), rollout=predicted, models=models)


def prepare(c: PipelineConfig) -> tuple[TaskCall, Inputs, Inputs]:
    """Recordings → curated → filtered episodes → action tracks, where there are cameras. Banks are not filtered."""
    recorded: Inputs = {name: record.submit(config, f"record.{name}") for name, config in c.recordings()}
    curated = curate.submit(c.curate, source=c.sources_of(c.curate, recorded))
    data: Inputs = {"episodes": filter_episodes.submit(c.filter, episodes=curated)}
    if c.render_actions is not None:
        data["tracks"] = render_actions.submit(c.render_actions, episodes=data["episodes"])
    if c.render_actions is None or c.curate_banks is None:
        return curated, data, {}
    source = c.sources_of(c.curate_banks, recorded)
    banks = curate.submit(c.curate_banks, "curate.banks", source=source)
    tracks = render_actions.submit(c.render_actions, "render_actions.banks", episodes=banks)
    return curated, data, {"episodes": banks, "tracks": tracks, "sealed": source["0"]}


def prepare_models(c: PipelineConfig, data: Inputs) -> Inputs:
    """Weights that the run starts from and measures with: given, or trained on its recordings."""
    models: Inputs = {**c.model_folders()}
    if c.train_tokenizer is not None:
        models["tokenizer"] = train_tokenizer.submit(c.train_tokenizer, episodes=data["episodes"])
    if c.train_segmenter is not None and (masked := c.masks_of(data)):
        models["segmenter"] = train_segmenter.submit(c.train_segmenter, **masked)
    if c.train_judge is not None:
        seen = {"episodes": data["episodes"], "tokenizer": models.get("tokenizer")}
        models["judge"] = train_judge.submit(c.train_judge, **seen)
    return models


def train(c: PipelineConfig, data: Inputs, models: Inputs) -> Inputs:
    """Latents → Stage I → Stage II."""
    episodes, tokenizer, start, trained = data["episodes"], models["tokenizer"], models.get("base"), {}
    if c.caches_latents:
        trained["encode_latents"] = encode_latents.submit(c.encode_latents, episodes=episodes, tokenizer=tokenizer)
    if c.train_stage1 is not None:
        clips = {"episodes": episodes, **c.clips_of(c.train_stage1, models | trained)}
        start = trained["train_stage1"] = train_stage1.submit(c.train_stage1, **clips, base=start)
    clips = {**data, **c.clips_of(c.train_stage2, models | trained), "tokenizer": tokenizer}
    trained["train_stage2"] = train_stage2.submit(c.train_stage2, **clips, stage1=start, teacher=models.get("teacher"))
    return trained


def predict(c: PipelineConfig, data: Inputs, banks: Inputs, models: Inputs, trained: Inputs) -> Inputs:
    """Videos of every rollout whose checkpoint exists: this run's own, a shipped one, or none (baselines, imports)."""
    checkpoints, predicted = c.checkpoints(trained), {}
    for name, run in c.rollouts_in_order():
        episodes, tracks = ((banks if run.episodes == "banks" else data).get(key) for key in ("episodes", "tracks"))
        if run.imported is not None:
            videos = c.videos_folder(run)
            predicted[name] = import_rollouts.submit(run.imported, f"rollout.{name}", episodes=episodes, videos=videos)
        elif run.config is not None and run.checkpoint in checkpoints:
            model = {"tokenizer": models["tokenizer"], "checkpoint": checkpoints[run.checkpoint]}
            predicted[name] = rollout.submit(run.config, f"rollout.{name}", episodes=episodes, tracks=tracks, **model)
    return predicted


def evaluate(c: PipelineConfig, data: Inputs, banks: Inputs, models: Inputs, predicted: Inputs) -> Inputs:
    """Video metrics, policy evaluation and planning. Recorded outcomes of banks (sealed) are opened after the choice alone."""
    segmenter, judge, scores = models.get("segmenter"), models.get("judge"), {}
    shown, planned = (c.rollouts_of(predicted, banks=banks) for banks in (False, True))
    inputs = {**data, "segmenter": segmenter, "rollouts": shown}
    if shown and c.evaluate_video is not None:
        scores["evaluate_video"] = evaluate_video.submit(c.evaluate_video.of_methods(shown), **inputs)
    if shown and c.evaluate_policy is not None:
        scores["evaluate_policy"] = evaluate_policy.submit(c.evaluate_policy, **inputs, judge=judge)
    if planned and c.evaluate_planning is not None:
        inputs = {"banks": banks["episodes"], "tracks": banks["tracks"], "sealed": banks["sealed"], "rollouts": planned}
        instruments = {"segmenter": segmenter, "judge": judge}
        scores["evaluate_planning"] = evaluate_planning.submit(c.evaluate_planning, **inputs, **instruments)
    return scores
