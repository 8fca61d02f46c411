"""The chain: what feeds what, which calls need training, how a step run alone finds its inputs, how a step is added, and its deployments."""

from __future__ import annotations

import importlib
import sys
from itertools import pairwise
from pathlib import Path

import pytest
from prefect import Flow, flow
from prefect.settings import PREFECT_LOCAL_STORAGE_PATH, temporary_settings

import tasks
from flows.pipeline import Inputs, chain, evaluate, predict, prepare
from tasks.curate import curate
from tasks.execution.artifact_task import TaskCall, find_task, task_names
from tasks.execution.chain import find_artifacts, find_call, load_chain, outline, ready_inputs
from tasks.execution.prefect_run import PrefectRun
from worldline_core.config import load_config, preset_names, read_yaml
from worldline_core.errors import ArtifactError, ConfigError
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.scale.mapping import RunnerConfig
from worldline_core.store.store import ArtifactStore


@pytest.fixture(scope="module")
def calls() -> dict[str, TaskCall]:
    return outline(chain, PipelineConfig.load("tiny"))


def nightly(config: PipelineConfig) -> None:
    _, data, banks = prepare(config)
    models: Inputs = {**config.model_folders()}
    evaluate(config, data, banks, models, predict(config, data, banks, models, trained={}))


@pytest.mark.parametrize("preset", ["demo", "tiny", "smoke", "cosmos3-nano", "small_world"])
def test_every_preset_is_valid_and_every_input_comes_before_its_use(preset: str) -> None:
    seen: set[str] = set()
    for call in outline(chain, PipelineConfig.load(preset)).values():
        assert {source.name for source in call.upstream} <= seen
        seen.add(call.name)
    assert {"curate", "filter", "train_stage1", "train_stage2", "distill", "evaluate_video", "report"} <= seen


def test_full_size_stages_encode_on_the_fly_and_small_ones_read_latents(calls: dict[str, TaskCall]) -> None:
    config = PipelineConfig.load("cosmos3-nano")
    full_size = outline(chain, config)
    for name in ("train_stage1", "train_stage2"):
        assert full_size[name].inputs["tokenizer"] == Path.cwd() / str(config.models.tokenizer)
        assert "latents" not in full_size[name].inputs
        assert calls[name].inputs["latents"] is calls["encode_latents"]
        lengths = getattr(config, name).clips.lengths
        assert (lengths[0], lengths[-1]) == (33, 129)
    # Stage I spans longer motion, Stage II is denser (method.md section 1).
    assert min(config.train_stage1.clips.strides) > max(config.train_stage2.clips.strides)


def test_the_chain_is_the_one_that_the_readme_draws(calls: dict[str, TaskCall]) -> None:
    order = ["curate", "filter", "render_actions", "train_stage2", "distill", "rollout.causal"]
    arrows = {(source.name, call.name) for call in calls.values() for source in call.upstream}
    assert set(pairwise(order)) <= arrows
    evaluations = {"evaluate_video", "evaluate_policy", "evaluate_planning"}
    assert {target for source, target in arrows if source.startswith("rollout.")} == evaluations | {"report"}
    assert all((evaluation, "report") in arrows for evaluation in evaluations)
    # Labels of the banks are an input of planning alone.
    assert [name for name, call in calls.items() if "sealed" in call.inputs] == ["evaluate_planning"]
    assert load_chain() is chain


def test_a_trained_judge_judges_and_chooses() -> None:
    changes = ("train_judge={}", "evaluate_policy.judge=learned", "evaluate_planning.selector=learned")
    calls = outline(chain, PipelineConfig.load("tiny", None, changes))
    assert {"episodes", "tokenizer"} == set(calls["train_judge"].inputs)
    for name in ("evaluate_policy", "evaluate_planning"):
        assert calls[name].inputs["judge"] is calls["train_judge"]


def test_every_task_loads() -> None:
    for name in task_names():
        task = find_task(name)
        assert task.name == name
        assert callable(task.load_function())
        assert task.load_config().model_config["extra"] == "forbid"


