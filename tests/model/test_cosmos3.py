"""Weights of diffusers' Cosmos3 transformer load as they are and give the same velocity."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.profiler import ProfilerActivity, profile

from tests.model.test_weight_memory import most_bytes  # pyright: ignore[reportMissingImports]
from worldline_core.errors import CheckpointError, UnavailableError
from worldline_core.model.checkpoint import fill, load_checkpoint
from worldline_core.model.cosmos3 import config_from_diffusers, import_backbone, read_cosmos3
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import ImportBackboneConfig


def load_cosmos3(folder: Path, **options: Any) -> tuple[WorldModel, dict[str, list[str]]]:
    model, tensors, report = read_cosmos3(folder, **options)
    fill(model, tensors, where=folder, dtype=torch.float32)
    return model, report


SHAPE: dict[str, Any] = {
    "head_dim": 12,
    "hidden_size": 24,
    "intermediate_size": 40,
    "latent_channel": 6,
    "num_attention_heads": 4,
    "num_hidden_layers": 3,
    "num_key_value_heads": 2,
    "patch_latent_dim": 24,
    "vocab_size": 32,
    "rope_axes_dim": (2, 2, 2),
}


@pytest.fixture(scope="module")
def diffusers_model() -> Any:
    from diffusers.models.transformers.transformer_cosmos3 import Cosmos3OmniTransformer

    torch.manual_seed(3)
    model = Cosmos3OmniTransformer(**SHAPE)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.normal_(0.0, 0.25)
    return model.eval()


def reference_velocity(
    model: torch.nn.Module, latents: torch.Tensor, sigma: float, text_ids: list[int], fps: float
) -> torch.Tensor:
    """Velocity through diffusers' own packing functions, first frame clean."""
    from diffusers.pipelines.cosmos.pipeline_cosmos3_omni import (
        get_3d_mrope_ids_text_tokens,
        get_3d_mrope_ids_vae_tokens,
    )

    _, _, frames, height, width = latents.shape
    rows, columns = height // 2, width // 2
    count, size = len(text_ids), frames * rows * columns
    text, offset = get_3d_mrope_ids_text_tokens(count, 0)
    video, _ = get_3d_mrope_ids_vae_tokens(frames, rows, columns, offset + 15000, fps=fps)
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


@torch.no_grad()
def test_diffusers_weights_give_the_same_velocity(diffusers_model: Any, tmp_path: Path) -> None:
    diffusers_model.save_pretrained(tmp_path / "transformer", max_shard_size="40KB")
    assert len(list((tmp_path / "transformer").glob("*.safetensors"))) > 1
    model, report = load_cosmos3(tmp_path, fps=16.0)
    assert report["ignored"] == ["lm_head.weight"]
    assert report["new"] == sorted(n for n, _ in model.named_parameters() if n.startswith("action_encoder."))
    latents = torch.randn(1, 6, 4, 4, 6, generator=torch.Generator().manual_seed(5))
    text = [3, 1, 4, 1, 5, 9, 2]
    for sigma in (0.9, 0.3):
        expected = reference_velocity(diffusers_model, latents, sigma, text, fps=16.0)
        ours = model(
            latents[:, None], torch.tensor([sigma]), text=model.encode_text(torch.tensor([text])), views=("head",)
        ).velocity[:, 0]
        torch.testing.assert_close(ours, expected, rtol=1e-5, atol=1e-5)
        assert expected[:, :, 1:].abs().mean() > 0.1


