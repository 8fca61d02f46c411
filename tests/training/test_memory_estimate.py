"""Estimated memory is what a real training step takes; what cannot fit is refused before the first step."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.profiler import ProfilerActivity, profile

from tasks.train_stage1 import train_stage1
from worldline_core.config import load_config
from worldline_core.errors import ConfigError
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import WorldModelConfig
from worldline_core.pipeline import memory_estimate
from worldline_core.pipeline.memory_estimate import (
    ClipShape,
    Cost,
    Training,
    device_memory,
    extrapolated,
    parameter_counts,
    traced,
    trainings,
    upper_bound,
)
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.pipeline.size_sheet import Machine, SizeSheet
from worldline_core.store.store import ArtifactStore
from worldline_core.training.clip_config import ClipSampling
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.trainer import ParameterGroup, train
from worldline_core.training.training_config import LossWeighting, SigmaSampling, Stage1Config, TrainerConfig
from worldline_core.training.training_state import TrainingStates

PROJECT = Path(__file__).parents[2]


SIZES = (
    (WorldModelConfig(towers="generation", hidden_size=64, num_heads=1, num_layers=4, intermediate_size=192), 17),
    (WorldModelConfig(towers="generation"), 33),
    (WorldModelConfig(towers="generation", hidden_size=384, num_heads=6, num_layers=6, intermediate_size=1152), 33),
)


def planned_and_measured(config: WorldModelConfig, frames: int, trainer: TrainerConfig) -> tuple[float, float]:
    """Bytes of two real training steps: planned, and handed out by torch's allocator at the worst moment.

    Neither counts the copy of a state that is being written: how long it is there depends on the disk.
    """
    grid = (8, 12)
    shape = ClipShape(1, config.views, frames, grid)
    objective = partial(FlowMatchingObjective, sigma=SigmaSampling(), weighting=LossWeighting())
    clips = ClipSampling(lengths=(frames,))
    training = Training(
        "memory", trainer, clips, config, config.views, grid, objective, lambda shape: shape.batch(config)
    )
    parts = training.estimate(1).parts
    planned = sum(size for name, size in parts.items() if name != "state being written")
    model = WorldModel(config)
    model.initialise(torch.Generator().manual_seed(0))
    model.checkpointing = trainer.sharding.checkpointing
    batch = shape.batch(config)
    for tensor in (batch.latents, batch.action_maps):
        if tensor is not None:
            tensor.normal_()
    weights = sum(parameter.nbytes for parameter in model.parameters())
    with (
        tempfile.TemporaryDirectory() as folder,
        patch.object(TrainingStates, "save"),
        profile(activities=[ProfilerActivity.CPU], profile_memory=True) as recorded,
    ):
        train(
            trainer,
            groups=[ParameterGroup("all", dict(model.named_parameters()))],
            objective=objective(model),
            load=lambda _: batch,
            output=Path(folder),
            identity={},
            title="memory",
        )
    return planned, weights + most_bytes(recorded)


def most_bytes(recorded: profile) -> int:
    """Most bytes that the allocator had handed out at once while it was profiled."""
    results: Any = recorded.profiler.kineto_results if recorded.profiler is not None else None
    handed_out = [(e.start_ns(), e.nbytes()) for e in results.events() if e.name() == "[memory]"]
    live = most = 0
    for _, size in sorted(handed_out):
        live += size
        most = max(most, live)
    return most


@pytest.mark.parametrize(
    ("size", "precision", "accumulation", "checkpointing"),
    [
        (0, "fp32", 1, "none"),
        pytest.param(2, "fp32", 1, "none", marks=pytest.mark.slow),
        (0, "bf16", 2, "block"),
        pytest.param(1, "bf16", 2, "block", marks=pytest.mark.slow),
    ],
)
def test_estimated_memory_is_what_the_allocator_hands_out(
    size: int, precision: str, accumulation: int, checkpointing: str
) -> None:
    config, frames = SIZES[size]
    values = {"steps": 2, "precision": precision, "accumulation": accumulation, "batch_size": 1}
    trainer = TrainerConfig.model_validate(values | {"sharding": {"checkpointing": checkpointing}})
    estimated, measured = planned_and_measured(config, frames, trainer)
    assert estimated == pytest.approx(measured, rel=0.02)


def training_of(config: WorldModelConfig, lengths: tuple[int, ...] = (17, 33), **more: Any) -> Training:
    return Training(
        "stage", TrainerConfig.model_validate({"steps": 1, "batch_size": 1, **more}), ClipSampling(lengths=lengths),
        config, config.views, (8, 12),
        lambda model: FlowMatchingObjective(model, sigma=SigmaSampling(), weighting=LossWeighting()),
        lambda shape: shape.batch(config),
    )  # fmt: skip


def test_a_deep_model_costs_what_two_shallow_ones_predict(monkeypatch: pytest.MonkeyPatch) -> None:
    config = WorldModelConfig(towers="generation", num_layers=9)
    training = training_of(config)
    line = training.micro_step(0, sharded=False)
    monkeypatch.setattr(memory_estimate, "extrapolated", lambda trace, size, _: trace(size))
    whole = training.micro_step(0, sharded=False)
    assert line.all_flops == pytest.approx(whole.all_flops, rel=1e-9)
    assert line.activations == pytest.approx(whole.activations, rel=1e-3)
    assert line.gradients == whole.gradients == 4 * parameter_counts(config)[0]


def test_deep_models_hold_most_in_the_backward_pass_where_shallow_ones_do_before() -> None:
    cost = extrapolated(lambda layers: Cost(forward=10 + layers, backward=2 * layers, gradients=1), 36, (3, 4))
    assert (cost.forward, cost.backward, cost.activations, cost.peak) == (46, 72, 72, 73)


def test_operations_are_those_of_the_matrix_products() -> None:
    with FakeTensorMode():
        layer = torch.nn.Linear(64, 128, bias=False)
        cost = traced(lambda: layer(torch.empty(32, 64)).sum(), list(layer.parameters()))
    assert cost.all_flops == 2 * 2 * 32 * 64 * 128  # forward, and the weights' gradient
    assert cost.gradients == 4 * 64 * 128


def test_attention_is_counted_apart_and_scaled_with_the_square_of_the_clip() -> None:
    config = WorldModelConfig(towers="generation", num_layers=2)
    short = training_of(config, (17,)).estimate(1).flops
    long = training_of(config, (33,)).estimate(1).flops
    assert training_of(config).estimate(1).flops == pytest.approx((short + long) / 2, rel=0.1)


BLOCK = {"checkpointing": "block", "reduce_every_micro_step": True}


def test_shards_checkpointing_and_shorter_clips_are_proposed_in_this_order() -> None:
    config = WorldModelConfig(towers="generation", num_layers=2)
    training = training_of(config)
    plain, block = training.estimate(1).total, training_of(config, sharding=BLOCK).estimate(1).total
    assert block < 0.9 * plain

    def proposal(memory: float) -> str:
        return training.fitting_setting(1, memory / memory_estimate.USABLE)

    assert proposal(block).startswith("trainer.sharding.checkpointing: block (")
    assert "over 2 devices" in proposal(0.8 * block)
    assert "at most 17 frames" in proposal(0.9 * training_of(config, sharding=BLOCK).estimate(1024).total)
    assert proposal(1e3) == "devices of more memory, or a smaller model"


def test_parts_are_shared_out_but_for_what_is_frozen_and_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    cost = Cost(forward=100, held=60, gradients=4000, peak=4050)
    monkeypatch.setattr(Training, "micro_step", lambda *_args, **_named: cost)
    monkeypatch.setattr(memory_estimate, "parameter_counts", lambda *_: (1000, 10))

    def parts(devices: int, **trainer: Any) -> Any:
        training = training_of(WorldModelConfig(towers="generation", num_layers=2), **trainer)
        frozen = {"tokenizer": (7, Cost(forward=50))}
        return replace(training, scores=1, before=lambda _: frozen).estimate(devices).parts

    assert parts(1, accumulation=2) == {
        "weights": 4000, "moments": 8000, "average": 4000, "tokenizer": 7, "state being written": 16000,
        "frozen scores": 4000, "gradients": 4000, "activations": 100,
    }  # fmt: skip
    assert parts(4) == {
        "weights": 1000, "moments": 2000, "average": 1000, "tokenizer": 7, "state being written": 4000,
        "frozen scores": 1000, "gathered": 100, "gradients": 1000, "activations": 100,
    }  # fmt: skip
    # Micro-steps follow from a global batch; their gradients are whole unless each is summed at once.
    assert parts(4, global_batch=8)["gradients"] == 4000
    assert parts(8, global_batch=8)["gradients"] == 500
    assert parts(4, global_batch=8, sharding=BLOCK)["gradients"] == 1000


@pytest.mark.slow
def test_distillation_from_frames_holds_what_encodes_them() -> None:
    needs = []
    for overrides in ((), ("distill.input={kind: frames, image_size: [64, 96]}",)):
        config = load_config(PipelineConfig, preset="smoke", overrides=overrides)
        sheet = SizeSheet(config, PROJECT, Machine.model_validate({"memory": "16GB"}))
        found = trainings(config.distill, sheet.generation, sheet.source(config.distill))
        needs.append([one.estimate(1) for one in found[:2]])
    for cached, online in zip(*needs, strict=True):
        assert online.total >= cached.total + online.parts["encoder"] > cached.total


@pytest.mark.parametrize("preset", ["tiny", "demo", "small_world"])
def test_small_presets_are_cleared_for_8_gb_by_the_upper_bound(preset: str) -> None:
    sheet = SizeSheet(load_config(PipelineConfig, preset=preset), PROJECT, Machine.model_validate({"memory": "8GB"}))
    found = sheet.trainings()
    assert len(found) == 5
    assert all(one.upper_bound < 8e9 for one in found)
    distill = sheet.config.distill
    assert upper_bound(sheet.generation, memory_estimate.trajectory_clips(distill, sheet.source().grid)) < 8e9


def test_the_upper_bound_is_above_the_estimate() -> None:
    training = training_of(WorldModelConfig(towers="generation", num_layers=2))
    assert training.estimate(1).total < training.upper_bound


def test_a_stage_that_cannot_fit_is_refused_before_it_begins(
    world: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory_estimate, "device_memory", lambda _device: 1e6)
    config = Stage1Config.model_validate(
        {"model": {"num_layers": 1}, "trainer": {"steps": 2}, "clips": {"lengths": [9], "view_weights": {"primary": 1}}}
    )
    with pytest.raises(ConfigError, match=r"stage I on cpu[\s\S]*weights[\s\S]*worldline plan"):
        train_stage1.run(
            ArtifactStore(tmp_path), config, {name: world.inputs[name] for name in ("episodes", "latents")}
        )


@pytest.mark.parametrize(("share", "refused"), [(1.001, False), (0.999, True)])
def test_what_fits_by_a_hair_is_let_through(
    world: Any, monkeypatch: pytest.MonkeyPatch, share: float, refused: bool
) -> None:
    config = Stage1Config.model_validate(
        {"model": {"num_layers": 1}, "trainer": {"steps": 2}, "clips": {"lengths": [9]}}
    )
    source = memory_estimate._source(config, world.inputs)
    assert source is not None
    (training,) = trainings(config, config.model, source)
    need = training.estimate(1)
    memory = share * need.total / memory_estimate.USABLE
    assert training.upper_bound > memory
    monkeypatch.setattr(memory_estimate, "device_memory", lambda _device: memory)
    if refused:
        with pytest.raises(ConfigError, match="does not fit"):
            memory_estimate.require_memory(config, world.inputs)
    else:
        memory_estimate.require_memory(config, world.inputs)


def test_page_cache_counts_as_free_and_a_control_group_as_a_limit(tmp_path: Path) -> None:
    group = tmp_path / "sys/fs/cgroup"
    group.mkdir(parents=True)
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/meminfo").write_text("MemTotal: 9000 kB\nMemAvailable: 5000 kB\nHugePages_Total: 0\n")
    assert device_memory("cpu", tmp_path) == 5000 * 1024
    (group / "memory.max").write_text("max\n")
    assert device_memory("cpu", tmp_path) == 5000 * 1024
    (group / "memory.max").write_text("1000000\n")
    (group / "memory.current").write_text("900000\n")
    (group / "memory.stat").write_text("anon 200000\nactive_file 300000\ninactive_file 400000\n")
    assert device_memory("cpu", tmp_path) == 800000


def test_parameters_are_counted_on_the_real_model() -> None:
    config = WorldModelConfig(towers="generation", num_layers=3)
    model = WorldModel(config)
    assert parameter_counts(config)[0] == sum(value.numel() for value in model.parameters())
    trained = parameter_counts(config, lambda name: name.startswith("action_encoder."))[0]
    assert trained == sum(value.numel() for _, value in model.action_parameters())
