"""Estimated memory is what a real training step takes; what cannot fit is refused before the first step."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from flows.command_line import main
from tasks.train_stage1 import train_stage1
from tests.model.test_checkpoint import most_bytes
from tests.training.conftest import TINY_MODEL, VIEWS, stage2
from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.config import load_config
from worldline_core.errors import ConfigError
from worldline_core.model.networks import build_world_model
from worldline_core.model.world_model_config import MixtureConfig, WanConfig
from worldline_core.pipeline import memory_estimate, memory_trace
from worldline_core.pipeline.memory_estimate import Estimate, Sources, Training, outlined, trainings
from worldline_core.pipeline.memory_trace import Held
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.pipeline.size_sheet import SizeSheet
from worldline_core.store.store import ArtifactStore
from worldline_core.training.adapters import add_adapters
from worldline_core.training.clip_config import LatentInput
from worldline_core.training.clip_source import LatentStore, ResidentLatents
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.processes import hold_weights
from worldline_core.training.resident import ResidentTracks
from worldline_core.training.trainer import ParameterGroup, train, trained_groups
from worldline_core.training.training_config import (
    LoRAConfig,
    LossWeighting,
    SigmaSampling,
    Stage1Config,
    TrainerConfig,
)
from worldline_core.training.training_state import TrainingStates

SOURCE = Sources(None, None, (64, 96), (8, 12))
SIZES = (
    (MixtureConfig(towers="generation", hidden_size=64, num_heads=1, num_layers=4, intermediate_size=192), 17),
    (MixtureConfig(towers="generation"), 33),
    (MixtureConfig(towers="generation", hidden_size=384, num_heads=6, num_layers=6, intermediate_size=1152), 33),
    (WanConfig(hidden_size=128, num_heads=2, num_layers=4, intermediate_size=384, text_size=64, text_length=16), 17),
)
TWO_LAYERS = MixtureConfig(towers="generation", num_layers=2)
BLOCK = {"checkpointing": "block", "reduce_every_micro_step": True}
objective = partial(FlowMatchingObjective, sigma=SigmaSampling(), weighting=LossWeighting())


def training_of(config, frames=33, lora=None, **trainer):
    def work(config):
        batch, model = SOURCE.batch(config, 1, config.views, frames), outlined(config, lora)
        return [model], [(1, partial(objective(model).loss, batch, torch.Generator(), 0))], {}

    return Training("stage", TrainerConfig.model_validate({"steps": 2, "batch_size": 1, **trainer}), config, work)


EIGHT_BITS = {"weights": "bf16", "optimizer": {"moments": "8bit"}, "average": "host"}


@pytest.mark.parametrize(
    ("size", "values"),
    [
        (0, {"precision": "fp32", "accumulation": 2}),
        pytest.param(2, {"precision": "fp32", "accumulation": 2}, marks=pytest.mark.slow),
        pytest.param(0, {"precision": "fp32"}, id="gradients come as activations go", marks=pytest.mark.slow),
        pytest.param(3, {"precision": "fp32", "accumulation": 2}, id="Wan", marks=pytest.mark.slow),
        pytest.param(0, {"accumulation": 2, "sharding": {"checkpointing": "block"}}, marks=pytest.mark.slow),
        pytest.param(1, {"accumulation": 2, "sharding": {"checkpointing": "block"}}, marks=pytest.mark.slow),
        pytest.param(0, {"accumulation": 2, **EIGHT_BITS}, marks=pytest.mark.slow),
        pytest.param(2, {"accumulation": 2, **EIGHT_BITS}, marks=pytest.mark.slow),
        (0, {"accumulation": 2, "lora": LoRAConfig(rank=16)}),
        pytest.param(2, {"accumulation": 2, "lora": LoRAConfig(rank=16)}, marks=pytest.mark.slow),
    ],
)
def test_estimated_memory_is_what_the_allocator_hands_out(size, values, tmp_path, monkeypatch):
    """The copy of a state that is being written is not counted: how long it is there depends on the disk."""
    (config, frames), lora = SIZES[size], values.get("lora")
    training = training_of(config, frames, **values)
    trainer, model = training.trainer, build_world_model(config)
    model.initialise(torch.Generator().manual_seed(0))
    if lora is not None:
        add_adapters(model, lora, 0)
    hold_weights(model, trainer.precision, trainer.weights)
    model.checkpointing = trainer.sharding.checkpointing
    batch = SOURCE.batch(config, 1, config.views, frames)
    for tensor in (batch.latents, batch.action_maps):
        tensor.normal_()
    monkeypatch.setattr(TrainingStates, "save", lambda *_: None)
    groups = trained_groups(ParameterGroup("all", dict(model.named_parameters())))
    given = {"objective": objective(model), "load": lambda _: batch, "identity": {}, "title": "memory"}
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as recorded:
        train(trainer, groups=groups, output=tmp_path, **given)
    taken = most_bytes(recorded, already=sum(parameter.nbytes for parameter in model.parameters()))
    estimated = training.estimate(1)
    # A machine without a card holds an average on the host beside the rest, and what passes the weights to it.
    weights = [*model.parameters()] if trainer.average == "host" else []
    host = sum(4 * value.numel() for value in weights) + max((value.nbytes for value in weights), default=0)
    over = 0 if trainer.accumulation > 1 else estimated.parts["gradients"]
    assert -0.02 * taken < estimated.total + host - taken < 0.02 * taken + over


@pytest.mark.slow
def test_a_deep_model_holds_what_two_shallow_ones_predict(monkeypatch):
    # The backward pass of deep models holds most where shallow ones do before it.
    for depths in ((2, 3), (1, 2)):
        found = memory_trace.extrapolated(lambda layers: {"before": 10 + layers, "after": 2 * layers}, 36, depths)
        assert found == {"before": 46, "after": 72}
    config = MixtureConfig(towers="generation", num_layers=10)
    lines = [training_of(config, sharding=BLOCK).estimate(devices) for devices in (1, 2)]
    monkeypatch.setattr(memory_estimate, "extrapolated", lambda figures, layers, _: figures(layers))
    assert lines == [training_of(config, sharding=BLOCK).estimate(devices) for devices in (1, 2)]


def test_operations_are_those_that_torch_counts():
    config, model = TWO_LAYERS, build_world_model(TWO_LAYERS)
    batch = SOURCE.batch(config, 1, config.views, 17)
    with FlopCounterMode(display=False) as counter:
        objective(model).loss(batch, torch.Generator(), 0)[0].backward()
    tokens, width = 3 * 5 * 4 * 6, config.num_heads * config.head_dim
    attention = config.num_layers * 14 * tokens**2 * width  # two products on the way there and five on the way back
    figures = training_of(config, 17, precision="fp32").figures(config.num_layers, sharded=False)
    assert figures["operations"] == sum(counter.get_flop_counts()["Global"].values()) + attention


def test_checkpointing_and_more_devices_hold_less():
    totals = [
        training_of(TWO_LAYERS, **values).estimate(n).total
        for n, values in ((1, {}), (1, {"sharding": BLOCK}), (4, {"sharding": BLOCK}))
    ]
    assert totals[0] > 1.1 * totals[1] > 1.3 * totals[2]


def test_parts_are_shared_out_but_for_what_is_frozen_and_whole(monkeypatch):
    monkeypatch.setattr(memory_estimate, "traced", lambda *_: Held(100, 0))

    def work(config):
        models = [build_world_model(config), build_world_model(config).requires_grad_(False)]
        return models, [(1, lambda: None)], {"decoder": torch.nn.Linear(1, 1)}

    count = sum(value.numel() for value in build_world_model(TWO_LAYERS).parameters())

    def parts(devices, **trainer):
        return replace(training_of(TWO_LAYERS, precision="fp32", **trainer), work=work).estimate(devices).parts

    whole = {"weights": 4, "moments": 8, "average": 4, "frozen scores": 4, "gradients": 4}
    assert parts(1, accumulation=2) == {name: size * count for name, size in whole.items()} | {
        "decoder": 8, "activations": 100,
    }  # fmt: skip
    block = sum(value.numel() for value in build_world_model(TWO_LAYERS).layers[0].parameters())
    assert parts(4) == {name: size * count / 4 for name, size in whole.items()} | {
        "decoder": 8, "gathered": 10 * block, "activations": 100,
    }  # fmt: skip
    # Micro-steps follow from a global batch; their gradients are whole unless each is summed at once.
    assert [parts(n, global_batch=8)["gradients"] for n in (4, 8)] == [4 * count, count / 2]
    assert parts(4, global_batch=8, sharding=BLOCK)["gradients"] == count


def sheet(preset, *overrides, devices=1):
    config = PipelineConfig.load(preset, overrides=overrides)
    values = {"config": config, "project": Path(__file__).parents[2], "devices": devices, "card": "H100"}
    return SizeSheet.model_validate(values)


@pytest.mark.slow
def test_distillation_from_frames_holds_what_encodes_them():
    frames = "distill.input={kind: frames, image_size: [64, 96]}"
    cached, online = (sheet("smoke", *more).rows()[2:] for more in ((), (frames,)))
    assert [row.title for row in cached] == [
        "distill: teacher forcing", "distill: trajectories (a shard of 2 clips)", "distill: trajectory regression",
        "distill: distribution matching",
    ]  # fmt: skip
    for less, more in zip(cached, online, strict=True):
        assert less.fits(80e9)
        assert more.total >= less.total + more.parts["encoder"] > less.total


@pytest.mark.parametrize("native_size", [None, 5])
def test_resident_bytes_are_those_on_the_device(world, native_size):
    config = stage2(2, input=LatentInput(resident=True), weighting={"things": [1, 0]})
    taken = {} if native_size is None else {"action_conditioning": "vectors", "native_size": native_size}
    model = MixtureConfig.model_validate(TINY_MODEL | taken)
    source = ResidentLatents(LatentStore.open(world.latents), "cpu")
    tracks = ResidentTracks(ActionTracks.open(world.tracks), source.rows, VIEWS, "cpu", native_size)
    held = [source._frames.nbytes, *(values.nbytes for values in tracks._samples.values())]
    held.append(sum(2 * 4 * 4 * row.num_frames * len(row.views) for row in source.rows))
    counted = memory_estimate.resident_bytes(config, world.inputs, model)
    assert 0 <= counted - sum(held) < 3000  # the head of the file
    assert memory_estimate.resident_bytes(stage2(2), world.inputs, model) == 0


def test_a_training_that_cannot_fit_its_card_is_refused_before_it_begins(world, tmp_path, monkeypatch):
    values = {"model": {"num_layers": 1}, "trainer": {"steps": 1, "batch_size": 1}, "clips": {"lengths": [9]}}
    config, inputs = Stage1Config.model_validate(values), {"episodes": world.episodes, "latents": world.latents}
    latents = LatentStore.open(world.latents)
    (training,) = trainings(config, config.model, Sources(None, None, latents.image_size, latents.latent_shape[1:]))
    alone = training.estimate(1).total
    for resident, more in ((False, ""), (True, "resident input[^;]*false")):
        config = config.model_copy(update={"input": LatentInput(resident=resident)})
        need = (alone + memory_estimate.resident_bytes(config, inputs, config.model)) / memory_estimate.USABLE
        monkeypatch.setattr(memory_estimate, "device_memory", lambda _device, need=need: 1.001 * need)
        memory_estimate.require_memory(config, inputs)
        monkeypatch.setattr(memory_estimate, "device_memory", lambda _device, need=need: 0.999 * need)
        message = rf"stage I on cpu[\s\S]*weights[\s\S]*{more}[\s\S]*worldline plan"
        with pytest.raises(ConfigError, match=message):
            train_stage1.run(ArtifactStore(tmp_path), config, inputs)


def test_what_does_not_fit_ends_with_status_one(capsys, monkeypatch):
    need = Estimate("stage II", 7, {"weights": 3e9, "activations": 1e9})
    monkeypatch.setattr(SizeSheet, "rows_and_rollouts", lambda *_: ([need], []))
    for option, named in (
        (["--gpus", "1", "--memory", "4GB"], "| stage II | 0.0 M | 4.0 | weights 3.0, activations 1.0 | no |"),
        (["--memory", "much"], "memory"), (["--gpus", "0"], "devices"),
    ):  # fmt: skip
        with pytest.raises(SystemExit, match="1"):
            main(["plan", "--preset", "smoke", *option])
        assert named in "".join(capsys.readouterr())


def test_memory_alone_names_its_preset_and_no_speed_of_another_card(capsys, monkeypatch):
    need, tried = Estimate("stage II", 7, {"weights": 3e9}, operations=1e15, steps=1), []

    def rows(sheet):
        tried.append(sheet.config.train_stage2.clips.lengths)
        return [need] if tried[-1] == (17,) else None

    monkeypatch.setattr(SizeSheet, "fitting_rows", rows)
    with pytest.raises(SystemExit, match="0"):
        main(["plan", "--fit", "--memory", "24GB"])
    printed = capsys.readouterr().out
    assert "what changes of edge-24gb:" in printed
    assert "--set 'train_stage2.clips.lengths=[17]'" in printed
    assert "| stage II | 0.0 M | 3.0 | weights 3.0 | yes |" in printed
    assert "hours |" not in printed
    assert tried[0] == (33,)


def test_distillation_from_frames_of_another_size_than_stage2s_is_refused():
    with pytest.raises(ConfigError, match=r"\[64, 96\][\s\S]*\[480, 640\][\s\S]*distill\.input\.image_size"):
        load_config(PipelineConfig, preset="cosmos3-nano", overrides=["distill.input.kind=frames"])
    same = "distill.input={kind: frames, image_size: [480, 640]}"
    load_config(PipelineConfig, preset="cosmos3-nano", overrides=[same])


@pytest.mark.slow
def test_the_full_size_fits_cards_of_80_gb():
    rows = {row.title: row for row in sheet("cosmos3-nano", devices=8).rows()}
    # Both towers of Cosmos3-Nano; student and fake score of the video tower, which takes most memory.
    for title, counted in (("stage I", 14.5e9), ("distill: distribution matching", 13.9e9)):
        need = rows[title]
        assert need.parameters == pytest.approx(counted, rel=0.01)
        assert need.fits(80e9), need.describe_parts()


def test_an_inherited_import_counts_only_for_the_base_that_it_makes():
    inherited, own = (sheet("cosmos3-nano", *changes) for changes in ((), ("models.base=null",)))
    assert own.config.import_backbone is not None
    assert own.model == own.config.train_stage1.model
    assert inherited.model.hidden_size > own.model.hidden_size
