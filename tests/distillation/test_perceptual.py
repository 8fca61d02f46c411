"""The perceptual auxiliary: a distance of decoded frames with gradients, and unavailable without its weights."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest
import torch
from einops import repeat

from worldline_core.distillation.auxiliary_losses import PerceptualLoss
from worldline_core.distillation.distill import _perceptual
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.errors import ConfigError, UnavailableError
from worldline_core.model.lpips import load_lpips
from worldline_core.model.tokenizers import GroupDecoder, PatchTokenizer, PatchTokenizerConfig, WanTokenizer
from worldline_core.rehearsal.outside_models import small_wan_autoencoder

ALEXNET = {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)}


class NearestTokenizer:
    """Decodes the first three channels of a latent to blocks of constant colour."""

    latent_channels = 4
    spatial_compression = 16
    temporal_compression = 4

    def encode(self, video: torch.Tensor) -> torch.Tensor:
        raise NotImplementedError

    def decode(self, latents: torch.Tensor, reference: torch.Tensor | None = None) -> torch.Tensor:
        frames = torch.cat((latents[:, :3, :1], latents[:, :3, 1:].repeat_interleave(4, dim=2)), dim=2)
        return repeat(frames, "b c t h w -> b c t (h p) (w q)", p=16, q=16).tanh()

    def decoder(self, reference: torch.Tensor | None = None) -> GroupDecoder:
        return GroupDecoder(self.decode, reference)


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
    loss = PerceptualLoss(NearestTokenizer(), load_lpips(weights), latent_frames=2)
    target = torch.randn(1, 2, 4, 5, 4, 4, generator=torch.Generator().manual_seed(1))
    assert loss(target, target).item() == 0
    predicted = (target + 0.5).requires_grad_()
    value = loss(predicted, target)
    value.backward()
    assert value.item() > 0
    assert bool(predicted.grad[:, :, :3, 3:].any())
    assert not bool(predicted.grad[:, :, :, :3].any())
    assert all(parameter.grad is None for parameter in loss.network.parameters())


def test_without_weights_there_is_no_perceptual_loss(tmp_path: Path) -> None:
    with pytest.raises(UnavailableError, match="LPIPS is not available"):
        load_lpips(tmp_path)


def patch_tokenizer() -> PatchTokenizer:
    tokenizer = PatchTokenizer(PatchTokenizerConfig(static_channels=4, motion_channels=2, refinement_width=8))
    tokenizer.static_basis.normal_()
    tokenizer.motion_basis.normal_()
    return tokenizer.requires_grad_(False)


@pytest.mark.parametrize("kind", ["patch", "wan"])
def test_the_end_of_a_clip_is_compared_as_the_whole_decoded_clip_shows_it(weights: Path, kind: str) -> None:
    """Also with an autoencoder whose frames depend on all frames before them."""
    torch.manual_seed(0)
    tokenizer = patch_tokenizer() if kind == "patch" else WanTokenizer(small_wan_autoencoder().requires_grad_(False))
    side, views, frames = (8, 2, 5) if kind == "patch" else (3, 1, 4)  # 64 and 48 pixels
    predicted, target = torch.randn(2, 1, views, tokenizer.latent_channels, frames, side, side).unbind(0)
    network = load_lpips(weights)
    predicted.requires_grad_()

    def decoded(clip: torch.Tensor) -> torch.Tensor:
        video = tokenizer.decode(clip.flatten(0, 1))[:, :, -8:] / 2 + 0.5
        return video.permute(0, 2, 1, 3, 4).flatten(0, 1).clamp(0, 1)

    expected = inspect.unwrap(type(network).forward)(network, decoded(predicted), decoded(target)).mean()
    (wanted,) = torch.autograd.grad(expected, predicted)
    value = PerceptualLoss(tokenizer, network)(predicted, target)
    torch.testing.assert_close(value.detach(), expected.detach())
    (gradient,) = torch.autograd.grad(3 * value, predicted)
    torch.testing.assert_close(gradient[:, :, :, -2:], 3 * wanted[:, :, :, -2:])
    assert not bool(gradient[:, :, :, :-2].any())
    with torch.no_grad():
        torch.testing.assert_close(PerceptualLoss(tokenizer, network)(predicted, target), expected.detach())


def test_decoding_in_bfloat16_costs_little_accuracy(weights: Path) -> None:
    torch.manual_seed(0)
    vae, network = small_wan_autoencoder().requires_grad_(False), load_lpips(weights)
    predicted, target = torch.randn(2, 1, 1, 48, 3, 4, 4).unbind(0)
    found: list[torch.Tensor] = []
    for dtype in (torch.float32, torch.bfloat16):
        leaf = predicted.clone().requires_grad_()
        with torch.autocast("cpu", torch.bfloat16):
            value = PerceptualLoss(WanTokenizer(vae.to(dtype)), network, latent_frames=1)(leaf, target)
        value.backward()
        found += [value.detach(), leaf.grad[:, :, :, -1].flatten()]
    torch.testing.assert_close(found[2], found[0], rtol=0.05, atol=0)
    assert torch.nn.functional.cosine_similarity(found[1], found[3], dim=0) > 0.95


def test_only_the_wan_autoencoder_decodes_in_bfloat16(weights: Path, project_root: Path) -> None:
    config = DistillConfig.model_validate({"lpips_weights": weights, "perceptual": {"bfloat16": True}})
    tokenizer = project_root / "artifacts" / "shipped" / "models" / "tokenizer"
    with pytest.raises(ConfigError, match=r"Only the Wan autoencoder[\s\S]*perceptual.bfloat16[\s\S]*PatchTokenizer"):
        _perceptual(config, tokenizer, "cpu")
