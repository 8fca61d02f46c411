"""The action branch: how controls reach the model (paper, "Action-Driven World Model").

The method's `ActionEncoder` turns action maps into residuals of the video tokens. The paper's ablation gives native control
vectors to every layer instead, by FiLM (Perez et al. 2018): a vector of joint targets and gripper openings says nothing of
where in the picture the robot will be.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from jaxtyping import Float
from torch import Tensor, nn

from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.errors import DataError
from worldline_core.model.world_model_config import WorldModelConfig


class ActionEncoder(nn.Module):
    """``Conv3D(9 -> 9, 1 x 3 x 3)`` added to its input, 2 x 2 patches, and a zero-initialised linear layer.

    Because the last layer starts at zero, a model that gains this branch computes what it computed before. Maps of
    several control frames (``map_channels``) pass the convolution one by one and meet in the linear layer.
    """

    def __init__(self, config: WorldModelConfig) -> None:
        super().__init__()
        self.frames, self.patch_size = config.action_frames, config.patch_size
        self.conv = nn.Conv3d(config.action_channels, config.action_channels, (1, 3, 3), padding=(0, 1, 1))
        self.proj = nn.Linear(config.map_channels * config.patch_size**2, config.hidden_size)
        nn.init.zeros_(self.proj.weight)
        nn.init.zeros_(self.proj.bias)

    def forward(self, maps: Float[Tensor, "b v c t h w"]) -> Float[Tensor, "b n d"]:
        """Residuals for the video tokens, in order ``(t v h w)``."""
        flat = rearrange(maps, "b v (k c) t h w -> (b v k) c t h w", k=self.frames)
        flat = flat + self.conv(flat)
        patches = rearrange(
            flat,
            "(b v k) c t (h p) (w q) -> b (t v h w) (k p q c)",
            v=maps.shape[1],
            k=self.frames,
            p=self.patch_size,
            q=self.patch_size,
        )
        return self.proj(patches)


FEATURES = 256
"""Width of the features from which every layer takes its scale and shift."""


class NativeActionFilm(nn.Module):
    """``tokens (1 + scale) + shift`` before every layer, both linear in ``SiLU(linear(vector of the latent frame))``.

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


def native_vectors(
    clips: Sequence[EpisodeTracks], views: Sequence[str], size: int
) -> Float[Tensor, "b v {size} t 1 1"]:
    """Control vectors of clips of equal length, padded with zeros to ``size`` and repeated for every view: action maps of
    one cell, for models with FiLM.

    Raises: DataError when a clip has no control vectors, or longer ones.
    """
    rows = []
    for clip in clips:
        if clip.native is None or clip.native.shape[1] > size:
            raise DataError(
                "The model is driven by control vectors that these tracks do not have",
                where=f"episode {clip.episode_id}, embodiment {clip.embodiment}",
                expected=f"up to {size} numbers a frame",
                got=None if clip.native is None else clip.native.shape[1],
                next_step="open the tracks with their episodes, or train with a larger native_size",
            )
        rows.append(np.pad(clip.native, ((0, 0), (0, size - clip.native.shape[1]))))
    return repeat(torch.from_numpy(np.stack(rows)), "b t c -> b v c t 1 1", v=len(views))


def new_action_branch(config: WorldModelConfig) -> ActionEncoder | NativeActionFilm:
    """The branch through which controls reach a model of this configuration; it starts without effect."""
    if config.action_conditioning == "native_film":
        return NativeActionFilm(config.action_channels, config.hidden_size, config.num_layers)
    return ActionEncoder(config)
