"""Stage III, step 3: score-based distribution matching on the student's own rollouts (appendix, same title).

The student generates a clip block by block as at inference: each block from fresh noise, its history the student's own
clean blocks in the cache. The clip G is noised to x_t, and two models estimate the velocity there: the frozen real
score and the fake score, which follows the student's distribution. With v = eps - z and x0 = x_t - sigma v,

    g = v_real - v_fake = (x0_fake - x0_real) / sigma,

so the student target sg(G - g) lies towards what the real score believes and away from the fake one.

A gradient flows only through the pass of one random exit step of every block.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from einops import repeat
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
from worldline_core.distillation.teacher_trajectories import TrajectoryBatch
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import CausalSpec
from worldline_core.training.clip_loader import Batch
from worldline_core.training.flow_matching import add_noise, flow_matching_loss
from worldline_core.training.trainer import step_generator
from worldline_core.training.training_config import LossWeighting

Score = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Velocity at (noisy clip, the clip's own clean latents, sigma of every block "b blocks")."""


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
        maps = maps_of(batch)
        student_turn = self.trained_group(step) == "student"
        noise = torch.randn(batch.latents.shape, generator=generator, device=batch.latents.device)
        if self.settings.target == "teacher":
            # The teacher's trajectory started from this noise: its clean end is what this rollout should become.
            noise = with_observed_frame(noise[..., :1, :, :], batch.nodes[:, 0])
        generated = self.rollout(batch, maps, noise, self.exit_step(step), with_gradient=student_turn)
        sigma = self.sigmas(batch, generator)
        fresh = torch.randn(batch.latents.shape, generator=generator, device=batch.latents.device)
        fake = self.score(self.fake, batch, maps)
        if not student_turn:
            loss = fake_score_loss(
                fake, generated, fresh, sigma, block_size=self.spec.block_size, weighting=self.settings.weighting
            )
            return loss, {"fake_score": loss.item()}
        gradient = distribution_gradient(
            self.score(self.real, batch, maps), fake, generated, fresh, sigma, self.spec.block_size
        )
        matching = distribution_matching_loss(generated, gradient)
        target = batch.latents
        if self.settings.target == "teacher":
            target = with_observed_frame(target[..., :1, :, :], batch.nodes[:, -1])
        auxiliary, values = auxiliary_losses(
            generated,
            target,
            mask=batch.mask,
            views=batch.views,
            block_size=self.spec.block_size,
            weights=self.settings.auxiliary,
            perceptual=self.perceptual,
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

    def sigmas(self, batch: Batch, generator: torch.Generator) -> Tensor:
        """Noise level of every block: one per clip for Stage II scores, which know no other, else independent."""
        clips, frames = len(batch.latents), batch.latents.shape[3]
        drawn = block_sigmas(self.settings.sigma, clips, frames, self.spec.block_size, generator)
        if self.settings.real_score == "stage2":
            drawn = repeat(drawn[:, 0], "b -> b blocks", blocks=drawn.shape[1])
        return drawn.clamp(*self.settings.sigma_range)

    def score(self, model: WorldModel, batch: Batch, maps: Tensor) -> Score:
        """The velocity field of a score model, in the form it was trained in."""
        form = full_clip_score if self.settings.real_score == "stage2" else causal_score
        return form(model, maps, views=batch.views, fps=batch.fps, spec=self.config.training_spec)


def causal_score(
    model: WorldModel,
    action_maps: Float[Tensor, "b v a t #h #w"],
    *,
    views: Sequence[str],
    spec: CausalSpec,
    fps: Float[Tensor, " b"] | None = None,
) -> Score:
    """Score of each block given the clean blocks of its window (teacher-forcing pass over the rollout itself)."""

    def velocity(noisy: Tensor, clean: Tensor, sigma: Tensor) -> Tensor:
        return model.forward_teacher_forcing(
            noisy, clean, sigma, action_maps=action_maps, spec=spec, views=views, fps=fps
        ).float()

    return velocity


def full_clip_score(
    model: WorldModel,
    action_maps: Float[Tensor, "b v a t #h #w"],
    *,
    views: Sequence[str],
    spec: CausalSpec,
    fps: Float[Tensor, " b"] | None = None,
) -> Score:
    """Score of the whole clip given its first frame alone, as Stage II was trained; blocks share attention."""

    def velocity(noisy: Tensor, clean: Tensor, sigma: Tensor) -> Tensor:
        levels = frame_sigmas(sigma, spec.block_size)
        return model(noisy, levels, action_maps=action_maps, views=views, fps=fps).velocity.float()

    return velocity


@torch.no_grad()
def distribution_gradient(
    real: Score,
    fake: Score,
    generated: Float[Tensor, "b v c t h w"],
    noise: Float[Tensor, "b v c t h w"],
    sigma: Float[Tensor, "b blocks"],
    block_size: int,
) -> Float[Tensor, "b v c t h w"]:
    """g = v_real - v_fake at the noised rollout; 0 on the observed frame and never a source of gradients."""
    clean = generated.detach()
    noisy = add_noise(clean, noise, frame_sigmas(sigma, block_size))
    return real(noisy, clean, sigma) - fake(noisy, clean, sigma)


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
    sigma: Float[Tensor, "b blocks"],
    *,
    block_size: int,
    weighting: LossWeighting,
) -> Float[Tensor, ""]:
    """Flow matching of the fake score on a rollout of the student (which takes no gradient)."""
    clean = generated.detach()
    levels = frame_sigmas(sigma, block_size)
    velocity = fake(add_noise(clean, noise, levels), clean, sigma)
    return flow_matching_loss(velocity, clean, noise, levels, weighting)
