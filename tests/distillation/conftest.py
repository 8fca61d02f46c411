"""A very small world model with random weights in every layer, and a clip to go with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch

from worldline_core.model.config import WorldModelConfig
from worldline_core.model.world_model import WorldModel

VIEWS = ("head", "left_wrist", "right_wrist")


@dataclass(frozen=True)
class Clip:
    """Two blocks of two latent frames after the observed one."""

    latents: torch.Tensor
    maps: torch.Tensor
    noise: torch.Tensor
    mask: torch.Tensor
    block_size: int = 2
    views: tuple[str, ...] = VIEWS


@pytest.fixture
def make_model() -> Callable[..., WorldModel]:
    def make(seed: int = 0, **changes: object) -> WorldModel:
        config = WorldModelConfig(
            latent_channels=4,
            hidden_size=24,
            num_layers=2,
            num_heads=2,
            num_kv_heads=1,
            head_dim=12,
            intermediate_size=32,
            rope_sections=(2, 2, 2),
            towers="generation",
            **changes,
        )
        generator = torch.Generator().manual_seed(seed)
        model = WorldModel(config)
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.15)
        return model.eval()

    return make


@pytest.fixture
def clip() -> Clip:
    generator = torch.Generator().manual_seed(1)
    latents, noise = torch.randn(2, 2, 3, 4, 5, 4, 4, generator=generator)
    maps = torch.randn(2, 3, 9, 5, 4, 4, generator=generator)
    mask = (torch.rand(2, 3, 5, 4, 4, generator=generator) > 0.5).float()
    return Clip(latents, maps, noise, mask)
