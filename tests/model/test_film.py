"""Native control vectors by FiLM: no effect at the start, one modulation a latent frame, the same in all four passes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
import torch

from worldline_core.model.block_causal_attention import KVCache
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import CausalSpec

SIZE = 5
Build = Callable[..., WorldModel]


@pytest.fixture
def build(make_model: Build) -> Build:
    return partial(make_model, action_conditioning="vectors", native_size=SIZE)


def sample(frames: int = 3) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    latents = torch.randn(2, 3, 4, frames, 4, 6, generator=generator)
    vectors = torch.randn(2, 1, SIZE, frames, 1, 1, generator=generator).expand(2, 3, SIZE, frames, 1, 1)
    given = torch.cat((vectors, torch.ones_like(vectors[:, :, :1])), dim=2)
    return latents, given, torch.rand(2, generator=generator) * 0.8 + 0.1


def test_a_new_branch_changes_nothing_and_is_trainable(build: Build) -> None:
    model, (latents, vectors, sigma) = build(), sample()
    model.initialise(torch.Generator().manual_seed(0))
    model.proj_out.weight.data.normal_(generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(
        model(latents, sigma, action_maps=vectors).velocity, model(latents, sigma).velocity, rtol=0, atol=0
    )
    model(latents, sigma, action_maps=vectors).velocity.square().mean().backward()
    assert all(layer.weight.grad.abs().max() > 0 for layer in model.action_film.proj)  # type: ignore[union-attr]


def test_every_layer_modulates_the_tokens_of_a_frame_by_its_own_vector(build: Build) -> None:
    """Written out for one layer: x -> x (1 + s) + b with (s, b) linear in SiLU(linear(vector)), frame by frame."""
    film = build().action_film
    tokens = torch.randn(2, 3 * 9, 24, generator=torch.Generator().manual_seed(3))
    _, given, _ = sample()
    found = film(tokens, given, 1)
    for frame in range(3):
        hidden = torch.nn.functional.silu(given[:, 0, :SIZE, frame, 0, 0] @ film.hidden.weight.T + film.hidden.bias)
        out = hidden @ film.proj[1].weight.T + film.proj[1].bias
        own = slice(frame * 9, (frame + 1) * 9)
        torch.testing.assert_close(found[:, own], tokens[:, own] * (1 + out[:, None, :24]) + out[:, None, 24:])


def test_vectors_matter_in_every_pass_and_the_passes_agree(build: Build, make_spec: Callable[..., CausalSpec]) -> None:
    model, (latents, vectors, sigma) = build(), sample(frames=5)
    assert not torch.allclose(
        model(latents, sigma, action_maps=vectors).velocity, model(latents, sigma, action_maps=vectors * 2).velocity
    )
    spec, blocks = make_spec(), torch.stack((sigma, sigma), dim=1)
    whole = model.forward_teacher_forcing(latents, latents, blocks, action_maps=vectors, spec=spec)
    cache = KVCache(spec.sink_blocks, spec.recent_blocks)
    model.write_block(latents[:, :, :, :1], cache, action_maps=vectors[:, :, :, :1])
    first = model.forward_block(latents[:, :, :, 1:3], sigma, cache, action_maps=vectors[:, :, :, 1:3])
    torch.testing.assert_close(first, whole[:, :, :, 1:3], atol=1e-4, rtol=1e-4)


def test_a_model_of_both_is_the_model_of_maps_where_maps_are_given(make_model: Build) -> None:
    """With the same weights, bit by bit; a view that takes the vector instead is another, and so are the views beside it."""
    torch.manual_seed(0)
    both = make_model(action_conditioning="either", native_size=SIZE, action_frames=4)
    alone = make_model(action_frames=4)
    alone.load_state_dict({name: value for name, value in both.state_dict().items() if "action_film" not in name})
    latents, _, sigma = sample()
    maps = torch.randn(2, 3, 4, 9, 3, 4, 6, generator=torch.Generator().manual_seed(2))
    controls = torch.cat((maps, torch.zeros(2, 3, 4, SIZE + 1, 3, 4, 6)), dim=3)
    found = both(latents, sigma, action_maps=controls.flatten(2, 3)).velocity
    assert torch.equal(found, alone(latents, sigma, action_maps=maps.flatten(2, 3)).velocity)
    controls[:, 1, :, :9], controls[:, 1, :, 9:] = 0, torch.arange(1.0, SIZE + 2)[:, None, None, None]
    other = both(latents, sigma, action_maps=controls.flatten(2, 3)).velocity
    assert all(not torch.allclose(found[:, view, :, 1:], other[:, view, :, 1:]) for view in range(3))
