"""Rectified-flow matching: noise schedule, targets and the loss (docs/method.md section 4).

``z_sigma = (1 - sigma) z + sigma eps``; the target velocity is ``eps - z``. The first latent frame of a clip is the
clean observation: it is given to the model without noise and carries no loss.

The flow-matching objective of Stage I and Stage II, with the relational terms where they are asked for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import torch
from einops import rearrange
from jaxtyping import Bool, Float
from torch import Tensor

from worldline_core.model.world_model import TextContext, WorldModel
from worldline_core.rollout.samplers import integrate, shifted_sigmas
from worldline_core.training.clip_loader import Batch
from worldline_core.training.processes import average_values
from worldline_core.training.relational import RelationalTerm
from worldline_core.training.trainer import Objective
from worldline_core.training.training_config import LossWeighting, SigmaSampling


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
    return rearrange(sigma, "b -> b 1 1 1 1 1" if sigma.ndim == 1 else "b t -> b 1 1 t 1 1")


def add_noise(
    latents: Float[Tensor, "b v c t h w"],
    noise: Float[Tensor, "b v c t h w"],
    sigma: Tensor,
) -> Float[Tensor, "b v c t h w"]:
    """``(1 - sigma) z + sigma eps``; the first frame stays as it is."""
    level = broadcast_sigma(sigma)
    noisy = (1 - level) * latents + level * noise
    return torch.where(rearrange(first_frame(latents), "b t -> b 1 1 t 1 1"), latents, noisy)


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
    weights: Float[Tensor, "b v 1 t h w"] | None = None,
) -> Float[Tensor, ""]:
    """Mean squared velocity error over the noisy frames, in float32 (the first, clean one carries no loss).

    ``weights``: multiply the squared error, as in `Batch`.
    """
    error = (velocity.float() - velocity_target(latents, noise).float()) ** 2
    if weighting.kind == "sample":
        error = error * broadcast_sigma(sigma).float() ** 2
    if weighting.motion > 0:
        error = error * motion_weights(latents, weighting)
    if weights is not None:
        error = error * weights
    noisy = rearrange(~first_frame(latents), "b t -> b 1 1 t 1 1").to(error.dtype)
    per_frame_values = error.numel() / noisy.numel()
    return (error * noisy).sum() / (noisy.sum().clamp_min(1) * per_frame_values)


@dataclass(eq=False)
class FlowMatchingObjective(Objective[Batch]):
    """Flow matching on clips. The batch decides what conditions the model: text, action maps, or neither."""

    model: WorldModel
    _: KW_ONLY
    sigma: SigmaSampling
    weighting: LossWeighting
    text_dropout: float = 0.0
    action_dropout: float = 0.0
    relational: RelationalTerm | None = None
    sampler_steps: int = 4

    def __post_init__(self) -> None:
        self.encode_text: Callable[[Tensor, Tensor | None], TextContext] = self.model.encode_text

    def loss(self, batch: Batch, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        latents = batch.latents
        sigma = sample_sigmas(self.sigma, latents.shape[0], generator)
        noise = torch.randn(latents.shape, generator=generator, device=latents.device)
        draws = torch.rand(latents.shape[0], generator=generator, device=latents.device)
        maps = batch.action_maps
        if maps is not None and self.action_dropout > 0:
            maps = maps * rearrange(draws >= self.action_dropout, "b -> b 1 1 1 1 1")
        with_text = batch.text_ids is not None and draws[0].item() >= self.text_dropout
        targets = None
        if self.relational is not None:
            patch = self.model.config.patch_size
            grid = (latents.shape[3], latents.shape[-2] // patch, latents.shape[-1] // patch)
            targets = self.relational.targets(batch, grid)
        # Where another process reads its text, this one takes part in gathering that tower's weights.
        any_reads = batch.text_ids is not None and average_values({"text": with_text})["text"] > 0
        text = self._text(batch) if any_reads else None
        output = self.model(
            add_noise(latents, noise, sigma),
            sigma,
            action_maps=maps,
            text=text if text is None or with_text else replace(text, ignored=True),
            views=batch.views,
            fps=batch.fps,
            features_at=None if self.relational is None else self.relational.layer,
        )
        flow = flow_matching_loss(output.velocity, latents, noise, sigma, self.weighting, weights=batch.weights)
        if self.relational is None or targets is None or output.features is None:
            return flow, {}
        total, values = self.relational.add(flow, output.features, targets, step)
        return total, {"flow_matching": flow.item(), **values}

    def _text(self, batch: Batch) -> TextContext | None:
        return None if batch.text_ids is None else self.encode_text(batch.text_ids, batch.text_mask)

    def end_step(self, values: Mapping[str, float]) -> None:
        if self.relational is not None:
            means = (values[name] for name in ("flow_matching", "relational_intra", "relational_cross"))
            self.relational.scales.update(*means)

    def state(self) -> dict[str, Any]:
        return {} if self.relational is None else dict(self.relational.scales.ratios)

    def load_state(self, state: dict[str, Any]) -> None:
        if self.relational is not None:
            self.relational.scales.ratios = dict(state)

    def predict(self, batch: Batch, action_maps: Tensor, noise: Tensor) -> Tensor:
        """Whole clips from their first latent frames, in ``sampler_steps`` Euler steps."""
        first = rearrange(first_frame(batch.latents), "b t -> b 1 1 t 1 1")
        text = self._text(batch)

        def velocity(state: Tensor, sigma: float) -> Tensor:
            levels = torch.full((len(state),), sigma, device=state.device)
            return self.model(
                state, levels, action_maps=action_maps, text=text, views=batch.views, fps=batch.fps
            ).velocity

        return integrate(velocity, torch.where(first, batch.latents, noise), shifted_sigmas(self.sampler_steps))

    def validation_losses(self, batch: Batch, generator: torch.Generator) -> dict[str, float]:
        """Unweighted velocity loss, and the squared error of the clean latents, on a held-out batch.

        With action maps, also for the maps of another clip of the batch (shuffled) and for no maps: a model that
        follows its controls is worse with both.
        """
        latents = batch.latents
        sigma = sample_sigmas(self.sigma, latents.shape[0], generator)
        noise = torch.randn(latents.shape, generator=generator, device=latents.device)
        noisy = add_noise(latents, noise, sigma)
        conditions: dict[str, Tensor | None] = {"": batch.action_maps}
        if batch.action_maps is not None:
            conditions["_shuffled_actions"] = batch.action_maps.roll(1, dims=0)
            conditions["_no_actions"] = torch.zeros_like(batch.action_maps)
        losses: dict[str, float] = {}
        for suffix, maps in conditions.items():
            velocity = self.model(
                noisy, sigma, action_maps=maps, text=self._text(batch), views=batch.views, fps=batch.fps
            ).velocity
            for name, kind in (("loss", "velocity"), ("sample_error", "sample")):
                weighting = LossWeighting.model_validate({"kind": kind})
                losses[name + suffix] = flow_matching_loss(velocity, latents, noise, sigma, weighting).item()
        losses["sample_error_copy"] = float(((latents - latents[:, :, :, :1]) ** 2)[:, :, :, 1:].mean())
        return losses
