"""Sinusoidal time embedding, added to noisy tokens only."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F  # noqa: N812 - the customary name
from jaxtyping import Float
from torch import Tensor, nn

CHANNELS = 256


def sinusoids(times: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape 256"]:
    """Cosines, then sines, of ``times`` at frequencies 1 down to 1e-4 (geometric), float32."""
    half = CHANNELS // 2
    exponent = -math.log(10000.0) * torch.arange(half, dtype=torch.float32, device=times.device) / half
    angles = times.to(torch.float32).unsqueeze(-1) * exponent.exp()
    return torch.cat((angles.cos(), angles.sin()), dim=-1)


class TimeEmbedder(nn.Module):
    """Two-layer perceptron on the sinusoids; runs in the dtype of its weights, outside autocast (Cosmos3: float32)."""

    def __init__(self, hidden_size: int) -> None:
        super().__init__()
        self.linear_1 = nn.Linear(CHANNELS, hidden_size)
        self.linear_2 = nn.Linear(hidden_size, hidden_size)

    def forward(self, times: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape d"]:
        with torch.autocast(device_type=times.device.type, enabled=False):
            features = sinusoids(times).to(self.linear_1.weight.dtype)
            return self.linear_2(F.silu(self.linear_1(features)))
