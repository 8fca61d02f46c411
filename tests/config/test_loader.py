"""The strict YAML loader names every mistake by its file and dotted path, and loads every file in configs; default precision on
processors with and without native bfloat16.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import ValidationError

from tasks.execution.artifact_task import find_task
from worldline_core import processor
from worldline_core.config import CONFIG_ROOT, StrictModel, apply_overrides, load_config, read_yaml, validate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode import NO_EMBODIMENT
from worldline_core.data.sources.open import SourceConfig
from worldline_core.data.sources.robomind import ROBOMIND_LAYOUTS
from worldline_core.errors import ConfigError
from worldline_core.evaluation.evaluation_config import JudgeConfig, SegmenterConfig
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.geometry.embodiment import embodiment_names
from worldline_core.pipeline.pipeline_config import PipelineConfig, check_weights
from worldline_core.recorder.attempts import RecordBanksConfig, RecordPoliciesConfig
from worldline_core.recorder.record import RecordConfig, plan_jobs
from worldline_core.rollout.rollout_config import GeSimConfig, RolloutConfig
from worldline_core.scale.mapping import RunnerConfig
from worldline_core.serving.serve_config import ServeConfig
from worldline_core.training.clip_config import EncodeLatentsConfig
from worldline_core.training.training_config import TokenizerConfig, TrainerConfig


class Inner(StrictModel):
    rate: float = 1.0
    steps: int = 3


class Outer(StrictModel):
    inner: Inner = Inner()
    name: str = "x"


def test_reads_and_overrides(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text("inner: {rate: 0.5}\nname: run\n")
    config = load_config(Outer, path=path, overrides=["inner.steps=9", "name=other"])
    assert config == Outer(inner=Inner(rate=0.5, steps=9), name="other")
    assert load_config(Inner, path=path, section="inner") == Inner(rate=0.5)


@pytest.mark.parametrize(
    ("text", "overrides", "message"),
    [
        ("inner: {stepz: 4}", [], r"inner\.stepz: unknown key; did you mean 'steps'"),
        ("inner: {steps: many}", [], r"inner\.steps: .*valid integer"),
        ("inner: {rate: .nan}", [], r"inner\.rate: .*finite"),
        # The mistake may be in the override: the place names it beside the file.
        ("name: x", ["inner.rat=2"], r"(?s)where: \S+\.yaml, --set inner\.rat=2\n.*inner\.rat: unknown key"),
        ("- 1\n- 2\n", [], "one mapping"),
        (None, [], "No such configuration file"),
    ],
)
def test_a_mistake_is_named_by_its_path(text: str | None, overrides: list[str], message: str, tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_config(Outer, path=path, overrides=overrides)


def test_override_forms(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("a: off\nb: yes\nc: true\n")  # words that name choices are no booleans
    assert read_yaml(tmp_path / "a.yaml") == {"a": "off", "b": "yes", "c": True}
    assert apply_overrides({}, ["a=off", "b=false"]) == {"a": "off", "b": False}
    assert apply_overrides({"a": {"b": 1}}, ["a.c=[1, 2]", "d=null"]) == {"a": {"b": 1, "c": [1, 2]}, "d": None}
    for given, override, message in (
        ({}, "a.b", r"form a\.b=value"),
        ({"a": 1}, "a.b=2", "not a mapping"),
    ):
        with pytest.raises(ConfigError, match=message):
            apply_overrides(given, [override])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("curate.sources=[{kind: episode_set, nam: x}]", r"sources\.0\.episode_set\.nam: unknown key; did you mean 'name'"),
        ("rollouts.copy_first_frame.config.methd=x", r"copy_first_frame\.config\.methd: unknown key; did you mean 'method'"),
        ("models.zzz=x", r"models\.zzz: unknown key; known keys: base, causal"),
    ],
)  # fmt: skip
def test_keys_inside_of_unions_lists_and_mappings_are_known(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        PipelineConfig.load("smoke", overrides=[override])


def test_a_file_that_extends_a_preset_states_only_what_differs(tmp_path: Path) -> None:
    smoke = load_config(PipelineConfig, preset="smoke")
    path = tmp_path / "mine.yaml"
    path.write_text("extends: smoke\ntrain_stage1: {trainer: {steps: 3}}\nrollouts: {copy_first_frame: null}\n")
    mine = load_config(PipelineConfig, path=path)
    assert mine.train_stage1.trainer.steps == 3
    assert mine.train_stage1.trainer.batch_size == smoke.train_stage1.trainer.batch_size
    assert set(smoke.rollouts) - set(mine.rollouts) == {"copy_first_frame"}
    assert mine.curate == smoke.curate


QUESTIONS = """extends: smoke
todo:
  fps: &fps TODO frames a second
  tool: &tool TODO length of the tool
