"""Tokenizers and small decoders for them: layout, causality, projection, the reference frame, training, files."""

import json
import shutil

import numpy as np
import pytest
import torch

from worldline_core.errors import CheckpointError, ConfigError, DataError, UnavailableError
from worldline_core.model import tokenizers
from worldline_core.model.small_decoder import SmallDecoder, SmallDecoderConfig
from worldline_core.rehearsal.outside_models import small_wan_autoencoder
from worldline_core.training.train_tokenizer import decoder_batch, disturb, train_decoder
from worldline_core.training.training_config import TokenizerConfig


def scenes(count=6, frames=9, seed=0):
    """Smooth backgrounds with a moving bright square, ``(b 3 t 32 48)`` in [-1, 1]."""
    generator, colour = torch.Generator().manual_seed(seed), torch.tensor([0.9, 0.1, 0.2])[:, None, None]
    coarse = torch.rand(count, 3, 5, 7, generator=generator)
    background = torch.nn.functional.interpolate(coarse, (32, 48), mode="bilinear")
    video = background[:, :, None].repeat(1, 1, frames, 1, 1)
    for item in range(count):
        x, y = (int(v) for v in torch.randint(0, 20, (2,), generator=generator))
        for frame in range(frames):
            video[item, :, frame, y : y + 8, x + 2 * frame : x + 2 * frame + 8] = colour
    return video * 2 - 1


def views(seeds, count=6):
    """Scenes of several seeds as they are held in memory for training."""
    videos = [((v + 1) * 127.5).round().to(torch.uint8) for s in range(seeds) for v in scenes(count, seed=s)]
    return [(f"scene-{number}/head", video) for number, video in enumerate(videos)]


@pytest.fixture(scope="module")
def fitted():
    torch.manual_seed(0)
    clips = [scenes(seed=s) for s in range(4)]
    tokenizer = tokenizers.fit_patch_tokenizer(clips, channels=24, refinement_width=8, refinement_depth=1)
    return tokenizer.eval().requires_grad_(False)


def test_pixels_survive_the_round_trip():
    frames = np.random.default_rng(0).integers(0, 256, (3, 8, 12, 3), dtype=np.uint8)
    assert np.array_equal(tokenizers.video_to_frames(tokenizers.frames_to_video(frames)), frames)
    halved = tokenizers.video_to_frames(tokenizers.frames_to_video(frames, (4, 6)))
    expected = frames.reshape(3, 4, 2, 6, 2, 3).mean(axis=(2, 4))
    assert np.abs(halved - expected).max() <= 1.0
    with pytest.raises(DataError, match="Not RGB frames"):
        tokenizers.frames_to_video(frames.astype(np.float32))


def test_latents_have_the_contracted_shape_and_about_unit_scale(fitted):
    latents = fitted.encode(scenes(seed=9))
    assert isinstance(fitted, tokenizers.VideoTokenizer)
    assert (latents.shape, fitted.decode(latents).shape) == ((6, 24, 3, 4, 6), (6, 3, 9, 32, 48))
    assert 0.3 < float(latents[:, :, 1:].std()) < 3.0
    for basis in (fitted.static_basis, fitted.motion_basis):
        torch.testing.assert_close(basis @ basis.T, torch.eye(len(basis)), rtol=0, atol=1e-4)
    # The linear decode is a projection.
    torch.testing.assert_close(fitted.encode(fitted.decode_linear(latents)), latents, rtol=1e-3, atol=1e-3)


def test_all_components_reconstruct_exactly():
    clips = [torch.rand(64, 3, 5, 8, 8, generator=torch.Generator().manual_seed(s)) * 2 - 1 for s in range(40)]
    full = tokenizers.fit_patch_tokenizer(clips, channels=192 * 4, refinement_width=4, refinement_depth=1)
    assert full.config.static_channels == 192
    video = clips[0][:4]
    torch.testing.assert_close(full.decode_linear(full.encode(video)), video, rtol=0, atol=2e-3)


def test_a_still_group_is_coded_like_its_first_frame(fitted):
    still = scenes(seed=9)[:, :, :1].repeat(1, 1, 9, 1, 1)
    latents = fitted.encode(still)
    torch.testing.assert_close(latents, latents[:, :, :1].expand_as(latents), rtol=1e-4, atol=1e-4)
    assert float(latents[:, fitted.config.static_channels :].abs().max()) < 1e-4


