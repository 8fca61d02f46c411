"""Stage III, step 1: causal teacher forcing (appendix, "Causal Teacher-Forcing Adaptation").

The Stage II objective under block-causal attention: one observed latent frame, then blocks; each noisy block sees the
clean blocks of its window and its own action maps. The paper's blocks are the recorded ones; a model of one step a block
learns better from its own (docs/experiments.md, "One step per block").

Axes: b clips, v views, c latent channels, t latent frames, h and w rows and columns.
"""

from __future__ import annotations

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
from worldline_core.rollout.samplers import euler_step
from worldline_core.training.clip_loader import Batch
from worldline_core.training.flow_matching import add_noise, flow_matching_loss


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
        """Flow-matching loss of every block, given the clean blocks that the window keeps before it.

        Raises: DataError: the clip does not divide into blocks.
        """
        settings, size, latents = self.settings, self.spec.block_size, batch.latents
        history = latents
        if settings.history_noise or settings.history == "generated" or self.teacher is not None:
            noise = torch.randn(latents.shape, generator=generator, device=latents.device)
            latents, history = self.target(batch, noise), self.history(batch, noise, generator)
        sigma = block_sigmas(settings.sigma, len(latents), latents.shape[3], size, generator).to(latents)
        noise = torch.randn(latents.shape, generator=generator, device=generator.device).to(latents)
        levels = frame_sigmas(sigma, size)
        noisy = add_noise(latents, noise, levels)
        velocity = self.model.forward_teacher_forcing(
            noisy, history, sigma, action_maps=maps_of(batch), spec=self.spec, views=batch.views, fps=batch.fps
        )
        return flow_matching_loss(velocity, latents, noise, levels, settings.weighting, weights=batch.weights), {}

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
