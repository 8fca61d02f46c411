"""The Stage II sampler: all frames of a clip at once.

Noise levels and Euler steps of the rectified flow (method.md section 5).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from einops import repeat
from jaxtyping import Float
from torch import Tensor

from worldline_core.errors import ConfigError
from worldline_core.model.world_model import TextContext, WorldModel
from worldline_core.model.world_model_config import VIEWS

FULL_STEPS = 35
CAUSAL_SHIFT = 5.0
CAUSAL_SIGMAS = (1.0, 15 / 16, 5 / 6, 5 / 8, 0.0)
"""Nodes of the four-step causal sampler: shift 5 on 1, 3/4, 1/2, 1/4."""


def shifted_sigmas(steps: int, shift: float = 1.0) -> tuple[float, ...]:
    """``steps + 1`` nodes from 1 to 0; ``s' = shift s / (1 + (shift - 1) s)`` of an even grid.

    Raises:
        ConfigError: fewer than one step, or a shift that is not positive.
    """
    if steps < 1 or shift <= 0:
        raise ConfigError("A sampler needs at least one step and a positive shift", got=f"steps {steps}, shift {shift}")
    grid = [1.0 - step / steps for step in range(steps)]
    return (*(shift * s / (1.0 + (shift - 1.0) * s) for s in grid), 0.0)


def sigmas_full(steps: int = FULL_STEPS) -> tuple[float, ...]:
    """Even nodes of the whole-clip sampler."""
    return shifted_sigmas(steps)


def sigmas_causal(steps: int = 4) -> tuple[float, ...]:
    """Nodes of the block-causal sampler; four steps are :data:`CAUSAL_SIGMAS`."""
    return CAUSAL_SIGMAS if steps == 4 else shifted_sigmas(steps, CAUSAL_SHIFT)


def euler_step(
    latents: Float[Tensor, "*shape"], velocity: Float[Tensor, "*shape"], sigma: float, next_sigma: float
) -> Float[Tensor, "*shape"]:
    """``z' = z + (sigma' - sigma) v``, in float32."""
    return latents + (next_sigma - sigma) * velocity.float()


def check_nodes(sigmas: Sequence[float]) -> None:
    """Refuse nodes that do not fall from at most 1 to 0.

    Raises:
        ConfigError: they do not.
    """
    falling = all(later < earlier for earlier, later in itertools.pairwise(sigmas))
    if len(sigmas) < 2 or sigmas[0] > 1 or sigmas[-1] != 0 or not falling:
        raise ConfigError("Noise levels must fall from at most 1 to 0", got=list(sigmas))


class Noise:
    """Gaussian noise that depends on each clip's seed alone, not on who shares its batch.

    Drawn on the CPU in float32, so that CPU and GPU start from the same noise.
    """

    def __init__(self, seeds: Sequence[int]) -> None:
        self._generators = [torch.Generator().manual_seed(seed) for seed in seeds]

    def draw(self, shape: Sequence[int], device: torch.device | str = "cpu") -> Tensor:
        """``(batch, *shape)``, one slice a seed."""
        return torch.stack([torch.randn(tuple(shape), generator=g) for g in self._generators]).to(device)

    def copy(self) -> Noise:
        """A source that will draw the same noise as this one from here on."""
        other = Noise([])
        for generator in self._generators:
            twin = torch.Generator()
            twin.set_state(generator.get_state())
            other._generators.append(twin)
        return other


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
