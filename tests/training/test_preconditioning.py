from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from worldline_core.errors import ConfigError
from worldline_core.model.block_causal_attention import KVCache
from worldline_core.model.layers import preconditioned_velocity
from worldline_core.model.world_model import WorldModel, WorldModelConfig

STD = 0.75


@pytest.mark.parametrize("sigma", [0.01, 0.3, 0.8, 1.0])
def test_a_silent_head_gives_the_posterior_mean_of_a_gaussian(sigma: float) -> None:
    generator = torch.Generator().manual_seed(0)
    reference = torch.full((200_000,), 0.4, dtype=torch.float64)
    clean = reference + STD * torch.randn(200_000, generator=generator, dtype=torch.float64)
    noisy = (1 - sigma) * clean + sigma * torch.randn(200_000, generator=generator, dtype=torch.float64)
    level = torch.tensor(sigma, dtype=torch.float64)
    guess = noisy - sigma * preconditioned_velocity(torch.zeros_like(noisy), noisy, level, reference, STD)
    error = clean - guess
    # The posterior mean leaves an error that is uncorrelated with the observation and has the posterior's deviation.
    assert (error * (noisy - noisy.mean())).mean().item() == pytest.approx(0.0, abs=3e-3)
    deviation = sigma * STD / ((1 - sigma) ** 2 * STD**2 + sigma**2) ** 0.5
    assert error.std().item() == pytest.approx(deviation, rel=0.02)
    # One unit of the head moves the clean latents by one posterior deviation.
    moved = noisy - sigma * preconditioned_velocity(torch.ones_like(noisy), noisy, level, reference, STD)
    torch.testing.assert_close(moved - guess, torch.full_like(guess, deviation))


def test_the_cached_pass_sees_the_same_first_frame(model_config: Callable[..., WorldModelConfig]) -> None:
    config = model_config(prediction="first_frame_residual", first_frame_std=STD, towers="generation")
    model = WorldModel(config)
    model.initialise(torch.Generator().manual_seed(0))
    latents = torch.randn(1, 3, 4, 3, 4, 4, generator=torch.Generator().manual_seed(1))
    sigma = torch.full((1,), 0.6)
    cache = KVCache(1, 3)
    with pytest.raises(ConfigError, match="holds no first frame"):
        model.forward_block(latents[:, :, :, 1:], sigma, cache)
    model.write_block(latents[:, :, :, :1], cache)
    cached = model.forward_block(latents[:, :, :, 1:], sigma, cache)
    # The head of a fresh model is silent, so what remains is the preconditioning alone.
    whole = model(latents, sigma).velocity[:, :, :, 1:]
    torch.testing.assert_close(cached, whole)
    assert cached.abs().sum() > 0
