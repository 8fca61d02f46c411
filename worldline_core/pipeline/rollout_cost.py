"""What a prediction costs: sampling its latents, block by block or at once, and decoding them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from worldline_core.model.contracts import CausalSpec
from worldline_core.model.layers import TextContext
from worldline_core.model.small_decoder import SmallDecoder
from worldline_core.model.step_cost import StepCost, cost_at_depth, cost_of, in_bfloat16, without_values
from worldline_core.model.tokenizers import WanTokenizer, tokenizer_outline
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import TextConfig, WorldModelConfig
from worldline_core.rollout.rollout_config import RolloutConfig
from worldline_core.rollout.samplers import FULL_STEPS, BlockCausalSimulator, Noise, sigmas_causal
from worldline_core.training.clip_sampler import latent_frame_count
from worldline_core.training.stage_cost import frozen_bytes
from worldline_core.training.stage_memory import ClipShape


def rollout_cost(model: WorldModelConfig, shape: ClipShape, config: RolloutConfig, spec: CausalSpec) -> StepCost:
    """What sampling the latents of a batch costs; what is ``kept`` at its end are the caches of the causal sampler."""
    with_text = config.sampler == "text_to_video"  # which predicts each view by itself
    text = (config.text or TextConfig()).max_length if with_text else 0
    one = replace(shape, views=shape.views[:1]) if with_text else shape

    def trace(layers: int) -> StepCost:
        with without_values():
            network = WorldModel(model.model_copy(update={"num_layers": layers})).requires_grad_(False)
            if config.weights == "bfloat16":
                in_bfloat16(network)
            batch = one.batch(model, maps=not with_text, text=text)
            maps = batch.action_maps
            if config.sampler == "block_causal" and maps is not None:
                running = BlockCausalSimulator(
                    network, spec.model_copy(update={"sigmas": sigmas_causal(spec, config.steps)}),
                    noise=Noise(range(shape.clips)), views=shape.views, bfloat16=config.bfloat16,
                )  # fmt: skip

                def all_blocks() -> None:
                    running.start(batch.latents[:, :, :, 0], maps[:, :, :, :1])
                    for controls in maps[:, :, :, 1:].split(spec.block_size, dim=3):
                        running.step(controls)

                return replace(cost_of(all_blocks), kept=float(running.cache.nbytes))

            read: list[TextContext] = []

            def understand() -> None:
                if batch.text_ids is not None:
                    read.append(network.encode_text(batch.text_ids, batch.text_mask))

            def euler_step() -> None:  # one is like another, and they come one after the other
                context = read[0] if read else None
                network(batch.latents, torch.rand(shape.clips), action_maps=maps, text=context, views=one.views)

            steps = (config.steps or FULL_STEPS) * len(shape.views) // len(one.views)
            with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=config.bfloat16):
                return replace(cost_of(understand).then(cost_of(euler_step).times(steps)), kept=0.0)

    return cost_at_depth(trace, model.num_layers, forward_only=True)


def decoding_cost(tokenizer: Path | None, shape: ClipShape, config: RolloutConfig) -> tuple[int, StepCost]:
    """Bytes of a tokenizer, and what decoding a batch costs: one clip at a time, all of its views at once.

    Of a small decoder whose folder is not here yet, the default size stands for it.
    """
    with without_values():
        codec = tokenizer_outline(tokenizer)
        if config.weights == "bfloat16" and isinstance(codec, WanTokenizer):
            in_bfloat16(codec)
        small = None if config.decoder is None else SmallDecoder.outline(config.decoder, codec)
        latents = torch.empty(len(shape.views), codec.latent_channels, latent_frame_count(shape.frames), *shape.grid)

        def decode() -> None:
            with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=config.bfloat16):
                (small or codec).decode(latents)

        return frozen_bytes(codec) + (0 if small is None else frozen_bytes(small)), cost_of(decode).times(shape.clips)
