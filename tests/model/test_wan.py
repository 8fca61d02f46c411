"""Wan's network: diffusers' weights load and give the same velocity; clean frames, text, and the whole way to a simulator."""

import inspect
import json
from types import SimpleNamespace

import pytest
import torch
from tokenizers import Tokenizer, models, pre_tokenizers, processors

from worldline_core.errors import CheckpointError, ConfigError, UnavailableError
from worldline_core.model.backbone import TEXTS, import_backbone
from worldline_core.model.block_causal_attention import KVCache
from worldline_core.model.checkpoint import fill, load_checkpoint
from worldline_core.model.networks import build_world_model
from worldline_core.model.text import load_text_encoder
from worldline_core.model.wan_weights import config_from_diffusers, read_wan
from worldline_core.model.world_model_config import ImportBackboneConfig, MixtureConfig, TextConfig, wan_config

SHAPE = {
    "num_attention_heads": 2, "attention_head_dim": 16, "in_channels": 6, "out_channels": 6, "text_dim": 10, "ffn_dim": 40,
    "num_layers": 3,
}  # fmt: skip
LENGTH = 7
"""Tokens of a text, padding included."""


def transformer_class():
    """Diffusers' network, whose import takes seconds: only where a test runs it."""
    from diffusers.models.transformers.transformer_wan import WanTransformer3DModel

    return WanTransformer3DModel


def random_transformer(seed=3):
    torch.manual_seed(seed)
    model = transformer_class()(**SHAPE)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.normal_(0.0, 0.2)
    return model.eval()


def load_wan(folder, **options):
    found, texts = read_wan(folder, changes={"text_length": LENGTH}, **options)
    fill(found.model, found.tensors, where=folder, dtype=torch.float32)
    return found.model, texts


def write_text_encoder(folder):
    """umT5 at small size and a tokenizer of words, as a pipeline has them."""
    from transformers import PreTrainedTokenizerFast, UMT5Config, UMT5EncoderModel

    words = {word: number for number, word in enumerate(("<pad>", "</s>", "<unk>", "lift", "the", "cup"))}
    tokenizer = Tokenizer(models.WordLevel(words, unk_token="<unk>"))  # noqa: S106 - a token of text
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.post_processor = processors.TemplateProcessing(single="$A </s>", special_tokens=[("</s>", 1)])
    special = {"pad_token": "<pad>", "eos_token": "</s>", "unk_token": "<unk>"}
    PreTrainedTokenizerFast(tokenizer_object=tokenizer, **special).save_pretrained(folder / "tokenizer")
    torch.manual_seed(0)
    shape = {"vocab_size": 6, "d_model": 10, "d_kv": 4, "d_ff": 12, "num_layers": 2, "num_heads": 2}
    UMT5EncoderModel(UMT5Config(**shape)).bfloat16().save_pretrained(folder / "text_encoder")


@pytest.mark.parametrize(("seed", "own_prompt"), [(3, False), (4, True)])
def test_diffusers_weights_give_the_same_velocity_and_gradients(seed, own_prompt, tmp_path):
    """Every token has its time as TI2V's pipeline gives it: 0 in the first latent frame."""
    theirs = random_transformer(seed)
    theirs.save_pretrained(tmp_path / "transformer", max_shard_size="40KB")
    assert len(list((tmp_path / "transformer").glob("*.safetensors"))) > 1
    model, _ = load_wan(tmp_path)
    generator = torch.Generator().manual_seed(seed)
    latents = torch.randn(2, 6, 4, 4, 6, generator=generator)
    texts = torch.randn(2, 4, 10, generator=generator)
    if own_prompt:
        model.prompt, texts = texts[0], texts[:1].expand(2, -1, -1)
    for sigma in (torch.tensor([0.9, 0.3]), torch.tensor([1.0, 0.02])):
        theirs.zero_grad()
        model.zero_grad()
        times = torch.cat((torch.zeros(2, 6), (sigma * 1000)[:, None].expand(2, 18)), dim=1)
        padded = torch.nn.functional.pad(texts, (0, 0, 0, LENGTH - 4))
        expected = theirs(latents, times, padded).sample[:, :, 1:]
        text = None if own_prompt else model.encode_text(texts)
        ours = model(latents[:, None], sigma, text=text, views=("head",)).velocity[:, 0, :, 1:]
        torch.testing.assert_close(ours, expected, rtol=1e-5, atol=1e-5)
        assert expected.abs().mean() > 0.1
        expected.square().mean().backward()
        ours.square().mean().backward()
        found = dict(model.named_parameters())
        for name, weight in theirs.named_parameters():
            for old, new in (("condition_embedder.", ""), ("blocks.", "layers."), ("to_out.0", "to_out"),
                             ("net.0.proj", "0"), ("net.2", "2"), ("patch_embedding", "proj_in")):  # fmt: skip
                name = name.replace(old, new)
            gradient = weight.grad.squeeze(2).permute(0, 2, 3, 1).flatten(1) if weight.ndim == 5 else weight.grad
            atol = 1e-5 * float(gradient.abs().max())
            torch.testing.assert_close(found[name].grad, gradient, rtol=1e-4, atol=atol, msg=name)


