"""What the shared training loop minimises in each step of Stage III."""

from __future__ import annotations

from typing import Any

import torch
from einops import repeat
from torch import Tensor

from worldline_core.distillation.auxiliary_losses import PerceptualDistance, auxiliary_losses, enabled_terms
from worldline_core.distillation.batches import maps_of, parts_of
from worldline_core.distillation.causal_teacher_forcing import block_sigmas, teacher_forcing_loss
from worldline_core.distillation.distill_config import CYCLE, DistillConfig
from worldline_core.distillation.distribution_matching import (
    Score,
    causal_score,
    distribution_gradient,
    distribution_matching_loss,
    fake_score_loss,
    full_clip_score,
    is_student_iteration,
    self_forced_rollout,
)
from worldline_core.distillation.teacher_trajectories import NODES, with_observed_frame
from worldline_core.distillation.trajectory_regression import draw_nodes, trajectory_regression_loss
from worldline_core.model.world_model import WorldModel
from worldline_core.training.clip_loader import Batch
from worldline_core.training.trainer import step_generator


class _CausalObjective:
    """A block-causal model under training, and the error of its four-step rollouts on held-out clips."""

    def __init__(self, model: WorldModel, config: DistillConfig) -> None:
        self.model = model
        self.config = config

    def state(self) -> dict[str, Any]:
        """Nothing but the weights changes from step to step."""
        return {}

    def load_state(self, state: dict[str, Any]) -> None:
        """Nothing to continue from."""

    def validation_losses(self, batch: Batch, generator: torch.Generator) -> dict[str, float]:
        """Squared latent error of complete four-step rollouts: with the true controls, with another clip's, and copying.

        A model that follows its controls is worse with another clip's. All three steps report the same numbers.
        """
        maps = maps_of(batch)
        noise = torch.randn(batch.latents.shape, generator=generator, device=batch.latents.device)
        errors = {}
        for name, controls in (("rollout_error", maps), ("rollout_error_shuffled_actions", maps.roll(1, dims=0))):
            generated = self.rollout(batch, controls, noise, len(NODES) - 2, with_gradient=False)
            errors[name] = generated
        errors["rollout_error_copy"] = batch.latents[..., :1, :, :].expand_as(batch.latents)
        return {name: float(((value - batch.latents)[..., 1:, :, :] ** 2).mean()) for name, value in errors.items()}

    def rollout(self, batch: Batch, maps: Tensor, noise: Tensor, exit_step: int, *, with_gradient: bool) -> Tensor:
        """The model's own rollout from the observed frame of each clip."""
        return self_forced_rollout(
            self.model,
            batch.latents[..., :1, :, :],
            maps,
            noise,
            exit_step,
            views=batch.views,
            block_size=self.config.block_size,
            window=self.config.window,
            with_gradient=with_gradient,
        )


class TeacherForcingObjective(_CausalObjective):
    """Step 1: flow matching under block-causal attention."""

    def loss(self, batch: Batch, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        """Teacher-forcing loss of one batch."""
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
            block_size=self.config.block_size,
            sampling=settings.sigma,
            weighting=settings.weighting,
            generator=generator,
        )
        return loss, {}


