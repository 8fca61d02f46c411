"""Tokenizers: layout, causality, projection, the reference frame, files."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from worldline_core.errors import CheckpointError, DataError, UnavailableError
from worldline_core.model.tokenizers import (
    WAN22_MEAN,
    WAN22_STD,
    PatchTokenizer,
    VideoTokenizer,
    WanTokenizer,
    fit_patch_tokenizer,
    frames_to_video,
    load_tokenizer,
    tokenizer_fingerprint,
    video_to_frames,
)
from worldline_core.rehearsal.outside_models import small_wan_autoencoder
from worldline_core.training.clip_source import LoadedView
from worldline_core.training.train_tokenizer import decoder_batch, disturb, train_decoder
from worldline_core.training.training_config import TokenizerConfig


def scenes(count: int = 6, frames: int = 9, seed: int = 0) -> torch.Tensor:
    """Smooth backgrounds with a moving bright square, ``(b 3 t 32 48)`` in [-1, 1]."""
    generator = torch.Generator().manual_seed(seed)
    background = torch.nn.functional.interpolate(
        torch.rand(count, 3, 5, 7, generator=generator), (32, 48), mode="bilinear"
    )
    video = background[:, :, None].repeat(1, 1, frames, 1, 1)
    for item in range(count):
        x, y = (int(v) for v in torch.randint(0, 20, (2,), generator=generator))
        for frame in range(frames):
            video[item, :, frame, y : y + 8, x + 2 * frame : x + 2 * frame + 8] = torch.tensor([0.9, 0.1, 0.2])[
                :, None, None
            ]
    return video * 2 - 1


def views(seeds: int, count: int = 6) -> list[LoadedView]:
    """Scenes of several seeds as they are held in memory for training."""
    videos = [((v + 1) * 127.5).round().to(torch.uint8) for s in range(seeds) for v in scenes(count, seed=s)]
    return [LoadedView(f"scene-{number}/head", video) for number, video in enumerate(videos)]


@pytest.fixture(scope="module")
def fitted() -> PatchTokenizer:
    torch.manual_seed(0)
    tokenizer = fit_patch_tokenizer(
        [scenes(seed=s) for s in range(4)], channels=24, refinement_width=8, refinement_depth=1
    )
    return tokenizer.eval().requires_grad_(False)


def test_pixels_survive_the_round_trip() -> None:
    frames = np.random.default_rng(0).integers(0, 256, (3, 8, 12, 3), dtype=np.uint8)
    assert np.array_equal(video_to_frames(frames_to_video(frames)), frames)
    assert frames_to_video(frames, (4, 6)).shape == (3, 3, 4, 6)
    halved = video_to_frames(frames_to_video(frames, (4, 6)))
    expected = frames.reshape(3, 4, 2, 6, 2, 3).mean(axis=(2, 4))
    assert np.abs(halved - expected).max() <= 1.0
    with pytest.raises(DataError, match="Not RGB frames"):
        frames_to_video(frames.astype(np.float32))


def test_latents_have_the_contracted_shape_and_about_unit_scale(fitted: PatchTokenizer) -> None:
    latents = fitted.encode(scenes(seed=9))
    assert latents.shape == (6, 24, 3, 4, 6)
    assert 0.3 < float(latents[:, :, 1:].std()) < 3.0
    assert fitted.decode(latents).shape == (6, 3, 9, 32, 48)
    assert isinstance(fitted, VideoTokenizer)


def test_bases_are_orthonormal_and_the_linear_decode_is_a_projection(fitted: PatchTokenizer) -> None:
    for basis in (fitted.static_basis, fitted.motion_basis):
        torch.testing.assert_close(basis @ basis.T, torch.eye(len(basis)), rtol=0, atol=1e-4)
    latents = fitted.encode(scenes(seed=9))
    torch.testing.assert_close(fitted.encode(fitted.decode_linear(latents)), latents, rtol=1e-3, atol=1e-3)


def test_all_components_reconstruct_exactly() -> None:
    clips = [torch.rand(64, 3, 5, 8, 8, generator=torch.Generator().manual_seed(s)) * 2 - 1 for s in range(40)]
    full = fit_patch_tokenizer(clips, channels=192 * 4, refinement_width=4, refinement_depth=1)
    assert full.config.static_channels == 192
    video = clips[0][:4]
    torch.testing.assert_close(full.decode_linear(full.encode(video)), video, rtol=0, atol=2e-3)


def test_a_still_group_is_coded_like_its_first_frame(fitted: PatchTokenizer) -> None:
    still = scenes(seed=9)[:, :, :1].repeat(1, 1, 9, 1, 1)
    latents = fitted.encode(still)
    torch.testing.assert_close(latents, latents[:, :, :1].expand_as(latents), rtol=1e-4, atol=1e-4)
    assert float(latents[:, fitted.config.static_channels :].abs().max()) < 1e-4


def test_encoding_and_decoding_are_causal(fitted: PatchTokenizer) -> None:
    video = scenes(seed=9)
    changed = video.clone()
    changed[:, :, 5:] = -changed[:, :, 5:]
    before, after = fitted.encode(video), fitted.encode(changed)
    assert torch.equal(before[:, :, :2], after[:, :, :2])
    assert not torch.equal(before[:, :, 2], after[:, :, 2])
    assert torch.equal(fitted.decode(before)[:, :, :5], fitted.decode(after)[:, :, :5])


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_short_training_improves_on_the_linear_decode_by_using_the_reference(tmp_path: Path) -> None:
    videos = views(2)
    tokenizer = fit_patch_tokenizer([scenes()], channels=8, refinement_width=8, refinement_depth=1)
    config = TokenizerConfig(
        steps=25, batch_size=2, clip_frames=9, warmup_steps=2, bfloat16=False, average_decay=0.8, learning_rate=1e-2
    )
    train_decoder(tokenizer, videos, config, tmp_path)
    held_out = scenes(seed=11)
    latents = tokenizer.encode(held_out)
    with_reference, without, linear = [
        float((decoded - held_out).abs().mean())
        for decoded in (
            tokenizer.decode(latents, held_out[:, :, 0]),
            tokenizer.decode(latents),
            tokenizer.decode_linear(latents),
        )
    ]
    assert with_reference < 0.9 * without
    assert with_reference < 0.9 * linear
    with pytest.raises(DataError, match="reference frame does not fit"):
        tokenizer.decode(latents, held_out[:, :, 0, :16])


def test_interrupted_training_ends_with_the_same_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    videos = views(1, count=3)
    config = TokenizerConfig(steps=5, batch_size=1, clip_frames=9, checkpoint_every=2)

    def fresh() -> PatchTokenizer:
        torch.manual_seed(1)
        return fit_patch_tokenizer([scenes(count=3)], channels=8, refinement_width=4, refinement_depth=1)

    whole = fresh()
    train_decoder(whole, videos, config, tmp_path / "whole")

    def failing(tokenizer: PatchTokenizer, views: list[LoadedView], config: TokenizerConfig, step: int) -> Any:
        if step == 3:
            raise KeyboardInterrupt("stopped at step 3")
        return decoder_batch(tokenizer, views, config, step)

    with monkeypatch.context() as patch:
        patch.setattr("worldline_core.training.train_tokenizer.decoder_batch", failing)
        with pytest.raises(KeyboardInterrupt, match="stopped at step 3"):
            train_decoder(fresh(), videos, config, tmp_path / "cut")
    resumed = fresh()
    train_decoder(resumed, videos, config, tmp_path / "cut")
    for key, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[key]), key


def test_batches_depend_on_the_step_alone_and_disturbance_spares_the_first_frame(fitted: PatchTokenizer) -> None:
    videos = views(1)
    config = TokenizerConfig(batch_size=2, clip_frames=9)
    one, again, other = (decoder_batch(fitted, videos, config, step) for step in (7, 7, 8))
    assert one.names == again.names
    assert torch.equal(one.video, again.video)
    assert torch.equal(one.given, again.given)
    assert not torch.equal(one.video, other.video)
    latents = fitted.encode(scenes())
    disturbed = disturb(latents, 0.3, torch.Generator().manual_seed(0))
    assert torch.equal(disturbed[:, :, 0], latents[:, :, 0])
    assert float((disturbed - latents).abs().max()) > 0.05
    assert torch.equal(disturb(latents, 0.0, torch.Generator().manual_seed(0)), latents)


def test_tokenizer_files_round_trip_and_are_read_strictly(fitted: PatchTokenizer, tmp_path: Path) -> None:
    fitted.save(tmp_path / "a", {"seed": 0})
    fitted.save(tmp_path / "b", {"seed": 0})
    for name in ("tokenizer.json", "tokenizer.safetensors"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    loaded = load_tokenizer(tmp_path / "a")
    video = scenes(seed=9)
    assert torch.equal(loaded.encode(video), fitted.encode(video))
    assert isinstance(loaded, PatchTokenizer)
    assert loaded.encoder_digest == fitted.encoder_digest
    loaded.refinement.leave.weight.data += 1.0
    assert loaded.encoder_digest == fitted.encoder_digest
    loaded.scale *= 2.0
    assert loaded.encoder_digest != fitted.encoder_digest
    weights = tmp_path / "b" / "tokenizer.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match="not those that are described"):
        load_tokenizer(tmp_path / "b")
    description = json.loads((tmp_path / "a" / "tokenizer.json").read_text())
    (tmp_path / "a" / "tokenizer.json").write_text(json.dumps(description | {"kind": "other"}))
    with pytest.raises(CheckpointError, match="Unknown kind of tokenizer"):
        load_tokenizer(tmp_path / "a")
    description["config"]["static_channels"] += 1
    (tmp_path / "a" / "tokenizer.json").write_text(json.dumps(description))
    with pytest.raises(CheckpointError, match="wrong shape"):
        load_tokenizer(tmp_path / "a")
    with pytest.raises(CheckpointError, match="No tokenizer here"):
        load_tokenizer(tmp_path)


def test_videos_and_latents_of_another_layout_are_refused(fitted: PatchTokenizer) -> None:
    with pytest.raises(DataError, match="cannot code a video of this shape"):
        fitted.encode(scenes(frames=8))
    with pytest.raises(DataError, match="Not latents of this tokenizer"):
        fitted.decode(torch.zeros(1, 5, 2, 4, 6))


@pytest.fixture(scope="module")
def wan_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("wan")
    small_wan_autoencoder().save_pretrained(folder / "vae")
    return folder


@torch.no_grad()
def test_wan_latents_are_the_normalised_mode(wan_folder: Path) -> None:
    tokenizer = load_tokenizer(wan_folder)
    assert isinstance(tokenizer, WanTokenizer)
    assert isinstance(tokenizer, VideoTokenizer)
    video = scenes(count=1, frames=5)
    latents = tokenizer.encode(video)
    assert latents.shape == (1, 48, 2, 2, 3)
    mode = tokenizer.vae.encode(video, return_dict=False)[0].mode()
    expected = (mode[0, 5] - WAN22_MEAN[5]) / WAN22_STD[5]
    torch.testing.assert_close(latents[0, 5], expected)
    assert tokenizer.decode(latents, video[:, :, 0]).shape == video.shape
    torch.testing.assert_close(
        tokenizer.decode(latents), tokenizer.vae.decode(mode, return_dict=False)[0], rtol=1e-4, atol=1e-4
    )


@torch.no_grad()
def test_latents_are_decoded_as_they_arrive(fitted: PatchTokenizer, wan_folder: Path) -> None:
    """In pieces of 1, 1 and 2 latent frames: the frames of the whole clip's decoding, also after another clip."""
    for tokenizer, exact in ((fitted, True), (load_tokenizer(wan_folder), False)):
        video = scenes(count=2, frames=13)
        latents = tokenizer.encode(video)
        whole = tokenizer.decode(latents, video[:, :, 0])
        for _ in range(2):
            decode = tokenizer.decoder(video[:, :, 0])
            pieces = [decode(piece) for piece in latents.split([1, 1, 2], dim=2)]
            assert [piece.shape[2] for piece in pieces] == [1, 4, 8]
            found = torch.cat(pieces, dim=2)
            torch.testing.assert_close(found, whole, rtol=0, atol=1e-6 if exact else 1e-4)