@torch.no_grad()
def test_views_in_slots_without_gaps_are_one_tall_picture(tmp_path):
    theirs = random_transformer()
    theirs.save_pretrained(tmp_path)
    slots = {"view_offsets": (0.0, 64.0, 128.0), "text_length": LENGTH}  # pixels; a view has two rows of patches of 32
    found, _ = read_wan(tmp_path, changes=slots)
    fill(found.model, found.tensors, where=tmp_path, dtype=torch.float32)
    latents, text = (
        torch.randn(1, 3, 6, 4, 4, 6, generator=torch.Generator().manual_seed(1)),
        torch.zeros(1, LENGTH, 10),
    )
    times = torch.cat((torch.zeros(1, 18), torch.full((1, 54), 700.0)), dim=1)
    tall = theirs(latents.permute(0, 2, 3, 1, 4, 5).flatten(3, 4), times, text).sample
    ours = found.model(latents, torch.tensor([0.7])).velocity
    torch.testing.assert_close(
        ours.permute(0, 2, 3, 1, 4, 5).flatten(3, 4)[:, :, 1:], tall[:, :, 1:], rtol=1e-5, atol=1e-5
    )


@torch.no_grad()
def test_text_is_read_from_stored_embeddings_and_the_first_prompt_where_there_is_none(tmp_path, monkeypatch):
    from diffusers.pipelines.wan import pipeline_wan_i2v
    from transformers import PreTrainedTokenizerFast, UMT5EncoderModel

    random_transformer().save_pretrained(tmp_path / "wan" / "transformer")
    write_text_encoder(tmp_path / "wan")
    prompts = ("", "lift the  cup", "lift")
    settings = ImportBackboneConfig(size="wan2.2-ti2v-5b", prompts=prompts, changes={"text_length": LENGTH})
    import_backbone(settings, {"diffusers": tmp_path / "wan"}, tmp_path / "base")
    model, _ = load_checkpoint(tmp_path / "base", expect_kind="base", towers="both")
    encoder = UMT5EncoderModel.from_pretrained(tmp_path / "wan" / "text_encoder", dtype=torch.bfloat16)
    pipeline = SimpleNamespace(
        tokenizer=PreTrainedTokenizerFast.from_pretrained(tmp_path / "wan" / "tokenizer"), text_encoder=encoder,
        _execution_device=torch.device("cpu"),
    )  # fmt: skip
    # Its own also repairs broken characters, by a package that is not needed for texts without any.
    monkeypatch.setattr(pipeline_wan_i2v, "prompt_clean", pipeline_wan_i2v.whitespace_clean)
    embed = pipeline_wan_i2v.WanImageToVideoPipeline._get_t5_prompt_embeds
    expected = embed(pipeline, list(prompts), max_sequence_length=LENGTH).float()
    text = TextConfig(kind="stored", path=str(tmp_path / "base" / TEXTS))
    ids, mask = load_text_encoder(text, model.config)(prompts, [])
    torch.testing.assert_close(ids, expected[:, : ids.shape[1]], rtol=0.02, atol=0.02)
    assert mask.sum(dim=1).tolist() == [1, 4, 2]
    latents, sigma = torch.randn(3, 1, 6, 3, 4, 6), torch.full((3,), 0.5)
    read = model(latents, sigma, text=model.encode_text(ids, mask), views=("head",)).velocity
    own = model(latents, sigma, views=("head",)).velocity
    torch.testing.assert_close(own[0], read[0])
    assert not torch.allclose(own[1], read[1])
    for config, shape, message in (
        (text, model.config, "No embedding of this text"),
        (TextConfig(), model.config, "(?s)takes text otherwise.*expected: stored"),
        (text, MixtureConfig(), "(?s)takes text otherwise.*got: stored"),
    ):
        with pytest.raises(ConfigError, match=message):
            load_text_encoder(config, shape)(["push"], [])


