"""The sheet of a preset: cards by name, planned times, and what is proposed for a card."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from worldline_core.config import read_config
from worldline_core.errors import ConfigError
from worldline_core.pipeline.cards import CARDS, PRESETS, UTILISATION, card_memory, find_card, preset_for
from worldline_core.pipeline.memory_estimate import Estimate, Sources
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.pipeline.rollout_speed import block_costs
from worldline_core.pipeline.size_sheet import SizeSheet
from worldline_core.pipeline.smaller import largest_fitting, smaller_settings
from worldline_core.rollout.samplers import BlockCausalSimulator, Noise


@pytest.mark.parametrize(
    ("given", "card"),
    [("RTX 4090", "RTX 4090"), ("NVIDIA GeForce RTX 4090", "RTX 4090"), ("4090", "RTX 4090"), ("a6000", "RTX A6000"),
     ("rtxpro6000", "RTX PRO 6000"), ("h100", "H100")],
)  # fmt: skip
def test_a_card_is_found_by_its_usual_names(given, card):
    assert find_card(given) == card


@pytest.mark.parametrize("given", ["6000", "RTX 6090", "", "0"])
def test_unknown_cards_and_names_of_several_are_refused(given):
    with pytest.raises(ConfigError, match=r"RTX 3090, RTX 4090"):
        find_card(given)


def test_seconds_and_hours_are_planned_from_operations():
    sheet = SizeSheet.model_validate({"config": PipelineConfig.load("smoke"), "project": ".", "card": "l40s"})
    second = UTILISATION * CARDS["L40S"].operations
    stages = [
        Estimate("stage II", 7, {"weights": 4e9}, operations=second / 2, steps=7200),
        Estimate("short", 7, {"weights": 4e9}, operations=second, minutes=30),
        Estimate("fp32", 7, {"weights": 4e9}, steps=3),
    ]
    text = sheet.as_text(stages)
    assert "48.0 GB" in text
    assert "planned, not measured" in text
    for row in (
        "weights 4.0 | 0.5 | 1 | yes",
        "weights 4.0 | 1 | 0.5 | yes",
        "weights 4.0 |  |  | yes",
        "In all 1.5 hours",
    ):
        assert row in text


@pytest.mark.parametrize(
    ("card", "preset"),
    [
        ("10GB", "my_robot"),
        ("RTX 3090", "edge-24gb"),
        ("32GB", "edge-24gb"),
        ("l40s", "edge-48gb"),
        ("B200", "edge-80gb"),
    ],
)
def test_a_card_gets_the_largest_preset_made_for_it(card, preset):
    assert preset_for(card_memory(card)) == preset
    card = read_config(preset, None).get("card")
    assert card is None if preset == "my_robot" else CARDS[card].memory == PRESETS[preset]


@pytest.mark.slow
def test_distribution_matching_is_planned_by_models_that_are_deep_enough():
    # At depths 2 and 3 its worst moment on eight devices is another one.
    sheet = SizeSheet.model_validate({"config": PipelineConfig.load("cosmos3-nano"), "project": "."})
    training = sheet._trainings()[-1]
    assert training.title.endswith("distribution matching")
    with sheet._processes() as pool:  # after a trace in this process those of later tests could not be forked
        found = [pool.submit(each.estimate, 8) for each in (training, replace(training, shallow=(5, 6)))]
    assert found[0].result() == found[1].result()


def test_steps_of_a_distillation_that_are_left_out_are_not_planned():
    config = PipelineConfig.load("edge-80gb", overrides=["distill.last_step=teacher_forcing"])
    trained = SizeSheet.model_validate({"config": config, "project": "."})._trainings()
    assert [one.title for one in trained if one.title.startswith("distill")] == ["distill: teacher forcing"]
    changed = {key.partition("=")[0] for made in smaller_settings(config) for key in made}
    assert "distill.teacher_forcing.trainer.weights" in changed
    assert "distill.distribution_matching.trainer.weights" not in changed


def test_precision_goes_before_clips_and_pictures_and_adapters_come_last():
    def load(changes):
        return PipelineConfig.load("edge-80gb", overrides=changes)

    settings = smaller_settings(load(()))
    orders = [next(n for n, made in enumerate(settings) if any(key in one for one in made))
              for key in ("checkpointing", "moments", "weights=bf16", "lengths", "image_size", "lora")]  # fmt: skip
    assert orders == sorted(orders)
    tried = []

    def fits(config):
        tried.append(config)
        return max(config.distill.clips.lengths) <= 65

    changes = largest_fitting(load, fits)
    assert not any("checkpointing" in change for change in changes)  # the preset has it
    found = load(changes)
    assert len(tried) <= 5
    assert (found.distill.clips.lengths, found.encode_latents.clip_frames) == ((65,), 65)
    assert (found.train_stage2.lora, found.encode_latents.image_size) == (None, (480, 640))
    assert largest_fitting(load, lambda _: True) == []
    with pytest.raises(ConfigError, match="No setting of this preset fits"):
        largest_fitting(load, lambda _: False)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["edge-24gb", "edge-48gb", "edge-80gb", "nano-80gb-lora"])
def test_every_stage_of_a_preset_fits_its_card(preset):
    config = PipelineConfig.load(preset)
    sheet = SizeSheet.model_validate({"config": config, "project": ".", "card": config.card})
    rows, rollouts = sheet.rows_and_rollouts()
    assert len(rows) == 5
    assert not [(row.title, row.total) for row in rows if not row.fits(sheet.bytes)]
    assert [(cost.views, cost.frames) for cost in rollouts] == [(1, 16), (3, 16)]
    assert all(cost.small_decoding < 0.03 * cost.decoding for cost in rollouts)
    assert sheet.as_text(rows, rollouts).count("blocks of 16 frames") == 2


@pytest.mark.slow
def test_operations_of_a_block_are_those_that_a_rollout_does(make_model):
    config = PipelineConfig.load("smoke").distill
    spec, views = config.spec, config.views
    model = make_model(num_layers=2)
    source = Sources(None, None, (64, 96), (4, 6))
    # Not a thread: torch keeps a guard of the first thread that traces, and the next trace after its end is a segmentation fault.
    with ProcessPoolExecutor(1, get_context("fork")) as pool:
        planned = block_costs(config, model.config, source, [views], pool)()[0]
    simulator = BlockCausalSimulator(model, spec, noise=Noise([0]), views=views)

    def maps(frames):
        return torch.zeros(1, len(views), model.config.control_channels, frames, 4, 6)

    simulator.start(torch.zeros(1, len(views), model.config.latent_channels, 4, 6), maps(1))
    for _ in range(spec.sink_blocks + spec.recent_blocks):
        simulator.step(maps(spec.block_size))
    attention = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu
    known = {attention: lambda q, k, v, *_, **__: sdpa_flop_count(q, k, v)}
    with FlopCounterMode(display=False, custom_mapping=known) as counted:
        simulator.step(maps(spec.block_size))
    assert planned.sampling == counted.get_total_flops()
    assert planned.frames_per_second(2 * (planned.sampling + planned.decoding), small=False) == 2 * planned.frames