def test_the_import_holds_one_file_of_the_result(tmp_path: Path) -> None:
    """No model in float32 beside the weights, and the same bytes whatever was drawn before."""
    from diffusers.models.transformers.transformer_cosmos3 import Cosmos3OmniTransformer

    shape: dict[str, Any] = SHAPE | {"hidden_size": 256, "intermediate_size": 1024, "num_hidden_layers": 6}
    pretrained: Any = Cosmos3OmniTransformer(**shape)
    pretrained.to(torch.bfloat16)
    pretrained.save_pretrained(tmp_path / "pretrained")
    inputs = {"diffusers": tmp_path / "pretrained"}
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as recorded:
        counts = import_backbone(ImportBackboneConfig(dtype="bfloat16"), inputs, tmp_path / "base")
    stored = (tmp_path / "base" / "model.safetensors").stat().st_size
    assert counts["parameters"] == pytest.approx(stored / 2, rel=0.01)
    # The mapped file and its copy in the stored type; a model in float32 would be two more.
    assert most_bytes(recorded) < 2.2 * stored
    torch.rand(3)
    import_backbone(ImportBackboneConfig(dtype="bfloat16"), inputs, tmp_path / "again")
    assert (tmp_path / "again" / "model.safetensors").read_bytes() == (
        tmp_path / "base" / "model.safetensors"
    ).read_bytes()
    theirs, ours = dict(pretrained.named_parameters()), load_checkpoint(tmp_path / "base", dtype=torch.bfloat16)[0]
    same = {name for name, weight in ours.named_parameters() if name in theirs}
    assert len(same) > 80
    assert all(torch.equal(ours.get_parameter(name), theirs[name].to(ours.get_parameter(name))) for name in same)


@torch.no_grad()
def test_clips_of_two_rates_in_one_batch_stand_where_diffusers_puts_each(diffusers_model: Any, tmp_path: Path) -> None:
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


@torch.no_grad()
def test_the_generation_tower_alone_equals_both_without_text(diffusers_model: Any, tmp_path: Path) -> None:
    diffusers_model.save_pretrained(tmp_path)
    both, _ = load_cosmos3(tmp_path)
    alone, report = load_cosmos3(tmp_path, changes={"towers": "generation"})
    assert "embed_tokens.weight" in report["ignored"]
    latents = torch.randn(1, 3, 6, 2, 4, 6, generator=torch.Generator().manual_seed(5))
    sigma = torch.tensor([0.5])
    assert torch.equal(both(latents, sigma).velocity, alone(latents, sigma).velocity)


def test_a_missing_folder_and_damaged_folders_are_named(diffusers_model: Any, tmp_path: Path) -> None:
    with pytest.raises(UnavailableError, match="Cosmos3 weights are not here"):
        load_cosmos3(tmp_path / "nothing")
    diffusers_model.save_pretrained(tmp_path / "t", max_shard_size="40KB")
    shards = sorted((tmp_path / "t").glob("*.safetensors"))
    shards[0].unlink()
    with pytest.raises(CheckpointError, match="A weight file is missing"):
        load_cosmos3(tmp_path / "t")
    diffusers_model.save_pretrained(tmp_path / "u")
    path = tmp_path / "u" / "diffusion_pytorch_model.safetensors"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(CheckpointError, match="damaged"):
        load_cosmos3(tmp_path / "u")


def test_another_architecture_is_refused(diffusers_model: Any, tmp_path: Path) -> None:
    diffusers_model.save_pretrained(tmp_path)
    path = tmp_path / "config.json"
    config = json.loads(path.read_text())
    for key, value in (("hidden_act", "relu2"), ("attention_bias", True), ("_class_name", "WanTransformer3DModel")):
        path.write_text(json.dumps(config | {key: value}))
        with pytest.raises(CheckpointError, match="Not a Cosmos3 transformer"):
            load_cosmos3(tmp_path)
    path.write_text(json.dumps(config | {"num_hidden_layers": 2}))
    with pytest.raises(CheckpointError, match=r"unexpected: layers\.2"):
        load_cosmos3(tmp_path)


def test_the_published_config_is_the_full_size() -> None:
    from diffusers.models.transformers.transformer_cosmos3 import Cosmos3OmniTransformer

    defaults = {
        name: parameter.default
        for name, parameter in __import__("inspect").signature(Cosmos3OmniTransformer.__init__).parameters.items()
        if name != "self"
    }
    config = config_from_diffusers(defaults, where="defaults")
    with torch.device("meta"):
        model = WorldModel(config.model_copy(update={"towers": "generation"}))
    count = sum(parameter.numel() for parameter in model.parameters())
    assert 6.9e9 < count < 7.1e9
