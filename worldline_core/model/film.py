"""Native control vectors by FiLM: the alternative to action maps of the paper's ablation.

A vector of joint targets and gripper openings says nothing of where in the picture the robot will be; each layer turns the
vector of a latent frame into one scale and one shift of all tokens of that frame (Perez et al. 2018, "FiLM").
"""

from __future__ import annotations

from typing import cast

import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from worldline_core.model.layers import ActionEncoder
from worldline_core.model.world_model_config import WorldModelConfig

FEATURES = 256
"""Width of the features from which every layer takes its scale and shift."""


class NativeActionFilm(nn.Module):
    """``tokens (1 + scale) + shift`` before every layer, both linear in ``SiLU(linear(vector))``.

    The last linear layers start at zero, so a model that gains this branch computes what it computed before.
    """

    def __init__(self, size: int, hidden_size: int, num_layers: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(size, FEATURES)
        self.proj = nn.ModuleList([nn.Linear(FEATURES, 2 * hidden_size) for _ in range(num_layers)])
        for parameter in self.proj.parameters():
            nn.init.zeros_(parameter)

    def forward(
        self, tokens: Float[Tensor, "b n d"], vectors: Float[Tensor, "b v size t 1 1"], layer: int
    ) -> Float[Tensor, "b n d"]:
        """Tokens in order ``(t v h w)``, modulated for ``layer``; the vectors of all views are the same."""
        features = F.silu(self.hidden(rearrange(vectors[:, 0], "b c t 1 1 -> b t c").to(self.hidden.weight.dtype)))
        scale, shift = cast("Tensor", self.proj[layer](features)).to(tokens.dtype).chunk(2, dim=-1)
        frames = rearrange(tokens, "b (t n) d -> b t n d", t=vectors.shape[3])
        return rearrange(frames * (1 + scale[:, :, None]) + shift[:, :, None], "b t n d -> b (t n) d")


def new_action_branch(config: WorldModelConfig) -> ActionEncoder | NativeActionFilm:
    """The branch through which controls reach a model of this configuration; it starts without effect."""
    if config.action_conditioning == "native_film":
        return NativeActionFilm(config.action_channels, config.hidden_size, config.num_layers)
    return ActionEncoder(config)
