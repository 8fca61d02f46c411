"""Stage III, step 1: causal teacher forcing (appendix, "Causal Teacher-Forcing Adaptation").

The Stage II objective under block-causal attention: one observed latent frame, then blocks; each noisy block sees the
clean blocks of its window and its own action maps. The paper's blocks are the recorded ones; a model of one step a block
learns better from its own (docs/experiments.md, "One step per block").

Axes: b clips, v views, c latent channels, t latent frames, h and w rows and columns.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from worldline_core.actions.action_maps import latent_frame_indices
from worldline_core.distillation.causal_objective import (
    CausalObjective,
    block_sigmas,
    frame_sigmas,
    maps_of,
    with_observed_frame,
)
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import CausalSpec
from worldline_core.rollout.samplers import euler_step
from worldline_core.training.clip_loader import Batch
from worldline_core.training.flow_matching import add_noise, flow_matching_loss
from worldline_core.training.training_config import LossWeighting, SigmaSampling


class TeacherForcingObjective(CausalObjective[Batch]):
    """Flow matching of every block given the blocks of its window: the recorded ones, or what the model makes of them.

    Args:
        teacher: Stage II model whose prediction of the whole clip is a part of the target (``teacher_share``).
    """

    def __init__(self, model: WorldModel, config: DistillConfig, teacher: WorldModel | None = None) -> None:
        super().__init__(model, config)
        self.settings = config.teacher_forcing
        self.teacher = None if teacher is None else teacher.eval().requires_grad_(False)

    def loss(self, batch: Batch, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        """Teacher-forcing loss of one batch."""
        settings, latents, history = self.settings, batch.latents, None
        if settings.history_noise or settings.history == "generated" or self.teacher is not None:
            noise = torch.randn(latents.shape, generator=generator, device=latents.device)
            latents = self.target(batch, noise)
            history = self.history(batch, noise, generator)
        loss = teacher_forcing_loss(
            self.model,
            latents,
            maps_of(batch),
            history=history,
            views=batch.views,
            fps=batch.fps,
            spec=self.spec,
            sampling=settings.sigma,
            weighting=settings.weighting,
            weights=batch.weights,
            generator=generator,
        )
        return loss, {}

    def target(self, batch: Batch, noise: Float[Tensor, "b v c t h w"]) -> Float[Tensor, "b v c t h w"]:
        """Target of the blocks: the recording, in part what the teacher predicts in one step from this noise."""
        latents, settings = batch.latents, self.settings
        longest = settings.teacher_frames
        if self.teacher is None or (longest is not None and latents.shape[3] > len(latent_frame_indices(longest))):
            return latents
        first = latents[..., :1, :, :]
        state = with_observed_frame(first, noise[..., 1:, :, :])
        with torch.no_grad():
            velocity = self.teacher(
                state, latents.new_ones(len(latents)), action_maps=maps_of(batch), views=batch.views, fps=batch.fps
            ).velocity
        mixed = torch.lerp(latents, euler_step(state, velocity, 1.0, 0.0), settings.teacher_share)
        return with_observed_frame(first, mixed[..., 1:, :, :])

    def history(
        self, batch: Batch, noise: Float[Tensor, "b v c t h w"], generator: torch.Generator
    ) -> Float[Tensor, "b v c t h w"]:
        """The clean blocks that a block sees: recorded and slightly disturbed, or the model's own rollout from this noise."""
        latents = batch.latents
        if self.settings.history == "recorded":
            level = torch.rand((len(noise), 1, 1, 1, 1, 1), generator=generator, device=noise.device)
            later = self.settings.history_noise * level * noise[..., 1:, :, :]
            return latents + with_observed_frame(torch.zeros_like(noise[..., :1, :, :]), later)
        size = self.spec.block_size  # no block follows the last one
        maps = maps_of(batch)[..., :-size, :, :]
        generated = self.rollout(batch, maps, noise[..., :-size, :, :], self.spec.steps - 1, with_gradient=False)
        return torch.cat((generated.to(latents), latents[..., -size:, :, :]), dim=3)


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