@torch.no_grad()
def test_a_wan_autoencoder_works_in_bfloat16(wan_folder: Path) -> None:
    half, single = load_tokenizer(wan_folder, dtype=torch.bfloat16), load_tokenizer(wan_folder)
    video = scenes(count=1, frames=9)
    latents = single.encode(video)
    assert torch.nn.functional.cosine_similarity(half.encode(video).flatten(), latents.flatten(), dim=0) > 0.999
    decode, expected = half.decoder(), single.decode(latents)
    found = torch.cat([decode(latents[:, :, :1]), decode(latents[:, :, 1:])], dim=2)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, expected, rtol=0, atol=0.05)


def test_the_fingerprint_of_a_pipeline_is_its_autoencoders(wan_folder: Path, tmp_path: Path) -> None:
    """A backbone of 30 GB beside it is neither read nor part of the name."""
    shutil.copytree(wan_folder / "vae", tmp_path / "vae")
    tokenizer = load_tokenizer(tmp_path)
    alone = tokenizer_fingerprint(tokenizer, tmp_path / "vae")
    (tmp_path / "transformer").mkdir()
    (tmp_path / "transformer" / "diffusion_pytorch_model.safetensors").write_bytes(b"other")
    assert tokenizer_fingerprint(tokenizer, tmp_path) == alone
    path = tmp_path / "vae" / "diffusion_pytorch_model.safetensors"
    path.write_bytes(path.read_bytes() + b" ")
    assert tokenizer_fingerprint(tokenizer, tmp_path) != alone


def test_a_missing_or_damaged_wan_folder_is_named(wan_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UnavailableError, match="Wan autoencoder is not here"):
        WanTokenizer.load(tmp_path)
    config = json.loads((wan_folder / "vae" / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match="cannot be read"):
        WanTokenizer.load(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps(config | {"_class_name": "AutoencoderKL"}))
    with pytest.raises(CheckpointError, match="Not a Wan autoencoder"):
        WanTokenizer.load(tmp_path)
    (tmp_path / "config.json").write_text("[]")
    with pytest.raises(CheckpointError, match="not a JSON object"):
        WanTokenizer.load(tmp_path)
