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
    extrapolated,
    largest_batch,
    parameter_counts,
    traced,
    trainings,
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

    The copy of a state that is being written is not counted: how long it is there depends on the disk.
    """
    grid = (8, 12)
    shape = ClipShape(1, config.views, frames, grid)
    objective = partial(FlowMatchingObjective, sigma=SigmaSampling(), weighting=LossWeighting())
    clips = ClipSampling(lengths=(frames,))
    training = Training("memory", trainer, clips, config, shape, objective, lambda: shape.batch(config))
    planned = training.estimate(1).total
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
    trainer = TrainerConfig.model_validate({"steps": 1, "batch_size": 1, **more})
    clips = ClipSampling(lengths=lengths)
    shape = largest_batch(trainer, clips, config.views, (8, 12))
    return Training(
        "stage", trainer, clips, config, shape,
        lambda model: FlowMatchingObjective(model, sigma=SigmaSampling(), weighting=LossWeighting()),
        lambda: shape.batch(config),
    )  # fmt: skip


def test_a_deep_model_costs_what_two_shallow_ones_predict(monkeypatch: pytest.MonkeyPatch) -> None:
    training = training_of(WorldModelConfig(towers="generation", num_layers=9))
    line = training.turn(0, sharded=False)
    monkeypatch.setattr(memory_estimate, "extrapolated", lambda trace, size, _: trace(size))
    whole = training.turn(0, sharded=False)
    assert line.all_flops == pytest.approx(whole.all_flops, rel=1e-9)
    assert line.activations == pytest.approx(whole.activations, rel=1e-3)


def test_deep_models_hold_most_in_the_backward_pass_where_shallow_ones_do_before() -> None:
    cost = extrapolated(lambda layers: Cost(forward=10 + layers, backward=2 * layers), 36, (3, 4))
    assert (cost.forward, cost.backward, cost.activations) == (46, 72, 72)


def test_operations_are_those_of_the_matrix_products() -> None:
    with FakeTensorMode():
        layer = torch.nn.Linear(64, 128, bias=False)
        cost = traced(lambda: layer(torch.empty(32, 64)).sum(), list(layer.parameters()))
    assert cost.all_flops == 2 * 2 * 32 * 64 * 128  # forward, and the weights' gradient


def test_attention_is_counted_apart_and_scaled_with_the_square_of_the_clip() -> None:
    config = WorldModelConfig(towers="generation", num_layers=2)
    short, long = (training_of(config, (frames,)).estimate(1).flops for frames in (17, 33))
    assert training_of(config).estimate(1).flops == pytest.approx((short + long) / 2, rel=0.1)


BLOCK = {"checkpointing": "block", "reduce_every_micro_step": True}


def test_checkpointing_and_more_devices_are_proposed_in_this_order() -> None:
    config = WorldModelConfig(towers="generation", num_layers=2)
    training = training_of(config)
    plain, block = training.estimate(1).total, training_of(config, sharding=BLOCK).estimate(1).total
    assert block < 0.9 * plain

    def proposal(memory: float) -> str:
        return training.fitting_setting(1, memory / memory_estimate.USABLE)

    assert proposal(block).startswith("trainer.sharding.checkpointing: block (")
    assert "over 4 devices" in proposal(0.8 * block)
    assert "shorter clips" in proposal(1e3)


def test_parts_are_shared_out_but_for_what_is_frozen_and_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    cost = Cost(forward=100, held=60, peak=4050)
    monkeypatch.setattr(Training, "turn", lambda *_args, **_named: cost)
    monkeypatch.setattr(memory_estimate, "parameter_counts", lambda *_: (1000, 10))

    def parts(devices: int, **trainer: Any) -> Any:
        training = training_of(WorldModelConfig(towers="generation", num_layers=2), **trainer)
        frozen = {"tokenizer": (7, Cost(forward=50))}
        return replace(training, scores=1, before=lambda: frozen).estimate(devices).parts

    assert parts(1, accumulation=2) == {
        "weights": 4000, "moments": 8000, "average": 4000, "tokenizer": 7, "frozen scores": 4000, "gradients": 4000,
        "activations": 100,
    }  # fmt: skip
    assert parts(1)["activations"] == 50
    assert parts(4) == {
        "weights": 1000, "moments": 2000, "average": 1000, "tokenizer": 7, "frozen scores": 1000, "gathered": 100,
        "gradients": 1000, "activations": 100,
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


@pytest.mark.parametrize(("share", "refused"), [(1.001, False), (0.999, True)])
def test_a_training_that_cannot_fit_its_card_is_refused_before_it_begins(
    world: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float, refused: bool
) -> None:
    config = Stage1Config.model_validate(
        {"model": {"num_layers": 1}, "trainer": {"steps": 1, "batch_size": 1}, "clips": {"lengths": [9]}}
    )
    inputs = {name: world.inputs[name] for name in ("episodes", "latents")}
    source = memory_estimate._source(config, inputs)
    assert source is not None
    (training,) = trainings(config, config.model, source)
    memory = share * training.estimate(1).total / memory_estimate.USABLE
    monkeypatch.setattr(memory_estimate, "device_memory", lambda _device: memory)
    if refused:
        with pytest.raises(ConfigError, match=r"stage I on cpu[\s\S]*weights[\s\S]*worldline plan"):
            train_stage1.run(ArtifactStore(tmp_path), config, inputs)
    else:
        memory_estimate.require_memory(config, inputs)


def test_parameters_are_counted_on_the_real_model() -> None:
    config = WorldModelConfig(towers="generation", num_layers=3)
    model = WorldModel(config)
    assert parameter_counts(config)[0] == sum(value.numel() for value in model.parameters())
    trained = parameter_counts(config, lambda name: name.startswith("action_encoder."))[0]
    assert trained == sum(value.numel() for _, value in model.action_parameters())
