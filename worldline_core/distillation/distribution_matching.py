"""Stage III, step 3: score-based distribution matching on the student's own rollouts (appendix, same title).

The student generates a clip block by block as at inference: each block from fresh noise, its history the student's own
clean blocks in the cache. The clip G is noised to x_t, and two models estimate the velocity there: the frozen real
score and the fake score, which follows the student's distribution. With v = eps - z and x0 = x_t - sigma v,

    g = v_real - v_fake = (x0_fake - x0_real) / sigma,

so the student target sg(G - g) lies towards what the real score believes and away from the fake one.

A gradient flows only through the pass of one random exit step of every block (all other passes and the cache are free
of gradients), so memory does not grow with the number of blocks or steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from worldline_core.distillation.causal_teacher_forcing import CacheWindow, frame_sigmas
from worldline_core.distillation.distill_config import CYCLE
from worldline_core.distillation.teacher_trajectories import NODES
from worldline_core.errors import ConfigError
from worldline_core.model.block_causal_attention import KVCache, block_bounds
from worldline_core.model.world_model import WorldModel
from worldline_core.rollout.samplers import integrate
from worldline_core.training.flow_matching import LossWeighting, add_noise, flow_matching_loss

Score = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Velocity at (noisy clip, the clip's own clean latents, sigma of every block "b blocks")."""


def is_student_iteration(iteration: int) -> bool:
    """One in six; the last of each cycle, so that the fake score knows the student before it is first asked."""
    return iteration % CYCLE == CYCLE - 1


def self_forced_rollout(
    student: WorldModel,
    first: Float[Tensor, "b v c 1 h w"],
    action_maps: Float[Tensor, "b v a t h w"],
    noise: Float[Tensor, "b v c t h w"],
    exit_step: int,
    *,
    views: Sequence[str],
    block_size: int,
    window: CacheWindow,
    with_gradient: bool,
) -> Float[Tensor, "b v c t h w"]:
    """Generate a clip with the student's sampler, stopping every block at `exit_step` with its clean prediction.

    `exit_step` = K - 1 is the complete four-step sampler. An earlier exit predicts the clean block from an earlier
    node, so that in the course of training every node's prediction is matched.

    Args:
        first: the observed latent frame.
        noise: starting noise of every frame; frame 0 is not read.
        with_gradient: let gradients flow through the exit pass of each block.

    Raises:
        ConfigError: no such step.
        DataError: the clip does not divide into blocks.
    """
    if not 0 <= exit_step < len(NODES) - 1:
        raise ConfigError("No such exit step", expected=f"0..{len(NODES) - 2}", got=exit_step)
    cache = KVCache(window.sink_blocks, window.recent_blocks)
    student.write_block(first, cache, action_maps=action_maps[..., :1, :, :], views=views)
    bounds = block_bounds(noise.shape[3], block_size)
    blocks = [first]
    for start, stop in bounds[1:]:
        maps = action_maps[..., start:stop, :, :]
        velocity = partial(student.forward_block, cache=cache, action_maps=maps, views=views)
        state = noise[..., start:stop, :, :]
        with torch.no_grad():
            state = integrate(velocity, state, NODES[: exit_step + 1])
        with torch.set_grad_enabled(with_gradient):
            clean = integrate(velocity, state, (NODES[exit_step], 0.0))
        blocks.append(clean)
        if stop < bounds[-1][1]:
            student.write_block(clean, cache, action_maps=maps, views=views)
    return torch.cat(blocks, dim=3)


def causal_score(
    model: WorldModel, action_maps: Float[Tensor, "b v a t h w"], *, views: Sequence[str], block_size: int
) -> Score:
    """Score of each block given the clean blocks before it (teacher-forcing pass over the rollout itself)."""

    def velocity(noisy: Tensor, clean: Tensor, sigma: Tensor) -> Tensor:
        return model.forward_teacher_forcing(
            noisy, clean, sigma, action_maps=action_maps, block_size=block_size, views=views
        ).float()

    return velocity


def full_clip_score(
    model: WorldModel, action_maps: Float[Tensor, "b v a t h w"], *, views: Sequence[str], block_size: int
) -> Score:
    """Score of the whole clip given its first frame alone, as Stage II was trained; blocks share attention."""

    def velocity(noisy: Tensor, clean: Tensor, sigma: Tensor) -> Tensor:
        levels = frame_sigmas(sigma, block_size)
        return model(noisy, levels, action_maps=action_maps, views=views).velocity.float()

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