def test_encoding_and_decoding_are_causal(fitted):
    video = scenes(seed=9)
    changed = video.clone()
    changed[:, :, 5:] = -changed[:, :, 5:]
    before, after = fitted.encode(video), fitted.encode(changed)
    assert torch.equal(before[:, :, :2], after[:, :, :2])
    assert not torch.equal(before[:, :, 2], after[:, :, 2])
    assert torch.equal(fitted.decode(before)[:, :, :5], fitted.decode(after)[:, :, :5])


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_short_training_improves_on_the_linear_decode_by_using_the_reference(tmp_path):
    videos = views(2)
    tokenizer = tokenizers.fit_patch_tokenizer([scenes()], channels=8, refinement_width=8, refinement_depth=1)
    config = TokenizerConfig(
        steps=25, batch_size=2, clip_frames=9, warmup_steps=2, bfloat16=False, average_decay=0.8, learning_rate=1e-2
    )
    train_decoder(tokenizer.refinement, tokenizer, videos, config, tmp_path)
    held_out = scenes(seed=11)
    latents = tokenizer.encode(held_out)
    decoded = (
        tokenizer.decode(latents, held_out[:, :, 0]),
        tokenizer.decode(latents),
        tokenizer.decode_linear(latents),
    )
    with_reference, without, linear = (float((video - held_out).abs().mean()) for video in decoded)
    assert with_reference < 0.9 * min(without, linear)
    with pytest.raises(DataError, match="reference frame does not fit"):
        tokenizer.decode(latents, held_out[:, :, 0, :16])


def test_batches_depend_on_the_step_alone_and_disturbance_spares_the_first_frame(fitted):
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


def test_tokenizer_files_round_trip_and_are_read_strictly(fitted, tmp_path):
    fitted.save(tmp_path / "a", {"seed": 0})
    fitted.save(tmp_path / "b", {"seed": 0})
    for name in ("tokenizer.json", "tokenizer.safetensors"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    loaded = tokenizers.load_tokenizer(tmp_path / "a")
    video = scenes(seed=9)
    assert torch.equal(loaded.encode(video), fitted.encode(video))
    loaded.refinement.leave.weight.data += 1.0
    assert loaded.encoder_digest == fitted.encoder_digest
    loaded.scale *= 2.0
    assert loaded.encoder_digest != fitted.encoder_digest
    weights = tmp_path / "b" / "tokenizer.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match="not those that are described"):
        tokenizers.load_tokenizer(tmp_path / "b")
    path = tmp_path / "a" / "tokenizer.json"
    description = json.loads(path.read_text())
    wider = description["config"] | {"static_channels": description["config"]["static_channels"] + 1}
    for change, message in (({"kind": "other"}, "Unknown kind of tokenizer"), ({"config": wider}, "wrong shape")):
        path.write_text(json.dumps(description | change))
        with pytest.raises(CheckpointError, match=message):
            tokenizers.load_tokenizer(tmp_path / "a")
    with pytest.raises(CheckpointError, match="No tokenizer here"):
        tokenizers.load_tokenizer(tmp_path)
    with pytest.raises(DataError, match="cannot code a video of this shape"):
        fitted.encode(scenes(frames=8))
    with pytest.raises(DataError, match="Not latents of this tokenizer"):
        fitted.decode(torch.zeros(1, 5, 2, 4, 6))


@pytest.fixture(scope="module")
def wan_folder(tmp_path_factory):
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("wan")
    small_wan_autoencoder().save_pretrained(folder / "vae")
    return folder


@pytest.fixture(scope="module")
def wan(wan_folder):
    return tokenizers.load_tokenizer(wan_folder)


@torch.no_grad()
def test_wan_latents_are_the_normalised_mode(wan):
    assert isinstance(wan, tokenizers.VideoTokenizer)
    video = scenes(count=1, frames=5)
    latents = wan.encode(video)
    assert latents.shape == (1, 48, 2, 2, 3)
    mode = wan.vae.encode(video, return_dict=False)[0].mode()
    expected = (mode[0, 5] - tokenizers.WAN22_MEAN[5]) / tokenizers.WAN22_STD[5]
    torch.testing.assert_close(latents[0, 5], expected)
    assert wan.decode(latents, video[:, :, 0]).shape == video.shape
    theirs = wan.vae.decode(mode, return_dict=False)[0]
    torch.testing.assert_close(wan.decode(latents), theirs, rtol=1e-4, atol=1e-4)


def test_other_statistics_than_a_wan_autoencoder_has_channels_are_refused():
    vae = small_wan_autoencoder()
    vae.register_to_config(latents_mean=[0.0] * 17)
    with pytest.raises(CheckpointError, match=r"statistics[\s\S]*48[\s\S]*17"):
        tokenizers.WanTokenizer(vae)


@torch.no_grad()
def test_latents_are_decoded_as_they_arrive(fitted, wan):
    """In pieces of 1, 1 and 2 latent frames: the frames of the whole clip's decoding, also after another clip."""
    for tokenizer, exact in ((fitted, True), (wan, False)):
        video = scenes(count=2, frames=13)
        latents = tokenizer.encode(video)
        whole = tokenizer.decode(latents, video[:, :, 0])
        for _ in range(2):
            decode = tokenizer.decoder(video[:, :, 0])
            pieces = [decode(piece) for piece in latents.split([1, 1, 2], dim=2)]
            assert [piece.shape[2] for piece in pieces] == [1, 4, 8]
            found = torch.cat(pieces, dim=2)
            known = tokenizer.decoder(video[:, :, 0])
            known.begin(latents[:, :, :1])
            found = torch.stack((found, torch.cat((whole[:, :, :1], known(latents[:, :, 1:])), dim=2)))
            torch.testing.assert_close(found, whole.expand_as(found), rtol=0, atol=1e-6 if exact else 1e-4)


@torch.no_grad()
def test_a_wan_autoencoder_works_in_bfloat16(wan_folder, wan):
    half = tokenizers.load_tokenizer(wan_folder, dtype=torch.bfloat16)
    video = scenes(count=1, frames=9)
    latents = wan.encode(video)
    assert torch.nn.functional.cosine_similarity(half.encode(video).flatten(), latents.flatten(), dim=0) > 0.999
    decode, expected = half.decoder(), wan.decode(latents)
    found = torch.cat([decode(latents[:, :, :1]), decode(latents[:, :, 1:])], dim=2)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, expected, rtol=0, atol=0.05)


