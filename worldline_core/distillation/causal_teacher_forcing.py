"""Stage III, step 1: causal teacher forcing (appendix, "Causal Teacher-Forcing Adaptation").

The Stage II objective under block-causal attention: one observed latent frame, then blocks; each noisy block sees the
recorded clean blocks of its window and its own action maps.

Axes: b clips, v views, c latent channels, t latent frames, h and w rows and columns.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from worldline_core.distillation.causal_objective import CausalObjective, block_sigmas, frame_sigmas, maps_of
from worldline_core.model.contracts import CausalSpec
from worldline_core.model.world_model import WorldModel
from worldline_core.training.clip_loader import Batch
from worldline_core.training.flow_matching import add_noise, flow_matching_loss
from worldline_core.training.training_config import LossWeighting, SigmaSampling


class TeacherForcingObjective(CausalObjective[Batch]):
    """Flow matching of every block given the clean blocks of its window."""

    def loss(self, batch: Batch, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        """Teacher-forcing loss of one batch; the history may be a slightly corrupted copy of the recorded latents."""
        settings = self.config.teacher_forcing
        latents, history = batch.latents, None
        if settings.history_noise:
            disturbance = torch.randn(latents.shape, generator=generator, device=latents.device)
            disturbance[..., :1, :, :] = 0
            history = latents + settings.history_noise * disturbance
        loss = teacher_forcing_loss(
            self.model,
            latents,
            maps_of(batch),
            history=history,
            views=batch.views,
            fps=batch.fps,
            spec=self.config.training_spec,
            sampling=settings.sigma,
            weighting=settings.weighting,
            weights=batch.weights,
            generator=generator,
        )
        return loss, {}


def teacher_forcing_loss(
    model: WorldModel,
    latents: Float[Tensor, "b v c t h w"],
    action_maps: Float[Tensor, "b v a t #h #w"] | None,
    *,
    history: Float[Tensor, "b v c t h w"] | None = None,
    views: Sequence[str],
    fps: Float[Tensor, " b"] | None = None,
    spec: CausalSpec,
    sampling: SigmaSampling,
    weighting: LossWeighting,
    weights: Float[Tensor, "b v 1 t h w"] | None = None,
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """Flow-matching loss of every block of `latents`, given the clean blocks that `spec` keeps before it.

    Args:
        history: clean blocks the model sees instead of `latents` themselves.
        weights: further ones of the squared error, as `Batch` carries them.

    Raises:
        DataError: the clip does not divide into blocks.
    """
    sigma = block_sigmas(sampling, len(latents), latents.shape[3], spec.block_size, generator)
    noise = torch.randn(latents.shape, generator=generator, device=generator.device)
    sigma, noise = sigma.to(latents), noise.to(latents)
    levels = frame_sigmas(sigma, spec.block_size)
    velocity = model.forward_teacher_forcing(
        add_noise(latents, noise, levels),
        latents if history is None else history,
        sigma,
        action_maps=action_maps,
        spec=spec,
        views=views,
        fps=fps,
    )
    return flow_matching_loss(velocity, latents, noise, levels, weighting, weights=weights)
