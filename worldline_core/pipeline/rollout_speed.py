"""Planned speed of a distilled model's rollouts: operations of one block, from the configuration alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.model.networks import build_world_model
from worldline_core.model.small_decoder import SmallDecoder, SmallDecoderConfig
from worldline_core.model.tokenizers import VideoTokenizer, tokenizer_outline
from worldline_core.model.world_model_config import WorldModelConfig
from worldline_core.pipeline.memory_estimate import Sources
from worldline_core.pipeline.memory_trace import extrapolated, traced
from worldline_core.rollout.samplers import BlockCausalSimulator, Noise


@dataclass(frozen=True)
class BlockCost:
    """One block of a rollout whose window is full.

    Attributes:
        frames: video frames of the block, in each of so many views.
        sampling, decoding, small_decoding: operations of the model, of the tokenizer's own decoder, and of a small one (its default size).
    """

    views: int
    frames: int
    sampling: float
    decoding: float
    small_decoding: float

    def frames_per_second(self, operations_per_second: float, *, small: bool) -> float:
        """Frames a second of all views together, one block after the other."""
        decoding = self.small_decoding if small else self.decoding
        return self.frames * operations_per_second / (self.sampling + decoding)


class _NoNoise(Noise):
    """Noise that has a shape and no values, of one clip."""

    def __init__(self) -> None:
        super().__init__([0])

    def draw(self, shape: Sequence[int], device: torch.device | str = "cpu") -> Tensor:
        return torch.empty(1, *shape, device=device)


def block_costs(
    config: DistillConfig, model: WorldModelConfig, source: Sources, view_sets: Sequence[Sequence[str]], pool: Executor
) -> Callable[[], list[BlockCost]]:
    """Begins to count the operations of a block in each of these sets of views, and returns a function that gives them."""
    decoded = pool.submit(_decoding, config, source)
    sampled = [pool.submit(_sampling, config, model, source, views) for views in view_sets]

    def costs() -> list[BlockCost]:
        own, small = decoded.result()
        frames = TEMPORAL_FACTOR * config.block_size
        return [
            BlockCost(len(views), frames, each.result(), len(views) * own, len(views) * small)
            for views, each in zip(view_sets, sampled, strict=True)
        ]

    return costs


def _sampling(config: DistillConfig, model: WorldModelConfig, source: Sources, views: Sequence[str]) -> float:
    spec = config.spec

    def operations(layers: int) -> dict[str, float]:
        with FakeTensorMode(), torch.no_grad():
            network = build_world_model(model.model_copy(update={"num_layers": layers})).eval()
            simulator = BlockCausalSimulator(network, spec, noise=_NoNoise(), views=views)
            known, block = (source.batch(model, 1, views, 1 + TEMPORAL_FACTOR * n) for n in (0, spec.block_size - 1))

            def fill() -> None:
                simulator.start(known.latents[:, :, :, 0], known.action_maps)
                simulator.step(block.action_maps)
                for _ in range(spec.sink_blocks + spec.recent_blocks - 1):
                    network.write_block(block.latents, simulator.cache, action_maps=block.action_maps, views=views)

            traced(fill)
            return {"block": traced(lambda: simulator.step(block.action_maps)).operations}

    return extrapolated(operations, model.num_layers, (1, 2))["block"]  # exact at any depth, unlike the most bytes


def _decoding(config: DistillConfig, source: Sources) -> tuple[float, float]:
    """Operations of one view of a block, by the tokenizer's own decoder and by a small one."""
    with FakeTensorMode(), torch.no_grad():
        own = tokenizer_outline(source.tokenizer)
        latents = torch.empty(1, own.latent_channels, 1 + config.block_size, *source.grid)

        def operations(tokenizer: VideoTokenizer) -> float:
            decode = tokenizer.decoder(torch.empty(1, 3, *source.image_size))
            decode(latents[:, :, :1])
            return traced(lambda: decode(latents[:, :, 1:])).operations

        return operations(own), operations(SmallDecoder(SmallDecoderConfig.of(own, ""), own))
