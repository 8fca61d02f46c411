"""The Stage II sampler: all frames of a clip at once."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from einops import repeat
from jaxtyping import Float
from torch import Tensor

from worldline_core.model.config import VIEWS
from worldline_core.model.world_model import TextContext, WorldModel
from worldline_core.rollout.euler import Noise, check_nodes, euler_step, sigmas_full


@torch.no_grad()
def rollout_full_clip(
    model: WorldModel,
    first_latents: Float[Tensor, "b v c h w"],
    action_maps: Float[Tensor, "b v a t h w"] | None,
    *,
    noise: Noise,
    steps: int = 35,
    sigmas: Sequence[float] | None = None,
    frames: int | None = None,
    views: Sequence[str] = VIEWS,
    text: TextContext | None = None,
    bfloat16: bool = False,
) -> Float[Tensor, "b v c t h w"]:
    """Integrate from noise to a clip whose first latent frame is ``first_latents``; no classifier-free guidance.

    Args:
        action_maps: controls of every latent frame; None for a model without actions (then give ``frames``).
        noise: one source a clip.
        sigmas: nodes, instead of ``steps`` even ones.

    Raises:
        ConfigError: the noise levels do not fall to 0.
        DataError: a shape does not fit the model.
    """
    nodes = tuple(sigmas) if sigmas is not None else sigmas_full(steps)
    check_nodes(nodes)
    if frames is None:
        frames = 1 if action_maps is None else action_maps.shape[3]
    batch, views_count, channels, height, width = first_latents.shape
    first = repeat(first_latents.float(), "b v c h w -> b v c 1 h w")
    latents = noise.draw((views_count, channels, frames, height, width), first.device)
    latents = torch.cat((first, latents[:, :, :, 1:]), dim=3)
    for sigma, next_sigma in itertools.pairwise(nodes):
        levels = torch.full((batch,), sigma, device=first.device)
        with torch.autocast(first.device.type, torch.bfloat16, enabled=bfloat16):
            velocity = model(latents, levels, action_maps=action_maps, text=text, views=views).velocity
        # The first frame's velocity is zero, so it stays what was observed.
        latents = euler_step(latents, velocity, sigma, next_sigma)
    return latents
