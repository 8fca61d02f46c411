"""Planned memory is what a real training step takes; what cannot fit is refused before the first step."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from worldline_core.errors import ConfigError
from worldline_core.model import step_cost
from worldline_core.model.step_cost import StepCost, cost_of, without_values
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import WorldModelConfig
from worldline_core.training import stage_memory
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.stage1 import train_stage1
from worldline_core.training.stage_cost import parameter_counts, trained_cost
from worldline_core.training.stage_memory import ClipShape, Spread, StageMemory, fitting_setting
from worldline_core.training.training_config import LossWeighting, SigmaSampling, Stage1Config, TrainerConfig


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    path = Path(__file__).parents[2] / "benchmarks" / "full_size.py"
    spec = importlib.util.spec_from_file_location("benchmark_full_size", path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("size", "precision", "accumulation", "checkpointing"),
    [
        (0, "fp32", 1, "none"),
        pytest.param(2, "fp32", 1, "none", marks=pytest.mark.slow),
        (0, "bf16", 2, "block"),
        pytest.param(1, "bf16", 2, "block", marks=pytest.mark.slow),
    ],
)
def test_planned_memory_is_what_the_allocator_hands_out(
    benchmark: ModuleType, size: int, precision: str, accumulation: int, checkpointing: str
) -> None:
    config, frames, grid = benchmark.SIZES[size]
    values = {
        "steps": 2,
        "precision": precision,
        "accumulation": accumulation,
        "sharding": {"checkpointing": checkpointing},
    }
    planned, measured = benchmark.memory(config, frames, grid, TrainerConfig.model_validate(values))
    assert planned == pytest.approx(measured, rel=0.02)


def estimate_of(config: WorldModelConfig, trainer: TrainerConfig, frames: int = 33) -> stage_memory.Estimate:
    def estimate(spread: Spread) -> StageMemory:
        shape = ClipShape(1, config.views, spread.frames or frames, (8, 12))
        cost = trained_cost(
            lambda model: FlowMatchingObjective(model, sigma=SigmaSampling(), weighting=LossWeighting()),
            lambda: shape.batch(config, maps=True),
            config,
            trainer,
            spread,
        )
        return StageMemory("stage", trainer, spread, shape, shape.tokens(config), *parameter_counts(config), cost)

    return estimate


def test_deep_models_cost_what_two_shallow_ones_foretell(monkeypatch: pytest.MonkeyPatch) -> None:
    config = WorldModelConfig(towers="generation", num_layers=9)
    estimate = estimate_of(config, TrainerConfig(steps=1))
    drawn = estimate(Spread()).cost
    monkeypatch.setattr("worldline_core.model.step_cost._TRACED_LAYERS", (4, 9))
    traced = estimate(Spread()).cost
    assert drawn.flops == pytest.approx(traced.flops, rel=1e-9)
    assert drawn.activations == pytest.approx(traced.activations, rel=1e-3)
    assert drawn.gradients == traced.gradients == 4 * parameter_counts(config)[0]


def test_deep_models_hold_most_on_the_way_back_where_shallow_ones_do_before() -> None:
    def trace(layers: int) -> StepCost:
        ahead, back = 10.0 + layers, 2.0 * layers
        return StepCost(max(ahead, back), ahead=ahead, back=back)

    assert trace(8).activations == 18
    assert step_cost.cost_at_depth(trace, 36) == replace(trace(36), peak=72.0)


def test_operations_are_those_of_the_matrix_products() -> None:
    with without_values():
        layer = torch.nn.Linear(64, 128, bias=False)
        cost = cost_of(lambda: layer(torch.empty(32, 64)).sum(), list(layer.parameters()))
    assert cost.flops == 2 * 2 * 32 * 64 * 128  # forward, and the weights' gradient
    assert cost.bytes == 2 * 4 * (32 * 64 + 64 * 128 + 32 * 128)
    assert cost.gradients == 4 * 64 * 128


def test_operations_that_came_before_cost_the_same_again() -> None:
    def work() -> Tensor:
        queries, keys, values = layer(torch.empty(2, 3, 16, 64)).chunk(3, dim=-1)
        attended = functional.scaled_dot_product_attention(queries, keys, values)
        attended = (attended + torch.tensor(2.0) * keys.amax(-1, keepdim=True)).relu_()
        return torch.stack((attended.to(torch.bfloat16).float(), values)).sort(-1)[0].sum()

    costs: list[StepCost] = []
    step_cost._OUTCOMES.clear()
    for _ in range(3):
        with without_values():
            layer = torch.nn.Linear(64, 192)
            costs.append(cost_of(work, list(layer.parameters())))
    assert step_cost._OUTCOMES
    assert costs[0] == costs[1] == costs[2]
    assert costs[0].activations > costs[0].kept > 0


def test_shards_checkpointing_and_shorter_clips_are_proposed_in_this_order() -> None:
    config = WorldModelConfig(towers="generation", num_layers=2)
    estimate = cache(estimate_of(config, TrainerConfig(steps=1)))
    plain, block = estimate(Spread()), estimate(Spread(checkpointing="block"))
    assert block.total < 0.9 * plain.total

    def proposal(memory: float) -> str:
        return fitting_setting(estimate, Spread(), memory / stage_memory.USABLE, (17, 33))

    assert proposal(block.total).startswith("trainer.sharding.checkpointing: block (")
    assert "over 2 devices" in proposal(0.8 * block.total)
    assert "at most 17 frames" in proposal(0.9 * estimate(Spread(1024, "block")).total)
    assert proposal(1e3) == "devices of more memory, or a smaller model"


def test_a_stage_that_cannot_fit_is_refused_before_anything_is_written(
    world: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stage_memory, "device_memory", lambda _device: 1e6)
    config = Stage1Config.model_validate(
        {"model": {"num_layers": 1}, "trainer": {"steps": 2}, "clips": {"lengths": [9], "view_weights": {"primary": 1}}}
    )
    with pytest.raises(ConfigError, match=r"does not fit[\s\S]*weights[\s\S]*next step: set [\s\S]*worldline plan"):
        train_stage1(config, world.inputs, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_is_frozen_and_not_sharded_counts_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = TrainerConfig(steps=1)
    shape = ClipShape(1, ("head",), 33, (8, 12))
    cost = StepCost(activations=100.0, kept=60.0, gradients=4000.0, peak=4050.0)
    alone = StageMemory(
        "s", trainer, Spread(micro_steps=2), shape, 1, 1000, 10, cost, {"tokenizer": 7}, frozen_parts=4000
    )
    assert alone.parts == {
        "weights": 4000, "moments": 8000, "average": 4000, "tokenizer": 7, "state being written": 16000,
        "frozen scores": 4000,
        "gradients": 4000, "activations": 100,
    }  # fmt: skip
    shared = StageMemory("s", trainer, Spread(4), shape, 1, 1000, 10, cost, {"tokenizer": 7}, frozen_parts=4000)
    assert shared.parts == {
        "weights": 1000, "moments": 2000, "average": 1000, "tokenizer": 7, "state being written": 4000,
        "frozen scores": 1000, "gathered": 100,
        "gradients": 1000, "activations": 100,
    }  # fmt: skip
    whole = StageMemory("s", trainer, Spread(4, reduced_at_once=False), shape, 1, 1000, 10, cost)
    assert whole.parts["gradients"] == 4000


def test_micro_steps_follow_from_a_global_batch() -> None:
    trainer = TrainerConfig(steps=1, batch_size=2, global_batch=64)
    assert Spread.of(trainer, 8).micro_steps == 4
    assert not Spread.of(trainer, 8).reduced_at_once
    assert Spread.of(trainer, 32).reduced_at_once


def test_page_cache_counts_as_free_and_a_control_group_as_a_limit(tmp_path: Path) -> None:
    group = tmp_path / "sys/fs/cgroup"
    group.mkdir(parents=True)
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/meminfo").write_text("MemTotal: 9000 kB\nMemAvailable: 5000 kB\nHugePages_Total: 0\n")
    assert stage_memory.device_memory("cpu", tmp_path) == 5000 * 1024
    (group / "memory.max").write_text("max\n")
    assert stage_memory.device_memory("cpu", tmp_path) == 5000 * 1024
    (group / "memory.max").write_text("1000000\n")
    (group / "memory.current").write_text("900000\n")
    (group / "memory.stat").write_text("anon 200000\nactive_file 300000\ninactive_file 400000\n")
    assert stage_memory.device_memory("cpu", tmp_path) == 800000


def test_parameters_are_counted_on_the_real_model() -> None:
    config = WorldModelConfig(towers="generation", num_layers=3)
    model = WorldModel(config)
    assert parameter_counts(config)[0] == sum(value.numel() for value in model.parameters())
    trained = parameter_counts(config, lambda name: name.startswith("action_encoder."))[0]
    assert trained == sum(value.numel() for _, value in model.action_parameters())


@pytest.mark.parametrize("sampler", ["causal", pytest.param("stage2", marks=pytest.mark.slow)])
def test_rollouts_are_timed_with_weights_that_were_never_in_float32(benchmark: ModuleType, sampler: str) -> None:
    rollouts = benchmark.Rollouts.of("tiny", "cpu")
    assert rollouts.model.proj_in.weight.dtype == torch.bfloat16
    assert rollouts.seconds(sampler) > 0
