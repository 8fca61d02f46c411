"""Training and rollouts of a preset on one card, with random weights, beside what is planned and the floor.

    python -m benchmarks.full_size --preset edge-24gb [--preset edge-80gb] [--device cuda] [--blocks 8] [--steps 3] [--compile]

Stage II and teacher forcing: one micro-batch of the longest clips and an update, with the preset's precision, moments and recomputation.
Rollouts: blocks in bfloat16 after the window is full, one sampled while the one before is decoded (on a GPU), in one view and in all: with the shape
of the published autoencoder, or a small decoder. Peak memory is that of the rollout. The floor is the operations at the card's whole
dense speed; the plan counts on a share of it. Without `--device cuda` the same runs on the processor, for presets that are small enough.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from benchmarks.harness import command_line, print_table, timed
from worldline_core.distillation.causal_teacher_forcing import TeacherForcingObjective
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.model.networks import build_world_model
from worldline_core.model.small_decoder import SmallDecoder, SmallDecoderConfig
from worldline_core.model.tokenizers import VideoTokenizer, require_device, tokenizer_outline
from worldline_core.model.world_model_config import WorldModelConfig
from worldline_core.pipeline.cards import CARDS, UTILISATION, find_card
from worldline_core.pipeline.memory_estimate import Estimate, Sources, trainings
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.pipeline.rollout_speed import BlockCost, block_costs
from worldline_core.pipeline.size_sheet import SizeSheet
from worldline_core.rollout.samplers import BlockCausalSimulator, Noise
from worldline_core.rollout.simulation import Session
from worldline_core.training.adapters import add_adapters
from worldline_core.training.clip_loader import Batch
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.processes import hold_weights, place_model
from worldline_core.training.stage2 import stage2_groups, stage2_model_config
from worldline_core.training.trainer import Objective, TrainingRun
from worldline_core.training.training_config import Stage2Config, TrainerConfig

TRAININGS = ("stage II", "distill: teacher forcing")


def one_micro_batch[T: Stage2Config | DistillConfig](config: T, device: str) -> T:
    """The stage with steps of one micro-batch on a device."""

    def short(trainer: TrainerConfig) -> TrainerConfig:
        return trainer.model_copy(update={"accumulation": 1, "global_batch": None, "device": device})

    if isinstance(config, DistillConfig):
        first = config.teacher_forcing
        first = first.model_copy(update={"trainer": short(first.trainer)})
        return config.model_copy(update={"teacher_forcing": first})
    return config.model_copy(update={"trainer": short(config.trainer)})


def planned(config: Stage2Config | DistillConfig, model: WorldModelConfig, source: Sources) -> Estimate:
    """The first training of a stage."""
    return trainings(config, model, source)[0].estimate(1)


def trained(
    config: Stage2Config | DistillConfig, model_config: WorldModelConfig, source: Sources, *, steps: int, compiled: bool
) -> tuple[float, float]:
    """Seconds a step, and peak memory [GB]; 0 on a processor, where it is not known."""
    distilled = isinstance(config, DistillConfig)
    trainer = config.teacher_forcing.trainer if distilled else config.trainer
    sharding, device = trainer.sharding.model_copy(update={"compile": compiled}), trainer.device
    with torch.device(device):
        model = build_world_model(model_config)
    if config.lora is not None:
        add_adapters(model, config.lora, 0)
    place_model(model, sharding, precision=trainer.precision, device=device, weights=trainer.weights).train()
    batch = source.largest(
        model_config, trainer.batch_size, config.first_clips if distilled else config.clips,
        config.views if distilled else model_config.views,
    )  # fmt: skip
    batch = replace(
        batch,
        latents=torch.randn(batch.latents.shape, device=device),
        action_maps=None if batch.action_maps is None else torch.rand(batch.action_maps.shape, device=device),
    )
    objective: Objective[Batch] = (
        TeacherForcingObjective(model, config)
        if distilled
        else FlowMatchingObjective(model, sigma=config.sigma, weighting=config.weighting)
    )
    with TemporaryDirectory() as output:
        groups = stage2_groups(model, 1.0)
        run = TrainingRun(trainer, groups, objective, lambda _: batch, (model,), Path(output), "benchmark")
        run.step(0)
        on_gpu = torch.device(device).type == "cuda"
        if on_gpu:
            torch.cuda.reset_peak_memory_stats()
        _, seconds, _ = timed(lambda: [run.step(step) for step in range(1, steps + 1)])  # each waits for its loss
    return seconds / steps, torch.cuda.max_memory_allocated() / 1e9 if on_gpu else 0.0


def measured(
    distilled: DistillConfig, config: WorldModelConfig, source: Sources, views: Sequence[str], *, small: bool, device: str,
    blocks: int, compiled: bool,
) -> tuple[float, float]:  # fmt: skip
    """Seconds a block, and peak memory [GB]; 0 on a processor, where it is not known."""
    spec = distilled.spec
    with torch.device(device):
        model = build_world_model(config).eval().requires_grad_(False)
        tokenizer: VideoTokenizer = tokenizer_outline(source.tokenizer)
        if small:
            tokenizer = SmallDecoder(SmallDecoderConfig.of(tokenizer, ""), tokenizer)
        images = torch.rand(1, len(views), 3, *source.image_size) * 2 - 1
        drawn = source.grid if config.takes_maps else (1, 1)
        maps = torch.rand(1, len(views), config.control_channels, 1 + spec.block_size, *drawn)
    hold_weights(model, "bf16", "bf16")
    if compiled:
        model.compile_blocks()
    sampler = BlockCausalSimulator(model, spec, noise=Noise([0]), views=views, bfloat16=True)
    session = Session(sampler, tokenizer, images, device=device, bfloat16=True)
    window = spec.sink_blocks + spec.recent_blocks
    list(session.steps([maps] * window))
    on_gpu = torch.device(device).type == "cuda"
    if on_gpu:
        torch.cuda.reset_peak_memory_stats()
    _, seconds, _ = timed(lambda: list(session.steps([maps] * blocks)))
    return seconds / blocks, torch.cuda.max_memory_allocated() / 1e9 if on_gpu else 0.0


@dataclass(frozen=True)
class Outline:
    """A preset's stages with steps of one micro-batch, their plan, and the cost of a block in each set of views."""

    preset: str
    card: str
    model: WorldModelConfig
    source: Sources
    distilled: DistillConfig
    stages: tuple[Stage2Config | DistillConfig, ...]
    plans: tuple[Estimate, ...]
    costs: dict[tuple[str, ...], BlockCost]


