"""The causal simulator: one block of latent frames at a time, controls accepted before every block."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from worldline_core.errors import DataError
from worldline_core.model.block_causal_attention import KVCache
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import VIEWS
from worldline_core.rollout.full_clip import CAUSAL_SIGMAS, Noise, check_nodes, euler_step

BLOCK_SIZE = 4


class BlockCausalSimulator:
    """Start from observed frames, then step with new controls; the cost of a step does not grow.

    Each block starts from fresh noise and is denoised in a few Euler steps against the cache; when done, its clean form
    is written to the cache in one more pass (as conditioning: without time embedding). The write waits until the next
    block is asked for, so the last block of a rollout costs no write pass.

    Args:
        noise: one source a clip.
        sink_blocks: blocks kept from the start (the observed frame is block 0).
        recent_blocks: most recent blocks kept besides; at most what the model was trained on.
    """

    def __init__(
        self,
        model: WorldModel,
        *,
        noise: Noise,
        sigmas: Sequence[float] = CAUSAL_SIGMAS,
        block_size: int = BLOCK_SIZE,
        sink_blocks: int = 1,
        recent_blocks: int = 3,
        views: Sequence[str] = VIEWS,
        bfloat16: bool = False,
    ) -> None:
        check_nodes(sigmas)
        self.model = model
        self.sigmas = tuple(sigmas)
        self.block_size = block_size
        self.views = tuple(views)
        self.bfloat16 = bfloat16
        self.noise = noise
        self.cache = KVCache(sink_blocks, recent_blocks)
        self._unwritten: tuple[Tensor, Tensor | None] | None = None

    def start(
        self, first_latents: Float[Tensor, "b v c h w"], action_maps: Float[Tensor, "b v a 1 h w"] | None = None
    ) -> None:
        """Begin a rollout at observed latents, with the controls of that frame; forgets any rollout before it."""
        self.cache = KVCache(self.cache.sink_blocks, self.cache.recent_blocks)
        self._unwritten = (rearrange(first_latents.float(), "b v c h w -> b v c 1 h w"), action_maps)

    @torch.no_grad()
    def step(self, action_maps: Float[Tensor, "b v a t h w"] | None) -> Float[Tensor, "b v c t h w"]:
        """Predict the next block under these controls.

        Raises:
            DataError: the rollout was not started, or the controls are not those of one block.
        """
        if self._unwritten is None:
            raise DataError("The rollout has not been started", next_step="call start() with the observed latents")
        if action_maps is not None and action_maps.shape[3] != self.block_size:
            raise DataError(
                "Controls of one block are needed",
                expected=f"{self.block_size} latent frames",
                got=action_maps.shape[3],
            )
        self._write()
        reference = self.cache.reference
        if reference is None:
            raise DataError("The cache lost its first frame", next_step="call start() again")
        batch, views, channels, _, height, width = reference.shape
        latents = self.noise.draw((views, channels, self.block_size, height, width), reference.device)
        for sigma, next_sigma in zip(self.sigmas[:-1], self.sigmas[1:], strict=True):
            levels = torch.full((batch,), sigma, device=reference.device)
            with torch.autocast(reference.device.type, torch.bfloat16, enabled=self.bfloat16):
                velocity = self.model(
                    latents, levels, action_maps=action_maps, views=self.views, cache=self.cache
                ).velocity
            latents = euler_step(latents, velocity, sigma, next_sigma)
        self._unwritten = (latents, action_maps)
        return latents

    def fork(self) -> BlockCausalSimulator:
        """A simulator in the same state that goes on separately: to try several controls from one moment."""
        other = BlockCausalSimulator(
            self.model,
            noise=self.noise.copy(),
            sigmas=self.sigmas,
            block_size=self.block_size,
            sink_blocks=self.cache.sink_blocks,
            recent_blocks=self.cache.recent_blocks,
            views=self.views,
            bfloat16=self.bfloat16,
        )
        other.cache = self.cache.copy()
        other._unwritten = self._unwritten
        return other

    def _write(self) -> None:
        if self._unwritten is None:
            return
        latents, action_maps = self._unwritten
        levels = torch.zeros(len(latents), device=latents.device)
        with torch.autocast(latents.device.type, torch.bfloat16, enabled=self.bfloat16):
            self.model(latents, levels, action_maps=action_maps, views=self.views, cache=self.cache, write_cache=True)
