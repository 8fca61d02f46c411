"""Weights of diffusers' Cosmos3 transformer load as they are and give the same velocity."""

import inspect
import json
from functools import partial
from pathlib import Path

import pytest
import torch
from torch.profiler import ProfilerActivity, profile

from tests.model.test_checkpoint import most_bytes
from worldline_core.errors import ArtifactError, CheckpointError, UnavailableError
from worldline_core.model.backbone import import_backbone
from worldline_core.model.checkpoint import fill, load_checkpoint, save_checkpoint
from worldline_core.model.cosmos3 import config_from_diffusers, read_cosmos3, write_cosmos3
from worldline_core.model.networks import build_world_model
from worldline_core.model.world_model_config import ImportBackboneConfig, cosmos3_config


def load_cosmos3(folder, **options):
    found = read_cosmos3(folder, **options)
    fill(found.model, found.tensors, where=folder, dtype=torch.float32)
    return found.model, found


SHAPE = {
    "head_dim": 12, "hidden_size": 24, "intermediate_size": 40, "latent_channel": 6, "num_attention_heads": 4,
    "num_hidden_layers": 3, "num_key_value_heads": 2, "patch_latent_dim": 24, "vocab_size": 32,
    "rope_axes_dim": (2, 2, 2),
}  # fmt: skip


KINDS = {
    "nano": {},
    "edge": {"hidden_act": "relu2", "qk_norm_for_text": False, "use_und_k_norm_for_gen": True, "rms_norm_eps": 1e-5,
             "rope_theta": 1e8},
}  # fmt: skip


def transformer_class():
    """Diffusers' network, whose import takes seconds: only where a test runs it."""
    from diffusers.models.transformers.transformer_cosmos3 import Cosmos3OmniTransformer

    return Cosmos3OmniTransformer


def random_transformer(kind, seed=3):
    torch.manual_seed(seed)
    model = transformer_class()(**SHAPE | KINDS[kind])
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.normal_(0.0, 0.25)
    return model.eval()


@pytest.fixture(scope="module")
def diffusers_model():
    return random_transformer("nano")


def reference_velocity(model, latents, sigma, text_ids, fps):
    """Velocity through diffusers' own packing functions, first frame clean."""
    from diffusers.pipelines.cosmos import pipeline_cosmos3_omni as omni

    _, _, frames, height, width = latents.shape
    rows, columns = height // 2, width // 2
    count, size = len(text_ids), frames * rows * columns
    text, offset = omni.get_3d_mrope_ids_text_tokens(count, 0)
    video, _ = omni.get_3d_mrope_ids_vae_tokens(frames, rows, columns, offset + 15000, fps=fps)
    noisy = torch.arange(1, frames)
    noisy_tokens = torch.arange(count + rows * columns, count + size)
    return model(
        input_ids=torch.tensor(text_ids),
        text_indexes=torch.arange(count),
        position_ids=torch.cat([text.float(), video], dim=1),
        und_len=count,
        sequence_length=count + size,
        vision_tokens=[latents],
        vision_token_shapes=[(frames, rows, columns)],
        vision_sequence_indexes=torch.arange(count, count + size),
        vision_mse_loss_indexes=noisy_tokens,
        vision_timesteps=torch.full((len(noisy_tokens),), sigma * 1000),
        vision_noisy_frame_indexes=[noisy],
    ).sample[0]


@pytest.mark.parametrize("seed", [3, 4])
@pytest.mark.parametrize("kind", list(KINDS))
def test_diffusers_weights_give_the_same_velocity_and_gradients(kind, seed, tmp_path):
    theirs = random_transformer(kind, seed)
    theirs.save_pretrained(tmp_path / "transformer", max_shard_size="40KB")
    assert len(list((tmp_path / "transformer").glob("*.safetensors"))) > 1
    model, report = load_cosmos3(tmp_path, fps=16.0)
    assert report.ignored == ["lm_head.weight"]
    assert report.new == sorted(n for n, _ in model.named_parameters() if n.startswith("action_encoder."))
    latents = torch.randn(1, 6, 4, 4, 6, generator=torch.Generator().manual_seed(seed))
    text = [3, 1, 4, 1, 5, 9, 2]
    for sigma, fps in ((0.9, 16.0), (0.3, 10.0)):
        theirs.zero_grad()
        model.zero_grad()
        expected = reference_velocity(theirs, latents, sigma, text, fps=fps)
        ours = model(
            latents[:, None], torch.tensor([sigma]), text=model.encode_text(torch.tensor([text])), views=("head",),
            fps=torch.tensor([fps]),
        ).velocity[:, 0]  # fmt: skip
        torch.testing.assert_close(ours, expected, rtol=1e-5, atol=1e-5)
        assert expected[:, :, 1:].abs().mean() > 0.1
        expected[:, :, 1:].square().mean().backward()
        ours[:, :, 1:].square().mean().backward()
        gradients = {name: weight.grad for name, weight in theirs.named_parameters() if weight.grad is not None}
        assert len(gradients) > 60 and ("layers.1.self_attn.k_norm_und_for_gen.weight" in gradients) == (kind == "edge")
        for name, gradient in gradients.items():
            weight = model.get_parameter(name)
            # The last layer's text is read by none.
            found = torch.zeros_like(weight) if weight.grad is None else weight.grad
            torch.testing.assert_close(found, gradient, rtol=1e-4, atol=1e-5 * float(gradient.abs().max()), msg=name)