def test_nightly_leaves_training_out_but_keeps_the_shipped_models() -> None:
    calls = outline(nightly, PipelineConfig.load("tiny"))
    assert {"rollout.shipped_stage2", "rollout.banks_shipped_causal", "evaluate_planning"} <= set(calls)
    assert not set(calls) & {"train_stage1", "train_stage2", "distill", "rollout.stage2", "rollout.causal"}
    assert "rollouts.stage2" not in calls["evaluate_video"].inputs
    PipelineConfig.load("tiny").check_night()


@pytest.mark.parametrize("changes", [(), ("models.causal=artifacts/shipped/models/causal",), ("rollouts.stage2=null",)])
def test_a_night_that_measures_no_model_is_refused(changes: tuple[str, ...]) -> None:
    """Its rollouts wait for a training that no night does: only the copy of the first frame was compared, never red."""
    with pytest.raises(ConfigError, match=r"(?s)measures no model.*copy_first_frame"):
        PipelineConfig.load("smoke", None, changes).check_night()
    shipped = ("models.causal=artifacts/shipped/models/causal", "rollouts.causal.checkpoint=shipped_causal")
    PipelineConfig.load("smoke", None, shipped).check_night()


def test_missing_artifacts_and_calls_are_named(calls: dict[str, TaskCall], tmp_path: Path) -> None:
    store = ArtifactStore(tmp_path)
    assert find_artifacts(calls, store) == {}
    with pytest.raises(ArtifactError, match=r"worldline task curate"):
        ready_inputs(calls["filter"], calls, store)
    with pytest.raises(ConfigError, match=r"(?s)rollout occurs more than once.*rollout\.shipped_stage2"):
        find_call(calls, "rollout")
    with pytest.raises(ConfigError, match="filter does not occur"):
        find_call(calls, "curate", "filter")
    assert find_call(calls, "rollout", "rollout.causal") is calls["rollout.causal"]


def test_rollouts_of_a_preset_go_with_their_models_and_banks(tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(OWN)
    config = PipelineConfig.load(None, path)
    assert list(config.rollouts) == ["copy_first_frame", "stage2", "stage2_shuffled", "causal"]
    assert "rollout.stage2" in outline(chain, config)
    mine = "rollouts: {mine: {checkpoint: shipped_stage2, config: {method: mine, sampler: {kind: full_clip}}}}"
    path.write_text(OWN + mine)
    with pytest.raises(ConfigError, match=r"rollouts\.mine needs models\.stage2"):  # what the user wrote is not dropped
        PipelineConfig.load(None, path)
    with pytest.raises(ConfigError, match=r"rollouts\.shipped_stage2 needs models\.stage2"):
        load_config(PipelineConfig, preset="tiny", overrides=["models.stage2=null"])


OWN = """extends: tiny
models: {stage2: null, causal: null}
curate: {sources: [{kind: video_folder, path: mine}]}
curate_banks: null
evaluate_planning: null
filter: {required_views: [head]}
encode_latents: {views: [head]}
"""


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("encode_latents.views=[head]", "'left_wrist', 'right_wrist'.*encode_latents.views leaves out"),
        ("train_stage2.clips.view_weights={head: 1.0}", "'left_wrist', 'right_wrist'.*view_weights leaves out"),
        ("encode_latents.views=[head, left_wrist]", "'right_wrist'.*set distill.views"),
    ],
)
def test_views_of_distillation_are_checked_before_any_training(override: str, message: str) -> None:
    def load(*more: str) -> PipelineConfig:
        return PipelineConfig.load("smoke", overrides=[override, *more])

    with pytest.raises(ConfigError, match=message):
        load("distill.views=[head, left_wrist, right_wrist]")
    load("distill.views=[head]")
    # A run for one robot need not name them again.
    assert load().distill.views == (["head", "left_wrist"] if "left_wrist]" in override else ["head"])


