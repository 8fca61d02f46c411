"""Samplers: Euler integration of the rectified flow (paper, Rollout), for a whole clip or block by block."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from copy import copy
from functools import partial
from typing import Any

import torch
from einops import rearrange, repeat
from jaxtyping import Float
from torch import Tensor

from worldline_core.errors import ConfigError, DataError
from worldline_core.model.block_causal_attention import KVCache
from worldline_core.model.world_model import TextContext, WorldModel
from worldline_core.model.world_model_config import CAUSAL_SHIFT, FULL_STEPS, VIEWS, CausalSpec

VelocityField = Callable[[Tensor, float], Tensor]
"""Velocity at (state, noise level)."""


def shifted_sigmas(steps: int, shift: float = 1.0) -> tuple[float, ...]:
    """``steps + 1`` nodes from 1 to 0; ``s' = shift s / (1 + (shift - 1) s)`` of an even grid.

    Raises:
        ConfigError: fewer than one step, or a shift that is not positive.
    """
    if steps < 1 or shift <= 0:
        raise ConfigError("A sampler needs at least one step and a positive shift", got=f"steps {steps}, shift {shift}")
    grid = [1.0 - step / steps for step in range(steps)]
    return (*(shift * s / (1.0 + (shift - 1.0) * s) for s in grid), 0.0)


def sigmas_causal(spec: CausalSpec, steps: int | None = None) -> tuple[float, ...]:
    """Nodes of the block-causal sampler: those the model was trained on, or for another number of steps shifted ones."""
    return spec.sigmas if steps in (None, spec.steps) else shifted_sigmas(steps or 1, CAUSAL_SHIFT)


def euler_step(
    latents: Float[Tensor, "*shape"], velocity: Float[Tensor, "*shape"], sigma: float, next_sigma: float
) -> Float[Tensor, "*shape"]:
    """``z' = z + (sigma' - sigma) v``, in float32."""
    return latents + (next_sigma - sigma) * velocity.float()


def integrate(velocity: VelocityField, state: Tensor, sigmas: Sequence[float]) -> Tensor:
    """Explicit Euler steps of ``dz / dsigma = velocity`` along ``sigmas``; a single level leaves the state as it is."""
    for sigma, next_sigma in itertools.pairwise(sigmas):
        state = euler_step(state, velocity(state, sigma), sigma, next_sigma)
    return state


class Noise:
    """Gaussian noise that depends on each clip's seed alone, not on who shares its batch.

    Drawn on the CPU in float32, so that CPU and GPU start from the same noise.
    """

    def __init__(self, seeds: Sequence[int]) -> None:
        self._generators = [torch.Generator().manual_seed(seed) for seed in seeds]

    def draw(self, shape: Sequence[int], device: torch.device | str = "cpu") -> Tensor:
        """``(batch, *shape)``, one slice per seed."""
        return torch.stack([torch.randn(tuple(shape), generator=g) for g in self._generators]).to(device)

    def __len__(self) -> int:
        return len(self._generators)

    def fork(self, clips: Sequence[int], seeds: Sequence[int] | None = None) -> Noise:
        """A separate source for these clips: in the same state as this one, or seeded anew."""
        other = Noise([0] * len(clips) if seeds is None else seeds)
        if seeds is None:
            for twin, clip in zip(other._generators, clips, strict=True):
                twin.set_state(self._generators[clip].get_state())
        return other


@torch.no_grad()
def rollout_full_clip(
    model: WorldModel,
    first_latents: Float[Tensor, "b v c h w"],
    action_maps: Float[Tensor, "b v a t #h #w"] | None,
    *,
    noise: Noise,
    steps: int = FULL_STEPS,
    shift: float = 1.0,
    frames: int | None = None,
    views: Sequence[str] = VIEWS,
    text: TextContext | None = None,
    fps: float | None = None,
    bfloat16: bool = False,
) -> Float[Tensor, "b v c t h w"]:
    """Integrate from noise to a clip whose first latent frame is ``first_latents``; no classifier-free guidance.

    Args:
        action_maps: controls of every latent frame; None for a model without actions (then give ``frames``).
        noise: one source per clip.
        shift: moves the noise levels of the steps towards noise.
        fps: frames per second of the clips; None: as the model's config says.

    Raises:
        ConfigError: fewer than one step.
        DataError: a shape does not fit the model.
    """
    if frames is None:
        frames = 1 if action_maps is None else action_maps.shape[3]
    batch, views_count, channels, height, width = first_latents.shape
    first = repeat(first_latents.float(), "b v c h w -> b v c 1 h w")
    latents = noise.draw((views_count, channels, frames, height, width), first.device)
    latents = torch.cat((first, latents[:, :, :, 1:]), dim=3)
    rates = _rates(fps, first)

    def velocity(state: Tensor, sigma: float) -> Tensor:
        # The first frame's velocity is zero, so it stays what was observed.
        levels = torch.full((batch,), sigma, device=state.device)
        return model(state, levels, action_maps=action_maps, text=text, views=tuple(views), fps=rates).velocity

    with torch.autocast(first.device.type, torch.bfloat16, enabled=bfloat16):
        return integrate(velocity, latents, shifted_sigmas(steps, shift))


def _rates(fps: float | None, first: Tensor) -> Tensor | None:
    return None if fps is None else torch.full((len(first),), fps, device=first.device)


class FullClipSampler:
    """Samples one whole clip per step with a Stage II model."""

    units_per_clip: int | None = 1
    """Steps until the prediction begins anew at its last picture; None: it never does."""

    def __init__(
        self,
        model: WorldModel,
        *,
        noise: Noise,
        steps: int,
        shift: float,
        views: Sequence[str],
        fps: float,
        bfloat16: bool,
    ) -> None:
        self.views = tuple(views)
        self._noise = noise
        self._sample = partial(
            rollout_full_clip, model, steps=steps, shift=shift, views=self.views, fps=fps, bfloat16=bfloat16
        )
        self._begin: tuple[Tensor, Tensor]

    def start(self, first_latents: Float[Tensor, "b v c h w"], action_maps: Float[Tensor, "b v a 1 #h #w"]) -> None:
        """Begin a clip at observed latents, with the controls of that frame."""
        self._begin = first_latents, action_maps

    def step(self, action_maps: Float[Tensor, "b v a t #h #w"]) -> Float[Tensor, "b v c t h w"]:
        """Latent frames of the clip after its first one, under these controls."""
        first, maps = self._begin
        return self._sample(first, torch.cat((maps, action_maps), dim=3), noise=self._noise)[:, :, :, 1:]

    def fork(self, clips: Sequence[int], seeds: Sequence[int] | None = None) -> FullClipSampler:
        """A sampler for the next clips of some clips; ``seeds``: of the noise from here on."""
        other = copy(self)
        other._noise = self._noise.fork(clips, seeds)
        return other


class BlockCausalSimulator:
    """Start from observed frames, then step with new controls; the cost of a step does not grow.

    Each block starts from fresh noise and is denoised in a few Euler steps against the cache. Its clean form is written to the
    cache (as conditioning: without time embedding) in the pass that takes the first step of the next block.

    Args:
        spec: block size, window and nodes, as the model was trained with.
        noise: one source per clip.
        fps: frames per second of the clips; None: as the model's config says.
    """

    def __init__(
        self,
        model: WorldModel,
        spec: CausalSpec,
        *,
        noise: Noise,
        views: Sequence[str] = VIEWS,
        fps: float | None = None,
        bfloat16: bool = False,
    ) -> None:
        self.model = model
        self.spec = spec
        self.units_per_clip = spec.anchor_blocks
        self.views = tuple(views)
        self.fps = fps
        self.bfloat16 = bfloat16
        self.noise = noise
        self.cache = KVCache(spec.sink_blocks, spec.recent_blocks)
        self._unwritten: tuple[Tensor, Tensor | None] | None = None

    def start(
        self, first_latents: Float[Tensor, "b v c h w"], action_maps: Float[Tensor, "b v a 1 #h #w"] | None = None
    ) -> None:
        """Begin a rollout at observed latents, with the controls of that frame; forgets any rollout before it."""
        self.cache = KVCache(self.spec.sink_blocks, self.spec.recent_blocks, _rates(self.fps, first_latents))
        self._unwritten = (rearrange(first_latents.float(), "b v c h w -> b v c 1 h w"), action_maps)

    @torch.no_grad()
    def step(self, action_maps: Float[Tensor, "b v a t #h #w"] | None) -> Float[Tensor, "b v c t h w"]:
        """Predict the next block. Raises: DataError when not started, or the controls are not those of one block."""
        if action_maps is not None and action_maps.shape[3] != self.spec.block_size:
            raise DataError(
                "Controls of one block are needed",
                expected=f"{self.spec.block_size} latent frames",
                got=action_maps.shape[3],
            )
        known = self.cache.reference if self._unwritten is None else self._unwritten[0]
        if known is None:
            raise DataError("The rollout has not been started", next_step="call start() with the observed latents")
        views, channels, _, height, width = known.shape[1:]
        noise = self.noise.draw((views, channels, self.spec.block_size, height, width), known.device)
        controls: dict[str, Any] = {"action_maps": action_maps, "views": self.views}

        def velocity(state: Tensor, sigma: float) -> Tensor:
            if self._unwritten is None:
                return self.model.forward_block(state, sigma, self.cache, **controls)
            clean, maps = self._unwritten
            found = self.model.write_and_forward_block(clean, state, sigma, self.cache, clean_maps=maps, **controls)
            self._unwritten = None
            return found

        with torch.autocast(noise.device.type, torch.bfloat16, enabled=self.bfloat16):
            latents = integrate(velocity, noise, self.spec.sigmas)
        self._unwritten = (latents, action_maps)
        return latents

    def fork(self, clips: Sequence[int] | None = None, seeds: Sequence[int] | None = None) -> BlockCausalSimulator:
        """A simulator in the same state that goes on separately: to try several controls from one moment.

        Args:
            clips: to go on with, by default all. One that is named several times is branched: its last block is written
                to the cache once, for all branches.
            seeds: of the noise from here on, one for each of ``clips``; by default every branch draws what its clip would.
        """
        clips = range(len(self.noise)) if clips is None else clips
        if len(set(clips)) < len(clips):
            self._write()
        other = copy(self)
        other.noise = self.noise.fork(clips, seeds)
        other.cache = self.cache.select(clips)
        if self._unwritten is not None:
            latents, maps = self._unwritten
            other._unwritten = latents[list(clips)], None if maps is None else maps[list(clips)]
        return other

    @torch.no_grad()
    def _write(self) -> None:
        """Write the last block to the cache, unless it is there."""
        if self._unwritten is None:
            return
        latents, action_maps = self._unwritten
        with torch.autocast(latents.device.type, torch.bfloat16, enabled=self.bfloat16):
            self.model.write_block(latents, self.cache, action_maps=action_maps, views=self.views)
        self._unwritten = None