class TrajectoryObjective(_CausalObjective):
    """Step 2: regression of the teacher's trajectories."""

    def __init__(self, model: WorldModel, config: DistillConfig, perceptual: PerceptualDistance | None) -> None:
        super().__init__(model, config)
        self.perceptual = perceptual

    def loss(self, batch: Batch, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        """Trajectory loss of one batch, and its parts."""
        settings = self.config.trajectory_regression
        trajectories, maps = parts_of(batch)
        blocks = (batch.latents.shape[3] - 1) // self.config.block_size
        loss = trajectory_regression_loss(
            self.model,
            trajectories.nodes,
            trajectories.clean,
            maps,
            draw_nodes(len(batch.latents), blocks, generator),
            mask=trajectories.mask,
            views=batch.views,
            block_size=self.config.block_size,
            next_weight=settings.next_weight,
            terminal_weight=settings.terminal_weight,
            auxiliary=settings.auxiliary,
            perceptual=self.perceptual,
        )
        return loss.total, {name: value.item() for name, value in loss.terms.items()}


class DistributionMatchingObjective(_CausalObjective):
    """Step 3: five updates of the fake score, then one of the student, in one training loop.

    An iteration gives gradients to one of the two models only; the optimiser leaves the other as it is. Every iteration
    reports all metrics, zero for those of the other model and scaled by the share of the iterations that measure them,
    so that a mean over whole cycles is the mean over these.
    """

    def __init__(
        self,
        student: WorldModel,
        real: WorldModel,
        fake: WorldModel,
        config: DistillConfig,
        perceptual: PerceptualDistance | None,
    ) -> None:
        super().__init__(student, config)
        self.settings = config.distribution_matching
        self.real = real.eval().requires_grad_(False)
        self.fake = fake
        self.perceptual = perceptual

    def loss(self, batch: Batch, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        """The student's loss in one iteration of six, the fake score's in the others."""
        trajectories, maps = parts_of(batch)
        student_turn = is_student_iteration(step)
        enabled = enabled_terms(self.settings.auxiliary, perceptual=self.perceptual is not None)
        names = ("distribution_matching", *enabled)
        noise = torch.randn(batch.latents.shape, generator=generator, device=batch.latents.device)
        if self.settings.target == "teacher":
            # The teacher's trajectory started from this noise: its clean end is what this rollout should become.
            noise = with_observed_frame(noise[..., :1, :, :], trajectories.nodes[:, 0])
        generated = self.rollout(batch, maps, noise, self.exit_step(step), with_gradient=student_turn)
        sigma = self.sigmas(batch, generator)
        fresh = torch.randn(batch.latents.shape, generator=generator, device=batch.latents.device)
        fake = self.score(self.fake, batch, maps)
        if not student_turn:
            loss = fake_score_loss(
                fake,
                generated,
                fresh,
                sigma,
                block_size=self.config.block_size,
                weighting=self.settings.weighting,
            )
            return loss, {**dict.fromkeys(names, 0.0), "fake_score": loss.item() * CYCLE / (CYCLE - 1)}
        gradient = distribution_gradient(
            self.score(self.real, batch, maps), fake, generated, fresh, sigma, self.config.block_size
        )
        matching = distribution_matching_loss(generated, gradient)
        target = batch.latents
        if self.settings.target == "teacher":
            target = with_observed_frame(target[..., :1, :, :], trajectories.nodes[:, -1])
        extra = auxiliary_losses(
            generated,
            target,
            mask=trajectories.mask,
            views=batch.views,
            block_size=self.config.block_size,
            weights=self.settings.auxiliary,
            perceptual=self.perceptual,
        )
        terms = {"distribution_matching": matching.detach(), **extra.terms}
        values = {name: terms[name].item() * CYCLE for name in names}
        return matching + extra.total, {**values, "fake_score": 0.0}

    def exit_step(self, step: int) -> int:
        """Exit step of this iteration: random, and the same on every process (it does not depend on the rank)."""
        stream = step_generator(self.settings.trainer.seed + 1, step, "cpu")
        return int(torch.randint(len(NODES) - 1, (1,), generator=stream))

    def sigmas(self, batch: Batch, generator: torch.Generator) -> Tensor:
        """Noise level of every block: one a clip for Stage II scores, which know no other, else independent."""
        clips, frames = len(batch.latents), batch.latents.shape[3]
        drawn = block_sigmas(self.settings.sigma, clips, frames, self.config.block_size, generator)
        if self.settings.real_score == "stage2":
            drawn = repeat(drawn[:, 0], "b -> b blocks", blocks=drawn.shape[1])
        return drawn.clamp(*self.settings.sigma_range)

    def score(self, model: WorldModel, batch: Batch, maps: Tensor) -> Score:
        """The velocity field of a score model, in the form it was trained in."""
        form = full_clip_score if self.settings.real_score == "stage2" else causal_score
        return form(model, maps, views=batch.views, block_size=self.config.block_size)