def test_the_import_holds_one_file_of_the_result(tmp_path):
    """No model in float32 beside the weights, and the same bytes whatever was drawn before."""
    shape = SHAPE | {"hidden_size": 256, "intermediate_size": 1024, "num_hidden_layers": 6}
    pretrained = transformer_class()(**shape).to(torch.bfloat16)
    pretrained.save_pretrained(tmp_path / "pretrained")
    config, inputs = ImportBackboneConfig(dtype="bfloat16"), {"diffusers": tmp_path / "pretrained"}
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as recorded:
        counts = import_backbone(config, inputs, tmp_path / "base")
    stored = (tmp_path / "base" / "model.safetensors").read_bytes()
    assert counts["parameters"] == pytest.approx(len(stored) / 2, rel=0.01)
    # The mapped file and its copy in the stored type; a model in float32 would be two more.
    assert most_bytes(recorded) < 2.2 * len(stored)
    torch.rand(3)
    import_backbone(config, inputs, tmp_path / "again")
    assert (tmp_path / "again" / "model.safetensors").read_bytes() == stored
    theirs, ours = dict(pretrained.named_parameters()), load_checkpoint(tmp_path / "base", dtype=torch.bfloat16)[0]
    same = {name for name, weight in ours.named_parameters() if name in theirs}
    assert len(same) > 80
    assert all(torch.equal(ours.get_parameter(name), theirs[name].to(ours.get_parameter(name))) for name in same)


@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.parametrize("towers", ["both", "generation"])
@torch.no_grad()
def test_a_trained_checkpoint_goes_back_to_diffusers(kind, towers, tmp_path):
    pretrained = random_transformer(kind)
    pretrained.save_pretrained(tmp_path / "published" / "transformer", max_shard_size="40KB")
    (tmp_path / "published" / "model_index.json").write_text("{}")
    model, _ = load_cosmos3(tmp_path / "published", fps=16.0, changes={"towers": towers})
    for name, weight in model.named_parameters():
        if not name.startswith("time_embedder."):
            weight.mul_(1.5)
    save = partial(save_checkpoint, model=model, action_contract=None, dtype=torch.float32)
    save(tmp_path / "trained", kind="stage1")
    output = write_cosmos3(tmp_path / "trained", tmp_path / "published", tmp_path / "back")
    theirs = transformer_class().from_pretrained(output / "transformer").eval()
    untouched = ["lm_head.weight", *(["embed_tokens.weight"] if towers == "generation" else [])]
    assert all(torch.equal(theirs.get_parameter(name), pretrained.get_parameter(name)) for name in untouched)
    moved = "layers.1.mlp_moe_gen.up_proj.weight"
    assert torch.equal(theirs.get_parameter(moved), 1.5 * pretrained.get_parameter(moved))
    if towers == "both":
        latents, text = torch.randn(1, 6, 4, 4, 6, generator=torch.Generator().manual_seed(1)), [3, 1, 4]
        given = {"text": model.encode_text(torch.tensor([text])), "views": ("head",), "fps": torch.tensor([16.0])}
        ours = model(latents[:, None], torch.tensor([0.9]), **given).velocity[:, 0]
        torch.testing.assert_close(ours, reference_velocity(theirs, latents, 0.9, text, fps=16.0), rtol=1e-5, atol=1e-5)
    sealed = json.loads((output / "worldline" / "checkpoint.json").read_text())
    assert sealed["weights_sha256"] and {"model_index.json", "worldline/model.safetensors"} <= set(sealed["files"])
    with pytest.raises(ArtifactError, match="exists"):
        write_cosmos3(tmp_path / "trained", tmp_path / "published", output)
    random_transformer("edge" if kind == "nano" else "nano").save_pretrained(tmp_path / "other")
    with pytest.raises(CheckpointError, match="feed_forward"):
        write_cosmos3(tmp_path / "trained", tmp_path / "other", tmp_path / "no")


@torch.no_grad()
def test_clips_of_two_rates_in_one_batch_stand_where_diffusers_puts_each(diffusers_model, tmp_path):
    """Cosmos3's fps modulation: a latent frame advances by 24 / fps; a stride of three shows 30 fps as 10."""
    diffusers_model.save_pretrained(tmp_path)
    model, _ = load_cosmos3(tmp_path, fps=30.0)
    latents = torch.randn(2, 6, 5, 4, 6, generator=torch.Generator().manual_seed(5))
    text = [3, 1, 4, 1, 5, 9, 2]
    rates = (24.0, 30.0 / 3)
    context = model.encode_text(torch.tensor([text, text]))
    given = (latents[:, None], torch.tensor([0.7, 0.7]))
    ours = model(*given, text=context, views=("head",), fps=torch.tensor(rates)).velocity[:, 0]
    expected = [reference_velocity(diffusers_model, latents[i : i + 1], 0.7, text, rates[i]) for i in range(2)]
    torch.testing.assert_close(ours, torch.cat(expected), rtol=1e-5, atol=1e-5)
    at_config_rate = model(*given, text=context, views=("head",)).velocity[:, 0]
    assert bool((at_config_rate - ours).abs().amax(dim=(1, 2, 3, 4)).min() > 1e-3)