def test_a_run_of_recordings_without_cameras_draws_nothing() -> None:
    with pytest.raises(ConfigError, match=r"render_actions: without it nothing is drawn"):
        PipelineConfig.load("smoke", overrides=["render_actions=null"])
    changes = ["render_actions=null", "curate_banks=null", "evaluate_planning=null", "train_stage2.native_size=14"]
    for name, run in PipelineConfig.load("smoke").rollouts.items():
        if run.episodes == "banks" or str(run.checkpoint).startswith("shipped_"):
            changes.append(f"rollouts.{name}=null")
    made = outline(chain, PipelineConfig.load("smoke", overrides=changes))
    assert "render_actions" not in made
    assert not any("tracks" in call.inputs for call in made.values())


def test_inputs_are_checked_where_a_task_is_called() -> None:
    config = PipelineConfig.load("smoke")
    with pytest.raises(ConfigError, match=r"missing \['episodes'\], unknown \['recordings'\]"):
        outline(lambda: find_task("filter").submit(config.filter, recordings=curate.submit(config.curate)))
    with pytest.raises(ConfigError, match="outside of a run"):
        curate.submit(config.curate)


COUNTING = """
from worldline_core.config import StrictModel

class CountConfig(StrictModel):
    factor: int = 1

def count_files(config, inputs, output):
    (output / "count").write_text(str(config.factor * len(list(inputs["episodes"].iterdir()))))
    return {}
"""
TASK = """
from tasks.execution.artifact_task import ArtifactTask

count_files = ArtifactTask(
    name="count_files", version=1, function="counting:count_files", config="counting:CountConfig", inputs=("episodes",),
)
"""


@pytest.mark.slow
def test_a_step_needs_a_core_function_a_task_file_and_a_line(
    prefect_server: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, text in {"counting.py": COUNTING, "tasks/count_files.py": TASK, "episodes/one": "1"}.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(tasks, "__path__", [*tasks.__path__, str(tmp_path / "tasks")])
    task = find_task("count_files")

    @flow
    def longer_chain() -> Path:
        with PrefectRun(tmp_path / "store", RunnerConfig()) as run:
            first = task.submit(task.load_config()(factor=7), episodes=tmp_path / "episodes")
            task.submit(task.load_config()(), "count_files.again", episodes=first)
        return run.artifacts["count_files"].folder

    with temporary_settings({PREFECT_LOCAL_STORAGE_PATH: tmp_path / "prefect"}):
        assert (longer_chain() / "count").read_text() == "7"
    assert "count_files" in task_names()
    del sys.modules["tasks.count_files"], sys.modules["counting"]


DEPLOYMENT_KEYS = {"name", "description", "entrypoint", "parameters", "schedules", "work_pool"}


def test_deployments_are_the_flows_and_every_step_with_parameters_that_exist(project_root: Path) -> None:
    content = read_yaml(project_root / "prefect.yaml")
    assert set(content) == {"name", "prefect-version", "definitions", "deployments"}
    deployments = content["deployments"]
    steps = dict.fromkeys(call.task.name for call in outline(chain, PipelineConfig.load("tiny")).values())
    assert [deployment["name"] for deployment in deployments] == ["pipeline", "nightly-evaluation", *steps]
    for deployment in deployments:
        assert set(deployment) <= DEPLOYMENT_KEYS
        assert set(deployment["work_pool"]) == {"name", "job_variables"}
        assert all(set(schedule) == {"cron", "timezone", "active"} for schedule in deployment.get("schedules", ()))
        path, _, function = deployment["entrypoint"].partition(":")
        flow = getattr(importlib.import_module(path.removesuffix(".py").replace("/", ".")), function)
        assert isinstance(flow, Flow)
        parameters = {"config": None, "overrides": (), "artifacts": "artifacts", **deployment["parameters"]}
        flow.validate_parameters(parameters)
        assert deployment["parameters"]["preset"] in preset_names()
