"""The pipeline, from recordings to a report. `chain` is its only description: every call is a task of `tasks/<verb>.py`, and
what it returns stands for its artifact. Nightly evaluation and ablations compose the same functions."""

from __future__ import annotations

from pathlib import Path

from prefect import flow

from tasks.curate import curate
from tasks.distill import distill
from tasks.encode_latents import encode_latents
from tasks.evaluate_planning import evaluate_planning
from tasks.evaluate_policy import evaluate_policy
from tasks.evaluate_video import evaluate_video
from tasks.execution.artifact_task import TaskCall
from tasks.execution.chain import outline
from tasks.execution.prefect_artifacts import show_in_prefect
from tasks.execution.prefect_run import ArtifactReference, PrefectRun
from tasks.filter import filter_episodes
from tasks.import_rollouts import import_rollouts
from tasks.render_actions import render_actions
from tasks.report import report
from tasks.rollout import rollout
from tasks.train_stage1 import train_stage1
from tasks.train_stage2 import train_stage2
from worldline_core.pipeline.pipeline_config import PipelineConfig, source_folders

type Inputs = dict[str, TaskCall | Path]
STORE = Path("artifacts")


@flow(name="pipeline", flow_run_name="pipeline-{preset}", retries=0)
def pipeline(
    preset: str | None = "tiny", config: Path | None = None, overrides: tuple[str, ...] = (), artifacts: Path = STORE
) -> ArtifactReference:
    """From recordings to the report. Finished steps are not repeated; ``artifacts/report/latest`` shows how far it is."""
    settings = PipelineConfig.load(preset, config, overrides)
    with PrefectRun(artifacts.resolve(), settings.runner, page_of=outline(chain, settings)) as run:
        chain(settings)
    show_in_prefect(run.page_folder, run.artifacts)
    return run.artifacts["report"]


def chain(c: PipelineConfig) -> None:
    """The whole chain."""
    (curated, data), banks = prepare(c), prepare_banks(c)
    trained = train(c, data)
    clips = {**data, **c.clips_of(c.distill, trained), "tokenizer": c.model_folders()["tokenizer"]}
    trained["distill"] = distill.submit(c.distill, **clips, stage2=trained["train_stage2"])
    predicted, planned = predict(c, data, trained), predict(c, banks, trained, banks=True)
    scores = evaluate(c, data, predicted) | choose(c, banks, planned)
    made = {"curate": curated, "filter": data["episodes"], "render_actions": data["tracks"], **trained, **scores}
    report.submit(c.report, **made, rollout=predicted | planned, models=c.model_folders())


def prepare(c: PipelineConfig) -> tuple[TaskCall, Inputs]:
    """Recordings → curated episodes; filtered episodes → action tracks."""
    curated = curate.submit(c.curate, source=source_folders(c.curate))
    episodes = filter_episodes.submit(c.filter, episodes=curated)
    return curated, {"episodes": episodes, "tracks": render_actions.submit(c.render_actions, episodes=episodes)}


def prepare_banks(c: PipelineConfig) -> Inputs:
    """Candidate banks → curated episodes → action tracks. Nothing where the run has no banks."""
    if c.curate_banks is None:
        return {}
    episodes = curate.submit(c.curate_banks, "curate.banks", source=source_folders(c.curate_banks))
    tracks = render_actions.submit(c.render_actions, "render_actions.banks", episodes=episodes)
    return {"episodes": episodes, "tracks": tracks}


def train(c: PipelineConfig, data: Inputs) -> Inputs:
    """Latents → Stage I → Stage II."""
    models, episodes, trained = c.model_folders(), data["episodes"], {}
    start, teacher = models.get("base"), models.get("teacher")
    if c.caches_latents:
        tokenizer = models["tokenizer"]
        trained["encode_latents"] = encode_latents.submit(c.encode_latents, episodes=episodes, tokenizer=tokenizer)
    if c.train_stage1 is not None:
        clips = {"episodes": episodes, **c.clips_of(c.train_stage1, trained)}
        start = trained["train_stage1"] = train_stage1.submit(c.train_stage1, **clips, base=start)
    clips = {**data, **c.clips_of(c.train_stage2, trained)}
    trained["train_stage2"] = train_stage2.submit(c.train_stage2, **clips, stage1=start, teacher=teacher)
    return trained


def predict(c: PipelineConfig, data: Inputs, trained: Inputs, *, banks: bool = False) -> Inputs:
    """Videos of every rollout whose checkpoint exists: this run's own, a shipped one, or none (baselines, imports)."""
    own = {"stage1": "train_stage1", "stage2": "train_stage2", "causal": "distill"}
    checkpoints = c.shipped_checkpoints() | {name: trained[step] for name, step in own.items() if step in trained}
    predicted: Inputs = {}
    for name, run in c.rollouts_of(banks=banks):
        if run.imported is not None:
            videos = {"episodes": data["episodes"], "videos": c.videos_folder(run)}
            predicted[name] = import_rollouts.submit(run.imported, f"rollout.{name}", **videos)
        elif run.config is not None and run.checkpoint in (None, *checkpoints):
            model = {"tokenizer": c.model_folders()["tokenizer"], "checkpoint": checkpoints.get(run.checkpoint or "")}
            predicted[name] = rollout.submit(run.config, f"rollout.{name}", **data, **model)
    return predicted


def evaluate(c: PipelineConfig, data: Inputs, predicted: Inputs) -> Inputs:
    """Video metrics and policy evaluation of predicted recordings."""
    inputs, scores = {**data, "segmenter": c.model_folders().get("segmenter"), "rollouts": predicted}, {}
    if predicted and c.evaluate_video is not None:
        scores["evaluate_video"] = evaluate_video.submit(c.evaluate_video.of_methods(predicted), **inputs)
    if predicted and c.evaluate_policy is not None:
        scores["evaluate_policy"] = evaluate_policy.submit(c.evaluate_policy, **inputs)
    return scores


def choose(c: PipelineConfig, banks: Inputs, predicted: Inputs) -> Inputs:
    """Planning with predicted banks. Recorded outcomes are opened after the choice: curation never sees them."""
    if not predicted or c.evaluate_planning is None or c.curate_banks is None:
        return {}
    inputs = {"banks": banks["episodes"], "tracks": banks["tracks"], "segmenter": c.model_folders().get("segmenter")}
    inputs |= {"rollouts": predicted, "sealed": source_folders(c.curate_banks)["0"]}
    return {"evaluate_planning": evaluate_planning.submit(c.evaluate_planning, **inputs)}
