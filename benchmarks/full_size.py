"""Operations, bytes and the least time of every stage and rollout at full size, and, where a GPU is, the time they take.

    python benchmarks/full_size.py                                   # the floors: nothing is loaded, any machine will do
    python benchmarks/full_size.py --set rollouts.causal.config.sampler.decoder=FOLDER  # with a small decoder (of the default size, if not there)
    python benchmarks/full_size.py --card H200 --time cuda           # rollouts with random weights, timed on this card
    python benchmarks/full_size.py --memory                          # planned against measured memory at three small sizes

The floor counts every matrix product, convolution and attention at the card's peak. Targets on one H200: causal 7 s, Stage II 50 s for 129 frames of three views (the paper: 21 s and 90 s).
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal
from unittest.mock import patch

import torch
from torch.profiler import ProfilerActivity, profile

from worldline_core.config import load_config
from worldline_core.model.tokenizers import VideoTokenizer, WanTokenizer, tokenizer_outline
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import CausalSpec, WorldModelConfig
from worldline_core.pipeline.memory_estimate import ClipShape, Training, to_bfloat16
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.pipeline.size_sheet import PEAK_FLOPS, Machine, SizeSheet
from worldline_core.rollout.samplers import FULL_STEPS, BlockCausalSimulator, Noise, rollout_full_clip
from worldline_core.rollout.speed import device_name, timed
from worldline_core.training.clip_config import ClipSampling
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.trainer import ParameterGroup, train
from worldline_core.training.training_config import LossWeighting, ShardingConfig, SigmaSampling, TrainerConfig
from worldline_core.training.training_state import TrainingStates

TARGETS = {"causal": 7.0, "stage2": 50.0}
"""Seconds of a prediction of 129 frames and three views on one H200, decoding included."""


def floors(preset: str, card: str, overrides: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Operations and least seconds of every stage of a preset."""
    config = load_config(PipelineConfig, preset=preset, overrides=overrides)
    machine = Machine.model_validate({"devices": 1, "memory": "80GB", "card": card, "utilisation": 1})
    return [
        {"stage": row.title, "pflop": row.flops / 1e15, "floor_seconds": machine.seconds(row.flops)}
        for row, _ in SizeSheet(config, Path.cwd(), machine).rows()
        if row.flops
    ]


@dataclass(frozen=True)
class Rollouts:
    """Both samplers on one device, with random weights: speed does not depend on them.

    Attributes:
        frames: of a prediction; grid: rows and columns of the latents.
    """

    model: WorldModel
    tokenizer: VideoTokenizer
    spec: CausalSpec
    frames: int
    grid: tuple[int, int]
    device: str

    @classmethod
    def of(cls, preset: str, device: str) -> Rollouts:
        """Clips as long as the preset's longest; weights made in bfloat16 on the device, never in float32."""
        config = load_config(PipelineConfig, preset=preset)
        sheet = SizeSheet(config, Path.cwd(), Machine.model_validate({"memory": "80GB"}))
        tokenizer = tokenizer_outline(sheet.folder("tokenizer")).to(device)
        if isinstance(tokenizer, WanTokenizer):
            to_bfloat16(tokenizer)
        grid, frames = sheet.source().grid, max(config.distill.clips.lengths)
        return cls(random_model(sheet.generation, device), tokenizer, config.distill.spec, frames, grid, device)

    @torch.no_grad()
    def seconds(self, sampler: str) -> float:
        """Wall seconds of one prediction of all views: sampling and decoding."""
        config, device = self.model.config, self.device
        count, views = 1 + (self.frames - 1) // 4, config.views
        first = torch.randn(1, len(views), config.latent_channels, *self.grid, device=device)
        maps = torch.randn(1, len(views), config.map_channels, count, *self.grid, device=device)

        def predict() -> None:
            if sampler == "stage2":
                clip = rollout_full_clip(
                    self.model, first, maps, noise=Noise([42]), steps=FULL_STEPS, views=views, bfloat16=True,
                )  # fmt: skip
                self.tokenizer.decode(clip[0])
                return
            simulator = BlockCausalSimulator(self.model, self.spec, noise=Noise([42]), views=views, bfloat16=True)
            simulator.start(first, maps[:, :, :, :1])
            decode = self.tokenizer.decoder()
            decode(first[0][:, :, None])
            for controls in maps[:, :, :, 1:].split(self.spec.block_size, dim=3):
                decode(simulator.step(controls)[0])

        return timed(predict, device)[1].wall


def random_model(config: WorldModelConfig, device: str) -> WorldModel:
    """Random weights in bfloat16, each made on the device."""
    with torch.device("meta"):
        model = WorldModel(config).bfloat16()
    model.time_embedder.float()
    model = model.to_empty(device=device)
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, 0.0, 0.02)
    return model.eval().requires_grad_(False)


SIZES = (
    (
        WorldModelConfig(towers="generation", hidden_size=64, num_heads=1, num_layers=4, intermediate_size=192),
        17,
        (8, 12),
    ),
    (WorldModelConfig(towers="generation"), 33, (8, 12)),
    (
        WorldModelConfig(towers="generation", hidden_size=384, num_heads=6, num_layers=6, intermediate_size=1152),
        33,
        (8, 12),
    ),
)


CASES: tuple[tuple[int, Literal["none", "block"]], ...] = ((1, "none"), (2, "block"))


def memory(config: WorldModelConfig, frames: int, grid: tuple[int, int], trainer: TrainerConfig) -> tuple[float, float]:
    """Bytes of two real training steps: planned, and handed out by the allocator at the worst moment.

    Neither counts the copy of a state that is being written: how long it is there depends on the disk.
    """
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="cosmos3-nano")
    parser.add_argument("--card", choices=tuple(PEAK_FLOPS), default="H200")
    parser.add_argument("--set", action="append", default=[], metavar="a.b=value", help="of the floors' preset")
    parser.add_argument("--time", metavar="DEVICE", help="time the rollouts there (cuda)")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--memory", action="store_true")
    options = parser.parse_args()
    if options.memory:
        for config, frames, grid in SIZES:
            for accumulation, checkpointing in CASES:
                sharding = ShardingConfig(checkpointing=checkpointing)
                trainer = TrainerConfig(steps=2, batch_size=1, accumulation=accumulation, sharding=sharding)
                planned, measured = memory(config, frames, grid, trainer)
                print(f"{config.num_layers} layers of {config.hidden_size}, {frames} frames, accumulation {accumulation}, checkpointing {checkpointing}: planned "
                      f"{planned / 1e6:.1f} MB, measured {measured / 1e6:.1f} MB, ratio {planned / measured:.4f}")  # fmt: skip
    elif options.time:
        rollouts = Rollouts.of(options.preset, options.time)
        for sampler, target in TARGETS.items():
            seconds = [rollouts.seconds(sampler) for _ in range(1 + options.repeats)][1:]
            figures = {"device": device_name(options.time), "seconds": seconds}
            print(json.dumps({"sampler": sampler, "frames": rollouts.frames, "target": target, **figures}))
    else:
        for row in floors(options.preset, options.card, options.set):
            print(json.dumps({"card": options.card, **row}))


if __name__ == "__main__":
    main()
