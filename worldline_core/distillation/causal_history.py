"""The causal history of one rollout during distillation: clean blocks in a key/value cache, one block at a time.

Teacher trajectories and the student's own rollouts use the passes of inference: a block in progress attends to the
cached clean blocks; a finished block enters the cache in the conditioned-frame form.

Axes: b clips, v views, c latent channels, t latent frames of one block, h and w rows and columns.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from worldline_core.config.base import StrictModel
from worldline_core.model.kv_cache import KVCache
from worldline_core.model.world_model import WorldModel


class CacheWindow(StrictModel):
    """Blocks that stay visible: the first ones and the most recent ones (one and three in the paper)."""

    sink_blocks: int = Field(default=1, ge=1)
    recent_blocks: int = Field(default=3, ge=0)


class CausalHistory:
    """Velocity of the block in progress given the finished ones.

    Args:
        model: a block-causal model.
        views: names of the views of every block.
        window: how many finished blocks stay visible.
    """

    def __init__(self, model: WorldModel, views: Sequence[str], window: CacheWindow) -> None:
        self.model = model
        self.views = tuple(views)
        self.cache = KVCache(window.sink_blocks, window.recent_blocks)

    def velocity(
        self,
        state: Float[Tensor, "b v c t h w"],
        sigma: float,
        action_maps: Float[Tensor, "b v a t h w"],
    ) -> Float[Tensor, "b v c t h w"]:
        """Velocity at noise level `sigma` of the block that follows the history, in float32."""
        levels = torch.full((len(state),), sigma, device=state.device)
        output = self.model(state, levels, action_maps=action_maps, views=self.views, cache=self.cache)
        return output.velocity.float()

    def remember(
        self,
        clean: Float[Tensor, "b v c t h w"],
        action_maps: Float[Tensor, "b v a t h w"],
    ) -> None:
        """Take a finished block into the history; no gradient flows through it."""
        levels = torch.zeros(len(clean), device=clean.device)
        with torch.no_grad():
            self.model(
                clean.detach(), levels, action_maps=action_maps, views=self.views, cache=self.cache, write_cache=True
            )
