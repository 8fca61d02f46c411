"""Common parts of the three objectives of Stage III: noise levels per block, the student's own rollout, held-out errors.

Axes: b clips, v views, c latent channels, t latent frames, h and w rows and columns.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import partial

import torch
from einops import repeat
from jaxtyping import Float
from torch import Tensor

from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.errors import ConfigError
from worldline_core.model.block_causal_attention import KVCache, block_bounds
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import CausalSpec
from worldline_core.rollout.samplers import integrate
from worldline_core.training.clip_loader import Batch
from worldline_core.training.flow_matching import sample_sigmas
from worldline_core.training.trainer import Objective
from worldline_core.training.training_config import SigmaSampling


def frame_sigmas(sigma: Float[Tensor, "b blocks"], block_size: int) -> Float[Tensor, "b t"]:
    """Noise level of every latent frame: 0 for the observed one, its block's level for every other."""
    later = repeat(sigma, "b blocks -> b (blocks size)", size=block_size)
    return torch.cat((later.new_zeros(len(later), 1), later), dim=1)


def block_sigmas(
    sampling: SigmaSampling, clips: int, latent_frames: int, block_size: int, generator: torch.Generator
) -> Float[Tensor, "b blocks"]:
    """An independent noise level for every block of every clip: each block is its own denoising problem."""
    blocks = len(block_bounds(latent_frames, block_size)) - 1
    return sample_sigmas(sampling, clips * blocks, generator).reshape(clips, blocks)


def with_observed_frame(
    first: Float[Tensor, "b v c 1 h w"], later: Float[Tensor, "b v c u h w"]
) -> Float[Tensor, "b v c t h w"]:
    """A whole clip: the observed latent frame, then the others."""
    return torch.cat((first, later), dim=3)


def maps_of(batch: Batch) -> Float[Tensor, "b v a t h w"]:
    """Action maps of a batch.

    Raises:
        ConfigError: there are none.
    """
    if batch.action_maps is None:
        raise ConfigError("Distillation needs action maps", next_step="give the action tracks to the clip loader")
    return batch.action_maps


def self_forced_rollout(
    student: WorldModel,
    first: Float[Tensor, "b v c 1 h w"],
    action_maps: Float[Tensor, "b v a t #h #w"],
    noise: Float[Tensor, "b v c t h w"],
    exit_step: int,
    *,
    views: Sequence[str],
    spec: CausalSpec,
    fps: Float[Tensor, " b"] | None = None,
    with_gradient: bool,
) -> Float[Tensor, "b v c t h w"]:
    """Generate a clip with the student's sampler, stopping every block at `exit_step` with its clean prediction.

    The last step, K - 1 of 0 .. K - 1, is the complete sampler. An earlier exit predicts the clean block from an
    earlier node, so that in the course of training every node's prediction is matched.

    Args:
        first: the observed latent frame.
        noise: starting noise of every frame; frame 0 is not read.
        with_gradient: let gradients flow through the exit pass of each block. All other passes and the cache are free
            of gradients, so memory does not grow with the number of blocks or steps.

    Raises: DataError: the clip does not divide into blocks.
    """
    cache = KVCache(spec.sink_blocks, spec.recent_blocks, fps)
    student.write_block(first, cache, action_maps=action_maps[..., :1, :, :], views=views)
    bounds = block_bounds(noise.shape[3], spec.block_size)
    blocks = [first]
    for start, stop in bounds[1:]:
        maps = action_maps[..., start:stop, :, :]
        velocity = partial(student.forward_block, cache=cache, action_maps=maps, views=views)
        state = noise[..., start:stop, :, :]
        with torch.no_grad():
            state = integrate(velocity, state, spec.sigmas[: exit_step + 1])
        with torch.set_grad_enabled(with_gradient):
            clean = integrate(velocity, state, (spec.sigmas[exit_step], 0.0))
        blocks.append(clean)
        if stop < bounds[-1][1]:
            student.write_block(clean, cache, action_maps=maps, views=views)
    return torch.cat(blocks, dim=3)


class CausalObjective[BatchT: Batch](Objective[BatchT], ABC):
    """A block-causal model under training, and the error of its own rollouts on held-out clips.

    Each step of Stage III has a loss of its own; nothing but the weights changes from step to step.
    """

    def __init__(self, model: WorldModel, config: DistillConfig) -> None:
        self.model = model
        self.config = config
        self.spec = config.spec

    @abstractmethod
    def loss(self, batch: BatchT, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]: ...

    def validation_losses(self, batch: Batch, generator: torch.Generator) -> dict[str, float]:
        """Squared latent error of complete rollouts: with the true controls, with another clip's, and copying.

        A model that follows its controls is worse with another clip's. All three steps report the same numbers.
        """
        maps = maps_of(batch)
        noise = torch.randn(batch.latents.shape, generator=generator, device=batch.latents.device)
        predictions = {
            name: self.rollout(batch, controls, noise, self.spec.steps - 1, with_gradient=False)
            for name, controls in (("", maps), ("_shuffled_actions", maps.roll(1, dims=0)))
        }
        predictions["_copy"] = batch.latents[..., :1, :, :].expand_as(batch.latents)
        return {
            f"rollout_error{name}": float(((value - batch.latents)[..., 1:, :, :] ** 2).mean())
            for name, value in predictions.items()
        }

    def predict(self, batch: Batch, action_maps: Tensor, noise: Tensor) -> Tensor:
        """Complete rollouts, as `validation_losses` makes them."""
        return self.rollout(batch, action_maps, noise, self.spec.steps - 1, with_gradient=False)

    def rollout(self, batch: Batch, maps: Tensor, noise: Tensor, exit_step: int, *, with_gradient: bool) -> Tensor:
        """The model's own rollout from the observed frame of each clip."""
        first = batch.latents[..., :1, :, :]
        return self_forced_rollout(
            self.model,
            first,
            maps,
            noise,
            exit_step,
            views=batch.views,
            spec=self.spec,
            fps=batch.fps,
            with_gradient=with_gradient,
        )
