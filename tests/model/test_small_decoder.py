"""A small decoder for the latents of a tokenizer: frame by frame as at once, training beside a frozen encoder, files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from tests.model.test_tokenizers import scenes, views  # pyright: ignore[reportMissingImports]
from worldline_core.errors import CheckpointError, ConfigError, DataError
from worldline_core.model.small_decoder import SmallDecoder, SmallDecoderConfig
from worldline_core.model.tokenizers import (
    PatchTokenizer,
    PatchTokenizerConfig,
    VideoTokenizer,
    WanTokenizer,
    fit_patch_tokenizer,
)
from worldline_core.rehearsal.outside_models import small_wan_autoencoder
from worldline_core.training.train_tokenizer import train_small_decoder
from worldline_core.training.training_config import TokenizerConfig

CONFIG = TokenizerConfig(
    steps=3, batch_size=1, clip_frames=9, warmup_steps=1, bfloat16=False, average_decay=0.8, checkpoint_every=1
)


def of(tokenizer: VideoTokenizer, width: int = 4, *, trained: bool = True) -> SmallDecoder:
    torch.manual_seed(0)
    config = SmallDecoderConfig.of(tokenizer, "0123456789abcdef", width=width, depth=1)
    decoder = SmallDecoder(config, tokenizer).eval().requires_grad_(False)
    if trained:
        torch.nn.init.normal_(decoder.leave.weight, std=0.1)
    return decoder


@pytest.fixture(scope="module")
def patch() -> PatchTokenizer:
    return fit_patch_tokenizer([scenes()], channels=8, refinement_width=4, refinement_depth=1).requires_grad_(False)


@pytest.fixture(scope="module")
def wan() -> WanTokenizer:
    torch.manual_seed(0)
    return WanTokenizer(small_wan_autoencoder().requires_grad_(False))


@torch.no_grad()
def test_latents_are_decoded_as_they_arrive(patch: PatchTokenizer, wan: WanTokenizer) -> None:
    """In whatever pieces: the same bits, which no later latent frame changes; a copy goes on separately."""
    for tokenizer in (patch, wan):
        video, decoder = scenes(count=2, frames=13), of(tokenizer)
        assert isinstance(decoder, VideoTokenizer)
        latents, observed = decoder.encode(video), video[:, :, 0]
        assert torch.equal(latents, tokenizer.encode(video))
        whole = decoder.decode(latents, observed)
        assert whole.shape == video.shape
        for pieces in ([1, 1, 2], [3, 1], [2, 2]):
            decode = decoder.decoder(observed)
            first, *rest = latents.split(pieces, dim=2)
            found, other = [decode(first)], decode.copy()
            found += [decode(piece) for piece in rest]
            assert torch.equal(torch.cat(found, dim=2), whole)
            assert torch.equal(other(rest[0]), found[1])
        changed = torch.cat((latents[:, :, :2], -latents[:, :, 2:]), dim=2)
        assert torch.equal(decoder.decode(changed, observed)[:, :, :5], whole[:, :, :5])
        assert not torch.equal(decoder.decode(latents)[:, :, 1:], whole[:, :, 1:])
        with pytest.raises(DataError, match="reference frame does not fit"):
            decoder.decode(latents, observed[:, :, :16])
        with pytest.raises(DataError, match="Not latents of this tokenizer"):
            decoder.decode(latents[:, 1:])


@pytest.mark.usefixtures("unchecked_shapes")
def test_training_lowers_the_error_and_leaves_the_encoder_as_it_is(
    patch: PatchTokenizer, wan: WanTokenizer, tmp_path: Path
) -> None:
    held_out = scenes(seed=11)
    for tokenizer, steps in ((patch, 40), (wan, 2)):
        before = {name: value.clone() for name, value in tokenizer.state_dict().items()}
        decoder, errors = of(tokenizer, width=8, trained=False), list[float]()

        def measure(decoder: SmallDecoder = decoder, errors: list[float] = errors) -> None:
            decoded = decoder.decode(decoder.encode(held_out), held_out[:, :, 0])
            errors.append(float((decoded - held_out).abs().mean()))

        measure()
        decoder.fit([scenes(seed=seed) for seed in range(2)])
        measure()
        changes = {"steps": steps, "batch_size": 2, "learning_rate": 1e-2, "checkpoint_every": 500}
        train_small_decoder(decoder, tokenizer, views(2), CONFIG.model_copy(update=changes), tmp_path / str(steps))
        measure()
        assert errors[2] < errors[1] < errors[0] or tokenizer is wan  # random weights: there is nothing to learn
        for name, value in tokenizer.state_dict().items():
            assert torch.equal(value, before[name]), name
        assert not any(parameter.requires_grad for parameter in [*tokenizer.parameters(), *decoder.parameters()])


def test_a_decoder_of_another_tokenizer_or_a_damaged_one_is_refused(patch: PatchTokenizer, tmp_path: Path) -> None:
    decoder, name = of(patch), "0123456789abcdef"
    for folder in ("a", "b"):
        decoder.save(tmp_path / folder, {"seed": 0})
    description, weights = tmp_path / "b" / "decoder.json", tmp_path / "b" / "decoder.safetensors"
    for path in (description, weights):
        assert path.read_bytes() == (tmp_path / "a" / path.name).read_bytes()
    loaded, latents = SmallDecoder.load(tmp_path / "a", patch, name), patch.encode(scenes())
    torch.testing.assert_close(loaded.decode(latents), decoder.decode(latents), rtol=0, atol=0.02)  # float16
    other = PatchTokenizer(PatchTokenizerConfig(static_channels=6, motion_channels=3))
    for tokenizer, fingerprint in ((patch, "fedcba9876543210"), (other, name)):
        with pytest.raises(CheckpointError, match=r"trained for another tokenizer[\s\S]*--input encoder"):
            SmallDecoder.load(tmp_path / "a", tokenizer, fingerprint)
    with pytest.raises(CheckpointError, match="No decoder here"):
        SmallDecoder.load(tmp_path, patch, name)
    weights.write_bytes(weights.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match="not those that are described"):
        SmallDecoder.load(tmp_path / "b", patch, name)
    content = json.loads(description.read_text())
    del content["weights_sha256"]
    description.write_text(json.dumps(content))
    with pytest.raises(CheckpointError, match="not those that are described"):
        SmallDecoder.load(tmp_path / "b", patch, name)
    content["config"]["width"] = 0
    description.write_text(json.dumps(content))
    with pytest.raises(CheckpointError, match="not valid"):
        SmallDecoder.load(tmp_path / "b", patch, name)


def test_training_begins_at_the_best_linear_decode(patch: PatchTokenizer) -> None:
    decoder, video = of(patch, trained=False), scenes(seed=1)
    decoder.fit([video])
    latents = patch.encode(video)
    assert (decoder.decode(latents) - video).square().mean() <= (patch.decode_linear(latents) - video).square().mean()
    with pytest.raises(DataError, match="No clips to fit"):
        decoder.fit([])


def test_a_compression_that_it_does_not_know_is_refused(patch: PatchTokenizer) -> None:
    other = PatchTokenizer(PatchTokenizerConfig(spatial_compression=12))
    with pytest.raises(ConfigError, match="compression 4, 8, 16 or 32"):
        SmallDecoderConfig.of(other, "")
