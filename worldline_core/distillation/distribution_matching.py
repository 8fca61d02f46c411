"""Stage III, step 3: score-based distribution matching on the student's own rollouts (appendix, same title).

The student generates a clip block by block as at inference: each block from fresh noise, its history the student's own
clean blocks in the cache. The clip G is noised to x_t, and two models estimate the velocity there: the frozen real
score and the fake score, which follows the student's distribution. With v = eps - z and x0 = x_t - sigma v,

    g = v_real - v_fake = (x0_fake - x0_real) / sigma,

so the student target sg(G - g) points to what the real score predicts and away from the fake one.

A gradient flows only through the pass of one random exit step of every block.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from worldline_core.distillation.auxiliary_losses import PerceptualDistance, auxiliary_losses
from worldline_core.distillation.causal_objective import (
    CausalObjective,
    block_sigmas,
    frame_sigmas,
    maps_of,
    with_observed_frame,
)
from worldline_core.distillation.distill_config import CYCLE, DistillConfig
from worldline_core.distillation.trajectory_regression import TrajectoryBatch
from worldline_core.model.world_model import WorldModel
from worldline_core.training.clip_loader import Batch
from worldline_core.training.flow_matching import add_noise, flow_matching_loss
from worldline_core.training.trainer import step_generator
from worldline_core.training.training_config import LossWeighting

Score = Callable[[Tensor, Tensor], Tensor]
"""Velocity at a noisy clip, and the noise level of each of its frames "b t"."""


class DistributionMatchingObjective(CausalObjective[TrajectoryBatch]):
    """Step 3: five updates of the fake score, then one of the student, in one training loop.

    An iteration trains one of the two models, and reports the metrics of that one.
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

    def loss(self, batch: TrajectoryBatch, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        """The student's loss in one iteration of six, the fake score's in the others."""
        student_turn = self.trained_group(step) == "student"
        noise = torch.randn(batch.latents.shape, generator=generator, device=batch.latents.device)
        target = batch.latents
        if self.settings.target == "teacher":
            # The teacher's trajectory started from this noise: its clean end is what this rollout should become.
            noise = with_observed_frame(noise[..., :1, :, :], batch.nodes[:, 0])
            target = with_observed_frame(target[..., :1, :, :], batch.nodes[:, -1])
        generated = self.rollout(batch, maps_of(batch), noise, self.exit_step(step), with_gradient=student_turn)
        levels = self.levels(batch, generator)
        fresh = torch.randn(batch.latents.shape, generator=generator, device=batch.latents.device)
        fake = full_clip_score(self.fake, batch)
        if not student_turn:
            loss = fake_score_loss(fake, generated, fresh, levels, self.settings.weighting)
            return loss, {"fake_score": loss.item()}
        gradient = distribution_gradient(full_clip_score(self.real, batch), fake, generated, fresh, levels)
        matching = distribution_matching_loss(generated, gradient)
        auxiliary, values = auxiliary_losses(
            generated, target, batch.mask, batch.views, self.spec.block_size, self.settings.auxiliary, self.perceptual
        )
        measured = {"distribution_matching": matching, **values}
        return matching + auxiliary, {name: value.item() for name, value in measured.items()}

    def trained_group(self, step: int) -> str:
        """The student in one iteration of six, the last, so that the fake score knows it before it is first asked."""
        return "student" if step % CYCLE == CYCLE - 1 else "fake"

    def exit_step(self, step: int) -> int:
        """Exit step of this iteration: random, and the same on every process (it does not depend on the rank)."""
        stream = step_generator(self.settings.trainer.seed + 1, step, "cpu")
        return int(torch.randint(self.spec.steps, (1,), generator=stream))

    def levels(self, batch: Batch, generator: torch.Generator) -> Float[Tensor, "b t"]:
        """Noise level of every frame: one for each clip, but 0 for the observed frame."""
        clips, frames, size = len(batch.latents), batch.latents.shape[3], self.spec.block_size
        drawn = block_sigmas(self.settings.sigma, clips, frames, size, generator)
        return frame_sigmas(drawn[:, :1].expand_as(drawn).clamp(*self.settings.sigma_range), size)


def full_clip_score(model: WorldModel, batch: Batch) -> Score:
    """Score of a whole clip given its first frame and controls alone, as Stage II was trained."""

    def velocity(noisy: Tensor, levels: Tensor) -> Tensor:
        return model(noisy, levels, action_maps=maps_of(batch), views=batch.views, fps=batch.fps).velocity.float()

    return velocity


@torch.no_grad()
def distribution_gradient(
    real: Score,
    fake: Score,
    generated: Float[Tensor, "b v c t h w"],
    noise: Float[Tensor, "b v c t h w"],
    levels: Float[Tensor, "b t"],
) -> Float[Tensor, "b v c t h w"]:
    """g = v_real - v_fake at the noised rollout; 0 on the observed frame and never a source of gradients."""
    noisy = add_noise(generated.detach(), noise, levels)
    return real(noisy, levels) - fake(noisy, levels)


def distribution_matching_loss(
    generated: Float[Tensor, "b v c t h w"], gradient: Float[Tensor, "b v c t h w"]
) -> Float[Tensor, ""]:
    """L_DMD = ||G - sg(G - g)||^2, mean over the generated frames."""
    target = (generated - gradient).detach()
    return ((generated - target)[..., 1:, :, :] ** 2).mean()


def fake_score_loss(
    fake: Score,
    generated: Float[Tensor, "b v c t h w"],
    noise: Float[Tensor, "b v c t h w"],
    levels: Float[Tensor, "b t"],
    weighting: LossWeighting,
) -> Float[Tensor, ""]:
    """Flow matching of the fake score on a rollout of the student (which takes no gradient)."""
    clean = generated.detach()
    return flow_matching_loss(fake(add_noise(clean, noise, levels), levels), clean, noise, levels, weighting)
