"""`worldline plan`: every stage of a preset, its memory, and the setting that would fit."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from flows.command_line import main
from worldline_core.config import load_config
from worldline_core.distillation import distill_memory
from worldline_core.distillation.distill_memory import DistillEstimates
from worldline_core.errors import ConfigError
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.pipeline.planner import Planner, typical_lengths
from worldline_core.pipeline.sheet import Machine, Row
from worldline_core.rollout.rollout_config import RolloutConfig
from worldline_core.training import stage_memory
from worldline_core.training.clip_config import ClipSampling
from worldline_core.training.stage_memory import Spread, StageMemory, largest_clips, require_fit, rough_bytes

PROJECT = Path(__file__).parents[2]
STAGES = ["stage I", "stage II", "distill: teacher forcing", "distill: trajectory regression"]


@pytest.mark.slow
def test_every_stage_of_a_small_preset_fits_and_is_printed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(PROJECT)
    with pytest.raises(SystemExit, match="0"):
        main(["plan", "--preset", "smoke", "--gpus", "1", "--json"])
    sheet = json.loads(capsys.readouterr().out)
    stages = {stage["stage"]: stage for stage in sheet["stages"]}
    assert [name for name in stages if name in STAGES] == STAGES
    assert all(stage["fits"] and stage["total_bytes"] == sum(stage["bytes"].values()) for stage in stages.values())
    second = stages["stage II"]
    assert second["bytes"]["weights"] == 4 * second["parameters"]
    assert second["hours"] > 0


def test_what_does_not_fit_ends_with_status_one_and_the_setting(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    row = Row("stage II", 7, {"weights": 3e9, "activations": 1e9}, 2.0, None, fits=False, instead="shorter clips")
    monkeypatch.setattr(Planner, "rows", lambda _planner: iter([row]))
    with pytest.raises(SystemExit, match="1"):
        main(["plan", "--preset", "smoke", "--gpus", "1", "--memory", "4GB"])
    printed = capsys.readouterr().out
    assert "| stage II | 0.0 M | 4.0 | weights 3.0, activations 1.0 | 2 |  | NO |" in printed
    assert "It does not fit: set shorter clips" in printed


@pytest.mark.parametrize(
    ("change", "message"), [({"card": "H900"}, "Unknown card"), ({"memory": "80"}, "amount of memory")]
)
def test_nonsense_is_refused(change: dict[str, str], message: str) -> None:
    values = {"memory": "80GB", "card": "H100"} | change
    with pytest.raises(ConfigError, match=message):
        Machine.of(8, values["memory"], values["card"], 0.4)


def test_three_lengths_stand_for_all_of_a_range() -> None:
    lengths = ClipSampling.model_validate({"lengths": {"from": 33, "to": 129}}).lengths
    shares = typical_lengths(ClipSampling(lengths=lengths))
    assert sum(share for _, share in shares) == pytest.approx(1)
    for power in (1, 2):
        exact = sum(length**power for length in lengths) / len(lengths)
        assert sum(share * length**power for length, share in shares) == pytest.approx(exact, rel=0.01)


@pytest.mark.parametrize("preset", ["tiny", "demo", "small_world"])
def test_small_presets_train_on_8_gb_without_a_closer_look(preset: str, monkeypatch: pytest.MonkeyPatch) -> None:
    planner = Planner(load_config(PipelineConfig, preset=preset), PROJECT, Machine.of(1, "8GB", "H100", 0.4))
    grid = planner.grid(planner.config.encode_latents.image_size)

    def looked_closer(*_: object, **__: object) -> StageMemory:
        raise AssertionError

    for module in (stage_memory, distill_memory):
        monkeypatch.setattr(module, "device_memory", lambda _device: 8e9)
    trainings = [found for name, found in planner.trainings().items() if name.startswith("train_")]
    assert trainings
    for _, trainer, clips in trainings:
        shape = largest_clips(clips, trainer.batch_size, planner.model.views, grid)
        require_fit(looked_closer, trainer, clips.lengths, rough_bytes(planner.model, shape))
    monkeypatch.setattr(distill_memory, "trained_cost", looked_closer)
    monkeypatch.setattr(distill_memory, "teacher_trajectories", looked_closer)
    DistillEstimates(planner.config.distill, planner.generation, grid).require_fit()


def test_distillation_from_frames_of_another_size_than_stage2s_is_refused() -> None:
    with pytest.raises(
        ConfigError, match=r"frames of \[64, 96\][\s\S]*of \[480, 640\][\s\S]*set distill\.input\.image_size"
    ):
        load_config(PipelineConfig, preset="cosmos3-nano", overrides=["distill.input.kind=frames"])
    same = "distill.input={kind: frames, image_size: [480, 640]}"
    load_config(PipelineConfig, preset="cosmos3-nano", overrides=[same])


@pytest.mark.parametrize(
    ("changes", "instead"),
    [
        ({"batch_size": 2}, "a smaller batch_size, or weights: bfloat16"),
        ({"batch_size": 1}, "a smaller num_frames, or weights: bfloat16"),
        ({"batch_size": 1, "weights": "bfloat16"}, "a smaller num_frames"),
    ],
)
def test_a_rollout_that_does_not_fit_is_told_what_can_still_be_smaller(changes: dict[str, Any], instead: str) -> None:
    planner = Planner(load_config(PipelineConfig, preset="smoke"), PROJECT, Machine.of(1, "0.001GB", "H100", 0.4))
    config = RolloutConfig.model_validate({"sampler": "full_clip", "num_frames": 5, **changes})
    row = planner._rollout("stage2", config, planner.generation, (64, 96))
    assert not row.fits
    assert row.instead == instead


@pytest.mark.slow
def test_distillation_from_frames_holds_what_encodes_them() -> None:
    frames = "distill.input={kind: frames, image_size: [64, 96]}"
    sheets = []
    for overrides in ([], [frames]):
        config = load_config(PipelineConfig, preset="smoke", overrides=overrides)
        planner = Planner(config, PROJECT, Machine.of(1, "16GB", "H100", 0.4))
        trainings = planner.trainings()
        sheets.append([trainings[name][0](Spread()) for name in ("teacher_forcing", "trajectory_regression")])
    for cached, online in zip(*sheets, strict=True):
        assert online.total >= cached.total + online.frozen["encoder"] > cached.total
    assert [online.before.activations > 0 for online in sheets[1]] == [True, False]


@pytest.mark.slow
def test_the_check_before_training_lets_through_what_fits_by_a_hair(monkeypatch: pytest.MonkeyPatch) -> None:
    planner = Planner(load_config(PipelineConfig, preset="smoke"), PROJECT, Machine.of(1, "16GB", "H100", 0.4))
    estimate, trainer, clips = planner.trainings()["train_stage2"]
    estimate = cache(estimate)
    need = estimate(Spread.of(trainer, 1))
    assert need.total < 2 * rough_bytes(planner.model, need.shape)  # so that the quick sum alone lets nothing through
    monkeypatch.setattr(stage_memory, "device_memory", lambda _device: 1.001 * need.total / stage_memory.USABLE)
    require_fit(estimate, trainer, clips.lengths, math.inf)
    monkeypatch.setattr(stage_memory, "device_memory", lambda _device: 0.999 * need.total / stage_memory.USABLE)
    with pytest.raises(ConfigError, match=r"does not fit[\s\S]*stage II on cpu"):
        require_fit(estimate, trainer, clips.lengths, math.inf)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("name", "parameters"),
    # Both towers of Cosmos3-Nano; student and fake score of the video tower, which is what takes most memory.
    [("train_stage1", (14e9, 15e9)), ("distribution_matching", (13.5e9, 14.5e9))],
)
def test_the_full_size_fits_cards_of_80_gb(name: str, parameters: tuple[float, float]) -> None:
    planner = Planner(load_config(PipelineConfig, preset="cosmos3-nano"), PROJECT, Machine.of(8, "80GB", "H100", 0.4))
    estimate, trainer, _ = planner.trainings()[name]
    need = estimate(Spread.of(trainer, 8))
    assert parameters[0] < need.trained < parameters[1]
    assert need.fits(80e9), need.line(80e9)
    assert replace(need, spread=Spread.of(trainer, 64)).total < need.total