@pytest.mark.parametrize("kind", list(KINDS))
@torch.no_grad()
def test_the_generation_tower_alone_equals_both_without_text(kind, tmp_path):
    random_transformer(kind).save_pretrained(tmp_path)
    both, _ = load_cosmos3(tmp_path)
    alone, report = load_cosmos3(tmp_path, changes={"towers": "generation"})
    assert "embed_tokens.weight" in report.ignored
    latents = torch.randn(1, 3, 6, 2, 4, 6, generator=torch.Generator().manual_seed(5))
    sigma = torch.tensor([0.5])
    assert torch.equal(both(latents, sigma).velocity, alone(latents, sigma).velocity)


def test_a_missing_folder_and_damaged_folders_are_named(diffusers_model, tmp_path):
    with pytest.raises(UnavailableError, match="backbone's weights are not here"):
        load_cosmos3(tmp_path / "nothing")
    for size, damage, message in (
        ("40KB", Path.unlink, "A weight file is missing"),
        ("1GB", lambda path: path.write_bytes(path.read_bytes()[:100]), "damaged"),
    ):
        diffusers_model.save_pretrained(tmp_path / size, max_shard_size=size)
        damage(min((tmp_path / size).glob("*.safetensors")))
        with pytest.raises(CheckpointError, match=message):
            load_cosmos3(tmp_path / size)


FOREIGN = (
    ("hidden_act", "relu2"), ("hidden_act", "gelu"), ("attention_bias", True), ("_class_name", "WanTransformer3DModel"),
)  # fmt: skip


def test_another_architecture_is_refused(diffusers_model, tmp_path):
    diffusers_model.save_pretrained(tmp_path)
    path = tmp_path / "config.json"
    config = json.loads(path.read_text())
    for change, message in (
        *(({key: value}, "Not a Cosmos3 transformer") for key, value in FOREIGN),
        ({"num_hidden_layers": 2}, r"unexpected: layers\.2"),
    ):
        path.write_text(json.dumps(config | change))
        with pytest.raises(CheckpointError, match=message):
            load_cosmos3(tmp_path)


def test_weights_of_another_size_or_revision_are_refused(tmp_path):
    commit, other = "a" * 40, "b" * 40
    folder = tmp_path / "cache" / "snapshots" / commit
    random_transformer("nano").save_pretrained(folder)
    local = tmp_path / "local"
    random_transformer("edge").save_pretrained(local)
    for place, given, message in (
        (folder, {"size": "edge"}, r"Cosmos3-Nano(?s:.)*Cosmos3-Edge"), (folder, {"revision": other}, commit),
        (local, {"revision": other}, "does not say"),
    ):  # fmt: skip
        with pytest.raises(CheckpointError, match=message):
            load_cosmos3(place, **given)
    note = local / ".cache" / "huggingface" / "download" / "config.json.metadata"
    note.parent.mkdir(parents=True)
    note.write_text(f"{other}\netag\n1.0\n")
    load_cosmos3(local, size="edge", revision=other)
    load_cosmos3(folder, size="nano", revision=commit)


PUBLISHED_EDGE = {
    "hidden_act": "relu2", "hidden_size": 2048, "intermediate_size": 9216, "num_attention_heads": 16, "num_hidden_layers": 28,
    "num_key_value_heads": 8, "qk_norm_for_text": False, "use_und_k_norm_for_gen": True, "rms_norm_eps": 1e-5,
    "rope_theta": 1e8, "vocab_size": 131072, "rope_scaling": {"mrope_section": [24, 20, 20]},
    "temporal_compression_factor": 4, "backbone_type": "cosmos3_edge_nemotron_dense",
}  # fmt: skip
"""Fields of its transformer/config.json that are not the class's defaults, and two that it does not know."""


@pytest.mark.parametrize(
    ("size", "published", "generation", "both"),
    [("nano", {}, (6.9e9, 7.1e9), (14.5e9, 14.6e9)), ("edge", PUBLISHED_EDGE, (1.41e9, 1.42e9), (3.0e9, 3.1e9))],
)
def test_the_published_config_is_the_full_size(size, published, generation, both):
    parameters = inspect.signature(transformer_class().__init__).parameters.values()
    defaults = {parameter.name: parameter.default for parameter in parameters if parameter.name != "self"}
    config = config_from_diffusers(defaults | published, where="published", expected=size)
    assert config == cosmos3_config(size)
    for towers, (least, most) in (("generation", generation), ("both", both)):
        with torch.device("meta"):
            model = build_world_model(config.model_copy(update={"towers": towers}))
        assert least < sum(parameter.numel() for parameter in model.parameters()) < most
