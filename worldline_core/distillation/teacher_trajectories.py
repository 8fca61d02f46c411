"""Denoising trajectories of the frozen causal teacher (appendix, "Four-Step Trajectory Regression").

For every block, explicit Euler integration from noise along the nodes of the sampler (the paper's: sigma = 1, 15/16,
5/6, 5/8, 0), keeping the state at each of them. Between two nodes the ODE may take several sub-steps: with one sub-step
everywhere the teacher is exactly its own few-step sampler, and only the terminal objective teaches anything; finer
sub-steps make the nodes those of the teacher's many-step solution, which the student then reaches in few.

Axes: b clips, k nodes, v views, c latent channels, t latent frames (nodes leave out the observed one), h w rows and
columns.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from worldline_core.distillation.auxiliary_losses import clip_robot_masks
from worldline_core.distillation.causal_objective import maps_of
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.errors import ConfigError
from worldline_core.model.block_causal_attention import block_bounds
from worldline_core.model.contracts import CAUSAL_SHIFT, CausalSpec
from worldline_core.model.world_model import WorldModel
from worldline_core.rollout.samplers import VelocityField, integrate
from worldline_core.training.clip_config import FrameInput
from worldline_core.training.clip_loader import Batch, ClipLoader
from worldline_core.training.clip_sampler import Clip
from worldline_core.training.trainer import autocast, step_generator


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
    velocity: VelocityField, noise: Tensor, substeps: Sequence[int], nodes: Sequence[float]
) -> list[Tensor]:
    """States at all `nodes`, the first being the noise itself, by explicit Euler steps of dx/dsigma = velocity.

    Args:
        velocity: field at (state, sigma).
        substeps: Euler steps of each interval, one number per interval.

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
        state = integrate(velocity, state, substep_sigmas(start, stop, count))
        states.append(state)
    return states


@torch.no_grad()
def teacher_trajectories(
    teacher: WorldModel,
    latents: Float[Tensor, "b v c t h w"],
    action_maps: Float[Tensor, "b v a t #h #w"],
    noise: Float[Tensor, "b v c t h w"],
    *,
    views: Sequence[str],
    spec: CausalSpec,
    substeps: Sequence[int],
    fps: Float[Tensor, " b"] | None = None,
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
    bounds = block_bounds(latents.shape[3], spec.block_size)
    cache = spec.new_cache(fps)
    teacher.write_block(latents[..., :1, :, :], cache, action_maps=action_maps[..., :1, :, :], views=views)
    blocks: list[Tensor] = []
    for start, stop in bounds[1:]:
        maps = action_maps[..., start:stop, :, :]
        velocity = partial(teacher.forward_block, cache=cache, action_maps=maps, views=views)
        states = euler_nodes(velocity, noise[..., start:stop, :, :], substeps, spec.sigmas)
        blocks.append(torch.stack(states, dim=1))
        if stop < bounds[-1][1]:
            clean = states[-1] if generated_history else latents[..., start:stop, :, :]
            teacher.write_block(clean, cache, action_maps=maps, views=views)
    return torch.cat(blocks, dim=4)


def robot_masks(loader: ClipLoader, clips: Sequence[Clip], views: Sequence[str]) -> Float[Tensor, "b v t h w"]:
    """Robot masks of some clips from their action tracks.

    Raises:
        ConfigError: the loader has no action tracks.
    """
    if loader.tracks is None:
        raise ConfigError("Robot masks come from action tracks", next_step="give the tracks to the clip loader")
    cut = [loader.tracks.tracks(clip.episode_id).clip(list(clip.frames)) for clip in clips]
    return clip_robot_masks(cut, views, loader.source.latent_shape[1:])


def trajectory_shard(
    number: int, config: DistillConfig, teacher: WorldModel, loader: ClipLoader, load: Callable[[int], Batch]
) -> tuple[Sequence[Clip], dict[str, Tensor]]:
    """Clips and tensors of one shard of the store: a function of the seed and the shard's number.

    Args:
        load: reads the shard's clips by its number.
    """
    settings, trainer = config.trajectory_regression.trajectories, config.trajectory_regression.trainer
    batch = load(number)
    generator = step_generator(settings.seed, number, trainer.device)
    noise = torch.randn(batch.latents.shape, generator=generator, device=batch.latents.device)
    with autocast(trainer):
        nodes = teacher_trajectories(
            teacher,
            batch.latents,
            maps_of(batch),
            noise,
            views=batch.views,
            spec=config.spec,
            substeps=settings.substeps,
            fps=batch.fps,
            generated_history=settings.history == "generated",
        )
    tensors = {"nodes": nodes, "mask": robot_masks(loader, batch.clips, batch.views)}
    if isinstance(config.input, FrameInput):
        tensors["latents"] = batch.latents
    return batch.clips, tensors