def outline(preset: str, device: str, card: str | None) -> Outline:
    """Count memory and operations of a preset."""
    config = PipelineConfig.load(preset)
    if config.distill is None or config.train_stage2 is None:
        raise SystemExit(f"{preset} distils nothing")
    chosen = find_card(card or config.card or "H100")
    sheet = SizeSheet.model_validate({"config": config, "project": Path.cwd(), "card": chosen})
    model, source = stage2_model_config(config.train_stage2, sheet.model), sheet.source(config.distill)
    views = tuple(config.distill.views)
    view_sets = list(dict.fromkeys((views[:1], views)))
    stages = (one_micro_batch(config.train_stage2, device), one_micro_batch(config.distill, device))
    with ProcessPoolExecutor(4, get_context("fork")) as pool:
        counted = block_costs(config.distill, model, source, view_sets, pool)
        plans = tuple(pool.map(partial(planned, model=model, source=source), stages))
        costs = dict(zip(view_sets, counted(), strict=True))
    return Outline(preset, chosen, model, source, config.distill, stages, plans, costs)


def training_rows(known: Outline, steps: int, *, compiled: bool) -> Iterator[Sequence[object]]:
    """Steps of both trainings beside their plan."""
    operations = CARDS[known.card].operations
    for title, stage, plan in zip(TRAININGS, known.stages, known.plans, strict=True):
        seconds, peak = trained(stage, known.model, known.source, steps=steps, compiled=compiled)
        floor, size = (plan.operations or 0.0) / operations, plan.parameters / 1e6
        yield (title, size, seconds, floor / UTILISATION, floor, floor / seconds, peak, plan.total / 1e9)


def rollout_rows(known: Outline, blocks: int, device: str, *, compiled: bool) -> Iterator[Sequence[object]]:
    """Blocks in one view and in all, with either decoder, beside their plan."""
    for shown, cost in known.costs.items():
        for small in (False, True):
            seconds, peak = measured(
                known.distilled, known.model, known.source, shown, small=small, device=device, blocks=blocks,
                compiled=compiled,
            )  # fmt: skip
            floor, speed = cost.frames_per_second(CARDS[known.card].operations, small=small), cost.frames / seconds
            decoder = "small" if small else "autoencoder"
            yield (len(shown), decoder, speed, UTILISATION * floor, floor, speed / floor, peak)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--preset", action="append", dest="presets", help="again for several (default: edge-24gb)")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--card", help="whose speed is the floor (default: the preset's)")
    parser.add_argument("--blocks", type=int, default=8)
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument("--compile", action="store_true", help="torch.compile of each layer but its attention")
    arguments = parser.parse_args()
    presets, device, compiled = arguments.presets or ["edge-24gb"], arguments.device, arguments.compile
    with ProcessPoolExecutor(len(presets), get_context("fork")) as pool:  # before CUDA begins
        outlines = list(pool.map(partial(outline, device=device, card=arguments.card), presets))
    require_device(device)
    name = torch.cuda.get_device_name() if device.startswith("cuda") else "a processor"
    for known in outlines:
        print(f"{known.preset} on {name}, floor of {known.card}")
        print_table(
            ("training", "M parameters", "s a micro-step", "planned", "floor", "share of the floor", "peak GB", "planned GB"),
            training_rows(known, arguments.steps, compiled=compiled),
        )  # fmt: skip
        print_table(
            ("views", "decoder", "frames a second", "planned", "floor", "share of the floor", "peak GB"),
            rollout_rows(known, arguments.blocks, device, compiled=compiled),
        )  # fmt: skip


if __name__ == "__main__":
    main()
