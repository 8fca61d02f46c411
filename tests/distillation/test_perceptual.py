"""The perceptual auxiliary: a distance of decoded frames with gradients, and unavailable without its weights."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from einops import repeat

from worldline_core.distillation.auxiliary_losses import PerceptualLoss
from worldline_core.errors import UnavailableError

ALEXNET = {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)}


class NearestTokenizer:
    """Decodes the first three channels of a latent to blocks of constant colour."""

    latent_channels = 4
    spatial_compression = 16
    temporal_compression = 4

    def decode(self, latents: torch.Tensor, reference: torch.Tensor | None = None) -> torch.Tensor:
        frames = torch.cat((latents[:, :3, :1], latents[:, :3, 1:].repeat_interleave(4, dim=2)), dim=2)
        return repeat(frames, "b c t h w -> b c t (h p) (w q)", p=16, q=16).tanh()


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """Files in the layout of the published ones; the values are arbitrary, which is enough to test the loss around them."""
    generator = torch.Generator().manual_seed(0)
    backbone, heads = {}, {}
    for number, (index, (channels, inputs, size)) in enumerate(ALEXNET.items()):
        shape = (channels, inputs, size, size)
        backbone[f"features.{index}.weight"] = torch.randn(shape, generator=generator) * (inputs * size**2) ** -0.5
        backbone[f"features.{index}.bias"] = torch.zeros(channels)
        heads[f"lin{number}.model.1.weight"] = torch.rand(1, channels, 1, 1, generator=generator)
    torch.save(backbone, tmp_path / "alexnet-owt-7be5be79.pth")
    torch.save(heads, tmp_path / "alex.pth")
    return tmp_path


def test_equal_clips_cost_nothing_and_gradients_reach_the_compared_frames(weights: Path) -> None:
    loss = PerceptualLoss(NearestTokenizer(), weights, latent_frames=2)
    target = torch.randn(1, 2, 4, 5, 4, 4, generator=torch.Generator().manual_seed(1))
    assert loss(target, target).item() == 0
    predicted = (target + 0.5).requires_grad_()
    value = loss(predicted, target)
    value.backward()
    assert value.item() > 0
    assert predicted.grad is not None
    assert bool(predicted.grad[:, :, :3, 3:].any())
    assert not bool(predicted.grad[:, :, :, :3].any())
    assert all(parameter.grad is None for parameter in loss.network.parameters())


def test_without_weights_there_is_no_perceptual_loss(tmp_path: Path) -> None:
    with pytest.raises(UnavailableError, match="LPIPS is not available"):
        PerceptualLoss(NearestTokenizer(), tmp_path)