PUBLISHED = {
    "attention_head_dim": 128, "ffn_dim": 14336, "in_channels": 48, "num_attention_heads": 24, "num_layers": 30,
    "out_channels": 48,
}  # fmt: skip
"""Fields of the published transformer/config.json that are not the class's defaults."""


def test_the_published_config_is_the_full_size():
    parameters = inspect.signature(transformer_class().__init__).parameters.values()
    defaults = {p.name: p.default for p in parameters if p.name != "self"}
    raw = json.loads(json.dumps(defaults | PUBLISHED | {"_class_name": "WanTransformer3DModel"}))
    assert config_from_diffusers(raw, where="published") == wan_config()
    with torch.device("meta"):
        assert sum(p.numel() for p in build_world_model(wan_config()).parameters()) == pytest.approx(5.0e9, rel=0.01)


def change(**fields):
    def write(folder):
        path = folder / "transformer" / "config.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | fields))

    return write


@pytest.mark.parametrize(
    ("damage", "options", "error", "message"),
    [
        (change(_class_name="Cosmos3OmniTransformer"), {}, CheckpointError, r"(?s)Not a Wan.*Cosmos3OmniTransformer"),
        (change(added_kv_proj_dim=8), {}, CheckpointError, "(?s)Not a Wan.*added_kv_proj_dim"),
        (change(in_channels=12), {}, CheckpointError, "(?s)Not a Wan.*out_channels"),
        (change(num_layers=2), {}, CheckpointError, r"unexpected: layers\.2"),
        (change(num_layers="many"), {}, CheckpointError, "config is not valid"),
        (lambda folder: None, {"prompts": ("",)}, UnavailableError, "text encoder is not here"),
    ],
)
def test_a_folder_that_is_not_whole_or_of_another_network_is_refused(damage, options, error, message, tmp_path):
    random_transformer().save_pretrained(tmp_path / "transformer", max_shard_size="40KB")
    damage(tmp_path)
    with pytest.raises(error, match=message):
        load_wan(tmp_path, **options)


@torch.no_grad()
@pytest.mark.parametrize("network", ["mixture", "wan"])
def test_in_one_layer_a_block_after_the_observed_frame_is_the_whole_clip(make_model, network):
    """With one layer the observed frame's keys do not depend on what it sees, so both masks say the same."""
    model = make_model(num_layers=1, network=network)
    generator = torch.Generator().manual_seed(1)
    latents, maps = (
        torch.randn(2, 3, 4, 5, 4, 4, generator=generator),
        torch.randn(2, 3, 9, 5, 4, 4, generator=generator),
    )
    sigma, cache = torch.tensor([0.3, 0.9]), KVCache(1, 3)
    model.write_block(latents[:, :, :, :1], cache, action_maps=maps[:, :, :, :1])
    block = model.forward_block(latents[:, :, :, 1:], sigma, cache, action_maps=maps[:, :, :, 1:])
    whole = model(latents, sigma, action_maps=maps).velocity
    torch.testing.assert_close(block, whole[:, :, :, 1:], rtol=1e-5, atol=1e-5)