def test_the_fingerprint_of_a_pipeline_is_its_autoencoders(wan_folder, tmp_path):
    """A backbone of 30 GB beside it is neither read nor part of the name."""
    shutil.copytree(wan_folder / "vae", tmp_path / "vae")
    tokenizer = tokenizers.load_tokenizer(tmp_path)
    alone = tokenizers.tokenizer_fingerprint(tokenizer, tmp_path / "vae")
    (tmp_path / "transformer").mkdir()
    (tmp_path / "transformer" / "diffusion_pytorch_model.safetensors").write_bytes(b"other")
    assert tokenizers.tokenizer_fingerprint(tokenizer, tmp_path) == alone
    path = tmp_path / "vae" / "diffusion_pytorch_model.safetensors"
    path.write_bytes(path.read_bytes() + b" ")
    assert tokenizers.tokenizer_fingerprint(tokenizer, tmp_path) != alone


def test_a_missing_or_damaged_wan_folder_is_named(wan_folder, tmp_path):
    with pytest.raises(UnavailableError, match="Wan autoencoder is not here"):
        tokenizers.WanTokenizer.load(tmp_path)
    config = json.loads((wan_folder / "vae" / "config.json").read_text())
    for content, message in (
        (config, "cannot be read"), (config | {"_class_name": "AutoencoderKL"}, "Not a Wan autoencoder"),
        ([], "not a JSON object"),
    ):  # fmt: skip
        (tmp_path / "config.json").write_text(json.dumps(content))
        with pytest.raises(CheckpointError, match=message):
            tokenizers.WanTokenizer.load(tmp_path)


CONFIG = TokenizerConfig(
    steps=3, batch_size=1, clip_frames=9, warmup_steps=1, bfloat16=False, average_decay=0.8, checkpoint_every=1
)


def of(tokenizer, width=4, *, trained=True):
    torch.manual_seed(0)
    config = SmallDecoderConfig.of(tokenizer, "0123456789abcdef", width=width, depth=1)
    decoder = SmallDecoder(config, tokenizer).eval().requires_grad_(False)
    if trained:
        torch.nn.init.normal_(decoder.leave.weight, std=0.1)
    return decoder


@pytest.fixture(scope="module")
def patch():
    return tokenizers.fit_patch_tokenizer(
        [scenes()], channels=8, refinement_width=4, refinement_depth=1
    ).requires_grad_(False)


@pytest.mark.slow
@torch.no_grad()
def test_compression_of_an_outline_is_known_without_it(wan_folder, fitted, tmp_path):
    fitted.save(tmp_path)
    for folder in (None, wan_folder, wan_folder / "vae", tmp_path):
        outline = tokenizers.tokenizer_outline(folder)
        assert tokenizers.spatial_compression(folder) == outline.spatial_compression


