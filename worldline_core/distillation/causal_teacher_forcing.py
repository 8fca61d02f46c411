"""Stage III, step 1: causal teacher forcing (appendix, "Causal Teacher-Forcing Adaptation").

The Stage II objective under block-causal attention: one observed latent frame, then blocks of `block_size` latent
frames; each noisy block sees the recorded clean blocks before it and its own action maps.

Axes: b clips, v views, c latent channels, t latent frames, h and w rows and columns.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from einops import repeat
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from worldline_core.config import StrictModel
from worldline_core.model.block_causal_attention import block_bounds
from worldline_core.model.world_model import WorldModel
from worldline_core.training.flow_matching import (
    LossWeighting,
    SigmaSampling,
    add_noise,
    flow_matching_loss,
    sample_sigmas,
)


def frame_sigmas(sigma: Float[Tensor, "b blocks"], block_size: int) -> Float[Tensor, "b t"]:
    """Noise level of every latent frame: 0 for the observed one, its block's level for every other."""
    later = repeat(sigma, "b blocks -> b (blocks size)", size=block_size)
    return torch.cat((later.new_zeros(len(later), 1), later), dim=1)


def block_sigmas(
    sampling: SigmaSampling, clips: int, latent_frames: int, block_size: int, generator: torch.Generator
) -> Float[Tensor, "b blocks"]:
    """An independent noise level for every block of every clip: each block is its own denoising problem."""
    blocks = len(block_bounds(latent_frames, block_size)) - 1
    return sample_sigmas(sampling, clips * blocks, generator).reshape(clips, blocks)


def teacher_forcing_loss(
    model: WorldModel,
    latents: Float[Tensor, "b v c t h w"],
    action_maps: Float[Tensor, "b v a t h w"] | None,
    *,
    history: Float[Tensor, "b v c t h w"] | None = None,
    views: Sequence[str],
    block_size: int,
    sampling: SigmaSampling,
    weighting: LossWeighting,
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """Flow-matching loss of every block of `latents`, given the clean blocks before it.

    Args:
        history: clean blocks the model sees instead of `latents` themselves (a slightly corrupted copy, for example).

    Raises:
        DataError: the clip does not divide into blocks.
    """
    sigma = block_sigmas(sampling, len(latents), latents.shape[3], block_size, generator)
    noise = torch.randn(latents.shape, generator=generator, device=generator.device)
    sigma, noise = sigma.to(latents), noise.to(latents)
    levels = frame_sigmas(sigma, block_size)
    noisy = add_noise(latents, noise, levels)
    velocity = model.forward_teacher_forcing(
        noisy,
        latents if history is None else history,
        sigma,
        action_maps=action_maps,
        block_size=block_size,
        views=views,
    )
    return flow_matching_loss(velocity, latents, noise, levels, weighting)


class CacheWindow(StrictModel):
    """Blocks that stay visible: the first ones and the most recent ones (one and three in the paper)."""

    sink_blocks: int = Field(default=1, ge=1)
    recent_blocks: int = Field(default=3, ge=0)