curate:
  sources:
    - {kind: agibot_gesim, path: x, fps: *fps, license: *tool, embodiment: TODO}
"""


@pytest.mark.parametrize(
    ("section", "model"),
    [(None, PipelineConfig), ("curate", CurateConfig), ("filter", FilterConfig), ("runner", RunnerConfig)],
)
def test_what_is_not_filled_in_is_refused_by_name_all_at_once_by_every_step(
    tmp_path: Path, section: str | None, model: Any
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(QUESTIONS)
    said = r"(?s)not filled in.*mine\.yaml.*todo\.fps: TODO frames a second.*todo\.tool.*curate\.sources\.0\.embodiment: TODO"
    with pytest.raises(ConfigError, match=said):
        load_config(model, path=path, section=section)
    with pytest.raises(ConfigError, match=r"(?s)(?!.*todo\.fps)not filled in.*todo\.tool"):
        load_config(model, path=path, section=section, overrides=["todo.fps=30"])
    path.write_text(QUESTIONS.replace("TODO frames a second", "30").replace("embodiment: TODO", "name: TODOS"))
    filled: Any = load_config(PipelineConfig, path=path, overrides=["todo.tool=MIT"]).curate.sources[0]
    assert (filled.fps, filled.license, filled.name) == (30, "MIT", "TODOS")


def test_the_preset_for_ones_own_robot_asks_for_recordings_alone() -> None:
    with pytest.raises(ConfigError, match=r"(?s)curate\.sources: TODO .*worldline init"):
        PipelineConfig.load("my_robot")
    config = PipelineConfig.load("my_robot", overrides=["curate.sources=[{kind: video_folder, path: x}]"])
    assert {run.checkpoint for run in config.rollouts.values()} == {None, "stage2", "causal"}


def test_null_takes_away_what_the_file_has() -> None:
    def load(*overrides: str) -> PipelineConfig:
        return PipelineConfig.load("smoke", overrides=overrides)

    whole = load()
    name = next(iter(whole.rollouts))
    assert set(load(f"rollouts.{name}=null").rollouts) == set(whole.rollouts) - {name}
    assert load("train_stage2.relational=null").train_stage2.relational is None
    assert load("train_stage1.trainer.steps=2", "train_stage1=null").train_stage1 is None  # earlier changes go along
    unjudged = load("evaluate_policy=null")
    assert unjudged.evaluate_policy is None
    check_weights(unjudged, Path(__file__).resolve().parents[2])
    for override, message in (
        ("rollouts.nobody=null", r"rollouts\.nobody"),
        ("rolouts=null", r"rolouts: unknown key; did you mean 'rollouts'"),
        ("curate=null", "curate: Field required"),
    ):
        with pytest.raises(ConfigError, match=message):
            load(override)


@pytest.mark.parametrize("size", [[0, 0], [-64, 96], [1_000_000, 1_000_000], [16_384, 16_384], [64]])
def test_pictures_of_no_size_are_refused_before_anything_is_read(size: list[int]) -> None:
    for read in (CurateConfig, EncodeLatentsConfig, TokenizerConfig, SegmenterConfig, GeSimConfig):
        with pytest.raises(ValidationError, match="image_size"):
            read.model_validate({"image_size": size})


@pytest.mark.parametrize("fps", [1e-320, 0, -1, 1e300, float("nan"), float("inf")])
def test_rates_that_give_no_usable_times_are_refused_before_anything_is_read(fps: float) -> None:
    robotwin = {"kind": "robotwin", "path": "a", "embodiment": "none", "fps": fps, "views": {"head": "head_camera"}}
    videos = {"kind": "video_folder", "path": "a", "target_fps": fps}
    for given, name in (
        ({"sources": [robotwin]}, "fps"),
        ({"sources": [videos]}, "target_fps"),
        ({"sources": [], "fps": fps}, "fps"),
    ):
        with pytest.raises(ValidationError, match=rf"{name}\n"):
            CurateConfig.model_validate(given)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("trim", "common", r"trim: unknown key; trim belongs further up, beside sources"),
        ("views", "available", r"views: Input should .*; views belongs further up, beside sources"),
        ("video_crf", 4, r"video_crf: unknown key; video_crf belongs further up, beside sources"),
        ("trim", "no", r"trim: unknown key; did you mean 'stride'\?$"),
        ("views", 3, r"views: Input should .* \(got 3\)$"),
    ],
)
def test_a_key_of_a_section_above_is_sent_there(key: str, value: object, said: str) -> None:
    source = {"kind": "lerobot_v3", "path": "x", "embodiment": "none", "angle_unit": "rad", "views": {}, key: value}
    with pytest.raises(ConfigError, match=f"(?m){said}"):
        validate(CurateConfig, {"sources": [source]}, where="a.yaml")


TEMPLATES = sorted([*(CONFIG_ROOT / "sources").glob("*.yaml"), *(CONFIG_ROOT / "filters").glob("*.yaml")])
RECORDINGS = sorted((CONFIG_ROOT / "recording").glob("*.yaml"))
KNOWN = {*embodiment_names(), NO_EMBODIMENT}


@pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.stem)
def test_a_recording_loads_as_it_is(path: Path) -> None:
    sections = read_yaml(path)
    if "groups" in sections:
        assert plan_jobs(load_config(RecordConfig, path=path))
    elif "policies" in sections:
        assert load_config(RecordPoliciesConfig, path=path).starts.specs()
    else:
        assert load_config(RecordBanksConfig, path=path).specs()


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: path.stem)
def test_a_template_loads_as_it_is(path: Path) -> None:
    sections = read_yaml(path)
    assert "curate" in sections or path.parent.name != "sources"
    for section in sections:
        config = load_config(find_task(section).load_config(), path=path, section=section)
        if isinstance(config, CurateConfig):
            assert {getattr(s, "embodiment", None) for s in config.sources} <= {*KNOWN, None, "unspecified"}


def test_the_robots_that_readers_name_themselves_exist() -> None:
    defaults = {kind.model_fields["embodiment"].default for kind in get_args(get_args(SourceConfig)[0])
                if "embodiment" in kind.model_fields and not kind.model_fields["embodiment"].is_required()}  # fmt: skip
    assert defaults - {None, "unspecified"} <= KNOWN  # of plain videos the robot is not asked for
    assert {layout.embodiment for layout in ROBOMIND_LAYOUTS.values()} <= KNOWN


@pytest.mark.parametrize(("name", "hint"), [("unitree_g1", "did you mean 'unitree_g1_29dof'"), ("zz", "zz.yaml")])
def test_a_robot_without_a_description_is_a_mistake_in_the_configuration(name: str, hint: str) -> None:
    def source(embodiment: str) -> dict[str, Any]:
        views = {"observation.images.top": "head"}
        return {"kind": "lerobot_v3", "path": "x", "embodiment": embodiment, "angle_unit": "rad", "views": views}

    with pytest.raises(ConfigError, match=rf"(?s)embodiment: .*no description of the robot {name} .*{hint}.*none"):
        validate(CurateConfig, {"sources": [source(name)]}, where="my.yaml")
    assert validate(CurateConfig, {"sources": [source("none")]}, where="my.yaml").sources[0].label == "x"


PROCESSORS = {
    "model name\t: Sapphire\nflags\t\t: fpu avx512f avx512_bf16 amx_bf16 amx_tile": ("Sapphire", True),
    "model name\t: Zen 4\nflags\t\t: fpu avx512f avx512_bf16": ("Zen 4", True),
    "model name\t: Cascade Lake\nflags\t\t: fpu avx2 avx512f avx512_vnni": ("Cascade Lake", False),
    "model name\t: Zen 3\nflags\t\t: fpu avx avx2 fma": ("Zen 3", False),
}


@pytest.mark.parametrize("facts", PROCESSORS)
def test_bfloat16_is_the_default_where_the_device_has_it(facts: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processor, "_first_core", lambda: facts)
    name, has = PROCESSORS[facts]
    assert (processor.processor_name(), processor.processor_has_bfloat16()) == (name, has)
    for model in (RolloutConfig, ServeConfig, TokenizerConfig):
        assert model().bfloat16 is has
        assert model(device="cuda:1").bfloat16
        assert not model(device="cuda", bfloat16=False).bfloat16
    assert TokenizerConfig().trainer.precision == JudgeConfig().trainer.precision == ("bf16" if has else "fp32")
    assert RolloutConfig(weights="bfloat16").bfloat16
    assert TrainerConfig(steps=1).precision == ("bf16" if has else "fp32")
    assert TrainerConfig(steps=1, device="cuda").precision == TrainerConfig(steps=1, weights="bf16").precision == "bf16"
    assert TrainerConfig(steps=1, precision="bf16").precision == "bf16"


def test_a_mistake_beside_it_is_named_alone() -> None:
    with pytest.raises(ConfigError, match=r"got: \n    device: [^\n]*\(got 3\)$"):
        validate(RolloutConfig, {"device": 3}, where="a file")
