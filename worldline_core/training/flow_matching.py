"""Rectified-flow matching: noise schedule, targets and the loss (method.md section 4).

``z_sigma = (1 - sigma) z + sigma eps``; the target velocity is ``eps - z``. The first latent frame of a clip is the
clean observation: it is given to the model without noise and carries no loss.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from einops import rearrange
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from worldline_core.config.base import StrictModel
from worldline_core.errors import ConfigError


class SigmaSampling(StrictModel):
    """Distribution of the noise level during training.

    ``uniform``: u ~ U(0, 1). ``logit_normal``: u = sigmoid(mean + std n). ``mode``: the "waver" map of Cosmos3 video
    training, u -> 1 - u - scale (cos^2(pi u / 2) - 1 + u). Then ``shift`` moves mass to high noise:
    sigma = shift u / (1 + (shift - 1) u).
    """

    kind: Literal["uniform", "logit_normal", "mode"] = "uniform"
    mean: float = 0.0
    std: float = Field(default=1.0, gt=0)
    mode_scale: float = Field(default=1.29, ge=-1, le=1.75)
    shift: float = Field(default=1.0, gt=0)


class LossWeighting(StrictModel):
    """How the squared velocity error is weighted.

    ``kind``: "velocity" leaves it as it is (the paper's objective); "sample" multiplies it by sigma^2, which is the
    squared error of the predicted clean latents (stable for models that predict the sample).
    ``motion``: extra weight of latent positions that differ from the clip's first frame: the weight is
    ``1 + motion * min(m / mean(m), motion_cap)`` with m the mean absolute change over channels, renormalised to
    mean one, so that a small model spends its capacity on what moves. 0 (the default) is the paper's objective.
    """

    kind: Literal["velocity", "sample"] = "velocity"
    motion: float = Field(default=0.0, ge=0)
    motion_cap: float = Field(default=5.0, gt=0)


def sample_sigmas(config: SigmaSampling, count: int, generator: torch.Generator) -> Float[Tensor, " b"]:
    """Noise levels in (0, 1], drawn on the generator's device."""
    device = generator.device
    if config.kind == "logit_normal":
        u = torch.sigmoid(config.mean + config.std * torch.randn(count, generator=generator, device=device))
    else:
        u = torch.rand(count, generator=generator, device=device)
        if config.kind == "mode":
            u = 1 - u - config.mode_scale * (torch.cos(math.pi * u / 2) ** 2 - 1 + u)
    sigma = config.shift * u / (1 + (config.shift - 1) * u)
    return sigma.clamp(1e-3, 1.0)


def broadcast_sigma(sigma: Tensor) -> Tensor:
    """Bring sigma of shape "b" or "b t" to a shape that broadcasts against "b v c t h w"."""
    if sigma.ndim == 1:
        return rearrange(sigma, "b -> b 1 1 1 1 1")
    if sigma.ndim == 2:
        return rearrange(sigma, "b t -> b 1 1 t 1 1")
    raise ConfigError("Noise levels have an unexpected shape.", expected="'b' or 'b t'", got=tuple(sigma.shape))


def add_noise(
    latents: Float[Tensor, "b v c t h w"],
    noise: Float[Tensor, "b v c t h w"],
    sigma: Tensor,
    clean_frames: Bool[Tensor, "b t"] | None = None,
) -> Float[Tensor, "b v c t h w"]:
    """``(1 - sigma) z + sigma eps``; clean frames (default: the first) stay as they are."""
    level = broadcast_sigma(sigma)
    noisy = (1 - level) * latents + level * noise
    clean = first_frame(latents) if clean_frames is None else clean_frames
    return torch.where(rearrange(clean, "b t -> b 1 1 t 1 1"), latents, noisy)


def velocity_target(
    latents: Float[Tensor, "b v c t h w"], noise: Float[Tensor, "b v c t h w"]
) -> Float[Tensor, "b v c t h w"]:
    """The rectified-flow velocity ``eps - z``."""
    return noise - latents


def first_frame(latents: Float[Tensor, "b v c t h w"]) -> Bool[Tensor, "b t"]:
    """True for latent frame 0 of every clip."""
    mask = torch.zeros(latents.shape[0], latents.shape[3], dtype=torch.bool, device=latents.device)
    mask[:, 0] = True
    return mask


def motion_weights(latents: Float[Tensor, "b v c t h w"], weighting: LossWeighting) -> Float[Tensor, "b v 1 t h w"]:
    """Weights of mean one over the noisy frames; larger where a latent differs from the clip's first frame."""
    change = (latents - latents[:, :, :, :1]).abs().mean(dim=2, keepdim=True)
    mean = change[:, :, :, 1:].mean(dim=(2, 3, 4, 5), keepdim=True).clamp_min(1e-6)
    weights = 1 + weighting.motion * (change / mean).clamp_max(weighting.motion_cap)
    return weights / weights[:, :, :, 1:].mean(dim=(2, 3, 4, 5), keepdim=True)


def flow_matching_loss(
    velocity: Float[Tensor, "b v c t h w"],
    latents: Float[Tensor, "b v c t h w"],
    noise: Float[Tensor, "b v c t h w"],
    sigma: Tensor,
    weighting: LossWeighting,
    clean_frames: Bool[Tensor, "b t"] | None = None,
) -> Float[Tensor, ""]:
    """Mean squared velocity error over the noisy frames, in float32 (clean frames carry no loss)."""
    error = (velocity.float() - velocity_target(latents, noise).float()) ** 2
    if weighting.kind == "sample":
        error = error * broadcast_sigma(sigma).float() ** 2
    if weighting.motion > 0:
        error = error * motion_weights(latents, weighting)
    clean = first_frame(latents) if clean_frames is None else clean_frames
    noisy = rearrange(~clean, "b t -> b 1 1 t 1 1").to(error.dtype)
    per_frame_values = error.numel() / noisy.numel()
    return (error * noisy).sum() / (noisy.sum().clamp_min(1) * per_frame_values)