def test_a_small_decoder_decodes_latents_as_they_arrive(patch, wan):
    """In whatever pieces: the same bits, which no later latent frame changes; a copy goes on separately."""
    for tokenizer in (patch, wan):
        video, decoder = scenes(count=2, frames=13), of(tokenizer)
        assert isinstance(decoder, tokenizers.VideoTokenizer)
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
        begun = decoder.decoder(observed)
        begun.begin(latents[:, :, :1])
        assert torch.equal(begun(latents[:, :, 1:]), whole[:, :, 1:])
        changed = torch.cat((latents[:, :, :2], -latents[:, :, 2:]), dim=2)
        assert torch.equal(decoder.decode(changed, observed)[:, :, :5], whole[:, :, :5])
        assert not torch.equal(decoder.decode(latents)[:, :, 1:], whole[:, :, 1:])
        with pytest.raises(DataError, match="reference frame does not fit"):
            decoder.decode(latents, observed[:, :, :16])
        with pytest.raises(DataError, match="Not latents of this tokenizer"):
            decoder.decode(latents[:, 1:])


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked_shapes")
def test_training_lowers_the_error_and_leaves_the_encoder_as_it_is(patch, wan, tmp_path):
    held_out = scenes(seed=11)
    for tokenizer, steps in ((patch, 40), (wan, 2)):
        before = {name: value.clone() for name, value in tokenizer.state_dict().items()}
        decoder, errors = of(tokenizer, width=8, trained=False), list[float]()

        def measure(decoder=decoder, errors=errors):
            decoded = decoder.decode(decoder.encode(held_out), held_out[:, :, 0])
            errors.append(float((decoded - held_out).abs().mean()))

        measure()
        decoder.fit([scenes(seed=seed) for seed in range(2)])
        measure()
        changes = {"steps": steps, "batch_size": 2, "learning_rate": 1e-2, "checkpoint_every": 500}
        train_decoder(decoder, tokenizer, views(2), CONFIG.model_copy(update=changes), tmp_path / str(steps))
        measure()
        assert errors[2] < errors[1] < errors[0] or tokenizer is wan  # random weights: there is nothing to learn
        for name, value in tokenizer.state_dict().items():
            assert torch.equal(value, before[name]), name
        assert not any(parameter.requires_grad for parameter in [*tokenizer.parameters(), *decoder.parameters()])


def test_a_decoder_of_another_tokenizer_or_a_damaged_one_is_refused(patch, tmp_path):
    decoder, name = of(patch), "0123456789abcdef"
    for folder in ("a", "b"):
        decoder.save(tmp_path / folder, {"seed": 0})
    description, weights = tmp_path / "b" / "decoder.json", tmp_path / "b" / "decoder.safetensors"
    for path in (description, weights):
        assert path.read_bytes() == (tmp_path / "a" / path.name).read_bytes()
    loaded, latents = SmallDecoder.load(tmp_path / "a", patch, name), patch.encode(scenes())
    torch.testing.assert_close(loaded.decode(latents), decoder.decode(latents), rtol=0, atol=0.02)  # float16
    other = tokenizers.PatchTokenizer(tokenizers.PatchTokenizerConfig(static_channels=6, motion_channels=3))
    for tokenizer, fingerprint in ((patch, "fedcba9876543210"), (other, name)):
        with pytest.raises(CheckpointError, match=r"trained for another tokenizer[\s\S]*--input encoder"):
            SmallDecoder.load(tmp_path / "a", tokenizer, fingerprint)
    with pytest.raises(CheckpointError, match="No decoder here"):
        SmallDecoder.load(tmp_path, patch, name)
    weights.write_bytes(weights.read_bytes()[:-1])
    content = json.loads(description.read_text())
    unstated = {key: value for key, value in content.items() if key != "weights_sha256"}
    for changed, message in (
        (content, "not those that are described"), (unstated, "not those that are described"),
        (content | {"config": content["config"] | {"width": 0}}, "not valid"),
    ):  # fmt: skip
        description.write_text(json.dumps(changed))
        with pytest.raises(CheckpointError, match=message):
            SmallDecoder.load(tmp_path / "b", patch, name)


def test_training_begins_at_the_best_linear_decode(patch):
    decoder, video = of(patch, trained=False), scenes(seed=1)
    decoder.fit([video])
    latents = patch.encode(video)
    assert (decoder.decode(latents) - video).square().mean() <= (patch.decode_linear(latents) - video).square().mean()
    with pytest.raises(DataError, match="No clips to fit"):
        decoder.fit([])
    other = tokenizers.PatchTokenizer(tokenizers.PatchTokenizerConfig(spatial_compression=12))
    with pytest.raises(ConfigError, match="compression 4, 8, 16 or 32"):
        SmallDecoderConfig.of(other, "")
