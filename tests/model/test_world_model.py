"""The world model: agreement with diffusers, conditioning, action branch, view slots."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
import torch

from worldline_core.errors import ConfigError, DataError
from worldline_core.model.block_causal_attention import KVCache
from worldline_core.model.layers import video_positions, view_starts
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import cosmos3_config

VIEWS = ("head", "left_wrist", "right_wrist")


Build = Callable[..., WorldModel]


@pytest.fixture
def build(make_model: Build) -> Build:
    """Models with both towers."""
    return partial(make_model, towers="both", vocab_size=20)


def sample(batch: int = 2, frames: int = 3, seed: int = 1) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    latents = torch.randn(batch, 3, 4, frames, 4, 6, generator=generator)
    maps = torch.randn(batch, 3, 9, frames, 4, 6, generator=generator)
    sigma = torch.rand(batch, generator=generator) * 0.8 + 0.1
    return latents, maps, sigma


def test_velocity_is_zero_on_clean_frames_only(build: Build) -> None:
    latents, maps, sigma = sample()
    velocity = build()(latents, sigma, action_maps=maps).velocity
    assert velocity.shape == latents.shape
    assert bool((velocity[:, :, :, 0] == 0).all())
    assert bool((velocity[:, :, :, 1:].abs() > 0).any(dim=(1, 2, 4, 5)).all())


def test_sigma_is_not_read_on_clean_frames(build: Build) -> None:
    latents, _, sigma = sample()
    model = build()
    per_frame = sigma[:, None].repeat(1, 3)
    other = per_frame.clone()
    other[:, 0] = 0.777
    torch.testing.assert_close(model(latents, per_frame).velocity, model(latents, other).velocity, rtol=0, atol=0)
    torch.testing.assert_close(model(latents, per_frame).velocity, model(latents, sigma).velocity)
    other[:, 1] = 0.777
    assert not torch.allclose(model(latents, per_frame).velocity, model(latents, other).velocity)


def test_first_frame_residual_adds_the_clean_first_frame(build: Build) -> None:
    latents, _, sigma = sample()
    emitted = build(prediction="velocity")(latents, sigma).velocity + latents[:, :, :, :1]
    expected = (latents - emitted) / sigma.clamp_min(0.05).view(-1, 1, 1, 1, 1, 1)
    model = build(prediction="first_frame_residual")
    torch.testing.assert_close(model(latents, sigma).velocity[:, :, :, 1:], expected[:, :, :, 1:])
    with pytest.raises(ConfigError, match="holds no first frame"):
        model.forward_block(latents, sigma, KVCache(1, 3))


def test_zero_initialised_action_branch_leaves_the_function_unchanged_bit_for_bit_and_is_trainable(
    build: Build,
) -> None:
    latents, maps, sigma = sample()
    model = build()
    torch.nn.init.zeros_(model.action_encoder.proj.weight)
    torch.nn.init.zeros_(model.action_encoder.proj.bias)
    with torch.no_grad():
        assert torch.equal(model(latents, sigma, action_maps=maps).velocity, model(latents, sigma).velocity)
    model(latents, sigma, action_maps=maps).velocity.square().mean().backward()
    gradient = model.action_encoder.proj.weight.grad
    assert bool((gradient.abs().sum(dim=1) > 0).all())


def test_views_share_time_and_have_their_own_height_slots(build: Build) -> None:
    positions = video_positions(build().config, torch.arange(2), (2, 3), VIEWS).reshape(3, 2, 3, 2, 3)
    assert positions[0, 1].unique().tolist() == [1.0]
    assert positions[1, 0, :, 0, 0].tolist() == [0.0, 8.0, 20.0]
    assert positions[1, 0, 2, :, 1].tolist() == [20.0, 21.0]
    assert positions[2, 0, 1, 0].tolist() == [0.0, 1.0, 2.0]


def test_view_offsets_in_pixels_are_divided_by_the_pixels_of_a_patch() -> None:
    assert view_starts(cosmos3_config("nano"), VIEWS) == [0.0, 480.0, 992.0]
    assert view_starts(cosmos3_config("nano", view_offset_unit="pixel"), VIEWS) == [0.0, 15.0, 31.0]


def test_fps_modulation_stretches_time() -> None:
    positions = video_positions(
        cosmos3_config("nano", fps=12.0), torch.arange(3), (1, 1), ("head",), temporal_offset=5.0
    )
    assert positions[0].tolist() == [5.0, 7.0, 9.0]


def test_features_come_from_the_layer_asked_for(build: Build) -> None:
    latents, _, sigma = sample()
    model = build()
    features = model(latents, sigma, features_at=1).features
    assert features.shape == (2, 3, 3, 2, 3, 24)
    last = model(latents, sigma, features_at=2).features
    assert last is not None
    assert not torch.allclose(features, last)
    with pytest.raises(ConfigError, match="counts layers from 1"):
        model(latents, sigma, features_at=3)


def test_text_conditions_and_padding_changes_nothing(build: Build) -> None:
    latents, _, sigma = sample()
    model = build()
    ids = torch.tensor([[3, 4, 5], [6, 7, 0]])
    mask = torch.tensor([[1, 1, 1], [1, 1, 0]])
    both = model(latents, sigma, text=model.encode_text(ids, mask)).velocity
    alone = model(latents[1:], sigma[1:], text=model.encode_text(ids[1:, :2])).velocity
    torch.testing.assert_close(both[1:], alone, rtol=1e-4, atol=1e-5)
    assert not torch.allclose(both, model(latents, sigma).velocity, atol=1e-3)


def test_a_model_without_the_understanding_tower_refuses_text(build: Build) -> None:
    model = build(towers="generation")
    assert not any("to_q" in name or name.startswith("embed_tokens") for name, _ in model.named_parameters())
    with pytest.raises(ConfigError, match="no understanding tower"):
        model.encode_text(torch.ones(2, 3, dtype=torch.long))


def test_parameter_groups_cover_the_generation_tower(build: Build) -> None:
    model = build()
    generation = {name for name, _ in model.generation_parameters()}
    action = {name for name, _ in model.action_parameters()}
    alone = {name for name, _ in build(towers="generation").named_parameters()}
    assert generation | action == alone
    assert not generation & action
    assert "layers.0.self_attn.add_q_proj.weight" in generation
    assert "layers.0.self_attn.norm_added_q.weight" in generation


def test_a_fresh_model_starts_at_zero_velocity(build: Build) -> None:
    latents, maps, sigma = sample()
    model = WorldModel(build().config)
    model.initialise(torch.Generator().manual_seed(0))
    assert bool((model(latents, sigma, action_maps=maps).velocity == 0).all())
    copying = WorldModel(build(prediction="first_frame_residual").config)
    copying.initialise(torch.Generator().manual_seed(0))
    velocity = copying(latents, sigma, action_maps=maps).velocity[:, :, :, 1:]
    one_step = latents[:, :, :, 1:] - sigma.view(-1, 1, 1, 1, 1, 1) * velocity
    torch.testing.assert_close(one_step, latents[:, :, :, :1].expand_as(one_step))


@pytest.mark.usefixtures("unchecked_shapes")
def test_shapes_that_do_not_fit_are_refused(build: Build) -> None:
    latents, maps, sigma = sample()
    model = build()
    with pytest.raises(DataError, match="Latents have the wrong shape"):
        model(latents[:, :2], sigma)
    with pytest.raises(DataError, match="Controls have the wrong shape"):
        model(latents, sigma, action_maps=maps[:, :, :, :2])
    with pytest.raises(ConfigError, match="Unknown or repeated view"):
        model(latents, sigma, views=("head", "left_wrist", "tail"))
