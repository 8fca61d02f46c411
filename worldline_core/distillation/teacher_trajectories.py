"""Denoising trajectories of the frozen causal teacher (appendix, "Four-Step Trajectory Regression").

For every block, explicit Euler integration from noise along sigma = 1, 15/16, 5/6, 5/8, 0, keeping the state at each of
these nodes. Between two nodes the ODE may take several sub-steps: with one sub-step everywhere the teacher is exactly
its own four-step sampler, and only the terminal objective teaches anything; finer sub-steps make the nodes those of
the teacher's many-step solution, which the student then reaches in four.

Axes: b clips, k nodes, v views, c latent channels, t latent frames (nodes leave out the observed one), h w rows and
columns.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from worldline_core.distillation.causal_history import CacheWindow, CausalHistory
from worldline_core.errors import ConfigError
from worldline_core.model.block_causal import block_bounds
from worldline_core.model.world_model import WorldModel
from worldline_core.rollout.euler import CAUSAL_SHIFT, CAUSAL_SIGMAS, euler_step

NODES = CAUSAL_SIGMAS
"""Noise levels of the four-step sampler, at which the trajectories are kept."""

VelocityField = Callable[[Tensor, float], Tensor]


def substep_sigmas(start: float, stop: float, substeps: int) -> list[float]:
    """Noise levels from `start` down to `stop`, both included, evenly spaced before the shift of the schedule.

    With sigma = s u / (1 + (s - 1) u) the sub-steps are even in u, as the full-length sampler spaces its steps.

    Raises:
        ConfigError: no sub-step, or levels that do not descend within [0, 1].
    """
    if substeps < 1 or not 1.0 >= start > stop >= 0.0:
        raise ConfigError(
            "Cannot divide an interval of noise levels",
            expected="1 >= start > stop >= 0 and at least one sub-step",
            got=f"start {start}, stop {stop}, {substeps} sub-steps",
        )
    first, last = (sigma / (CAUSAL_SHIFT - (CAUSAL_SHIFT - 1) * sigma) for sigma in (start, stop))
    between = [first + (last - first) * i / substeps for i in range(1, substeps)]
    return [start, *(CAUSAL_SHIFT * u / (1 + (CAUSAL_SHIFT - 1) * u) for u in between), stop]


def euler_nodes(
    velocity: VelocityField, noise: Tensor, substeps: Sequence[int], nodes: Sequence[float] = NODES
) -> list[Tensor]:
    """States at all `nodes`, the first being the noise itself, by explicit Euler steps of dx/dsigma = velocity.

    Args:
        velocity: field at (state, sigma).
        substeps: Euler steps of each interval, one number an interval.

    Raises:
        ConfigError: another number of intervals than of sub-step counts.
    """
    if len(substeps) != len(nodes) - 1:
        raise ConfigError(
            "One number of sub-steps is needed for each interval between nodes",
            expected=len(nodes) - 1,
            got=list(substeps),
        )
    state, states = noise, [noise]
    for (start, stop), count in zip(itertools.pairwise(nodes), substeps, strict=True):
        levels = substep_sigmas(start, stop, count)
        for level, following in itertools.pairwise(levels):
            state = euler_step(state, velocity(state, level), level, following)
        states.append(state)
    return states


@torch.no_grad()
def teacher_trajectories(
    teacher: WorldModel,
    latents: Float[Tensor, "b v c t h w"],
    action_maps: Float[Tensor, "b v a t h w"],
    noise: Float[Tensor, "b v c t h w"],
    *,
    views: Sequence[str],
    block_size: int,
    window: CacheWindow,
    substeps: Sequence[int],
    generated_history: bool = False,
) -> Float[Tensor, "b k v c u h w"]:
    """States at every node of every block after the observed frame (u = t - 1 latent frames).

    Args:
        latents: recorded clips; frame 0 is the observation. The later frames are the history that each block sees,
            unless `generated_history` puts the teacher's own clean blocks there.
        noise: starting noise; frame 0 is not read.

    Raises:
        DataError: the clip does not divide into blocks.
    """
    bounds = block_bounds(latents.shape[3], block_size)
    history = CausalHistory(teacher, views, window)
    history.remember(latents[..., :1, :, :], action_maps[..., :1, :, :])
    blocks: list[Tensor] = []
    for start, stop in bounds[1:]:
        maps = action_maps[..., start:stop, :, :]

        def field(state: Tensor, sigma: float, maps: Tensor = maps) -> Tensor:
            return history.velocity(state, sigma, maps)

        states = euler_nodes(field, noise[..., start:stop, :, :], substeps)
        blocks.append(torch.stack(states, dim=1))
        if stop < bounds[-1][1]:
            history.remember(states[-1] if generated_history else latents[..., start:stop, :, :], maps)
    return torch.cat(blocks, dim=4)


def with_observed_frame(
    first: Float[Tensor, "b v c 1 h w"], later: Float[Tensor, "b v c u h w"]
) -> Float[Tensor, "b v c t h w"]:
    """A whole clip: the observed latent frame, then the others."""
    return torch.cat((first, later), dim=3)


def node_of_each_block(
    nodes: Float[Tensor, "b k v c u h w"], index: Tensor, block_size: int
) -> Float[Tensor, "b v c u h w"]:
    """The state of every block at the node that `index` (b, blocks) names for it."""
    split = rearrange(nodes, "b k v c (n s) h w -> b n k v c s h w", s=block_size)
    clips = torch.arange(index.shape[0], device=index.device)[:, None]
    blocks = torch.arange(index.shape[1], device=index.device)[None, :]
    return rearrange(split[clips, blocks, index], "b n v c s h w -> b v c (n s) h w")
