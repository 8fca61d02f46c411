"""The world model: agreement with diffusers, conditioning, action branch, view slots; control vectors by FiLM."""

from functools import partial

import pytest
import torch

from worldline_core.data.episodes.episode import VIEWS
from worldline_core.errors import ConfigError, DataError
from worldline_core.model.block_causal_attention import KVCache
from worldline_core.model.layers import video_positions, view_starts
from worldline_core.model.networks import build_world_model
from worldline_core.model.world_model_config import cosmos3_config

SIZE = 5  # of a control vector
EXACT = {"rtol": 0, "atol": 0}


@pytest.fixture
def build(make_model):
    """Makes models with both towers."""
    return partial(make_model, towers="both", vocab_size=20)


def sample(frames=3, *, vectors=False):
    """Latents, maps (or vectors, and that they are given) and a noise level a clip."""
    generator = torch.Generator().manual_seed(1)
    latents = torch.randn(2, 3, 4, frames, 4, 6, generator=generator)
    if vectors:
        own = torch.randn(2, 1, SIZE, frames, 1, 1, generator=generator).expand(2, 3, SIZE, frames, 1, 1)
        controls = torch.cat((own, torch.ones_like(own[:, :, :1])), dim=2)
    else:
        controls = torch.randn(2, 3, 9, frames, 4, 6, generator=generator)
    return latents, controls, torch.rand(2, generator=generator) * 0.8 + 0.1


def test_velocity_is_zero_on_clean_frames_only_and_their_sigma_is_not_read(build):
    (latents, maps, sigma), model = sample(), build()
    velocity = model(latents, sigma, action_maps=maps).velocity
    assert velocity.shape == latents.shape
    assert bool((velocity[:, :, :, 0] == 0).all())
    assert bool((velocity[:, :, :, 1:].abs() > 0).any(dim=(1, 2, 4, 5)).all())
    per_frame = sigma[:, None].repeat(1, 3)
    other = per_frame.clone()
    other[:, 0] = 0.777
    found = model(latents, per_frame).velocity
    torch.testing.assert_close(found, model(latents, other).velocity, **EXACT)
    torch.testing.assert_close(found, model(latents, sigma).velocity)
    other[:, 1] = 0.777
    assert not torch.allclose(found, model(latents, other).velocity)


def test_first_frame_residual_adds_the_clean_first_frame(build):
    latents, _, sigma = sample()
    emitted = build(prediction="velocity")(latents, sigma).velocity + latents[:, :, :, :1]
    expected = (latents - emitted) / sigma.clamp_min(0.05).view(-1, 1, 1, 1, 1, 1)
    model = build(prediction="first_frame_residual")
    torch.testing.assert_close(model(latents, sigma).velocity[:, :, :, 1:], expected[:, :, :, 1:])
    with pytest.raises(ConfigError, match="holds no first frame"):
        model.forward_block(latents, sigma, KVCache(1, 3))


def test_zero_initialised_action_branch_leaves_the_function_unchanged_bit_for_bit_and_is_trainable(build):
    (latents, maps, sigma), model = sample(), build()
    for value in (model.action_encoder.proj.weight, model.action_encoder.proj.bias):
        torch.nn.init.zeros_(value)
    driven = model(latents, sigma, action_maps=maps).velocity
    assert torch.equal(driven, model(latents, sigma).velocity)
    driven.square().mean().backward()
    assert bool((model.action_encoder.proj.weight.grad.abs().sum(dim=1) > 0).all())


def test_views_share_time_and_have_their_own_height_slots(build):
    positions = video_positions(build().config, torch.arange(2), (2, 3), VIEWS).reshape(3, 2, 3, 2, 3)
    assert positions[0, 1].unique().tolist() == [1.0]
    assert positions[1, 0, :, 0, 0].tolist() == [0.0, 8.0, 20.0]
    assert positions[1, 0, 2, :, 1].tolist() == [20.0, 21.0]
    assert positions[2, 0, 1, 0].tolist() == [0.0, 1.0, 2.0]
    # Offsets in pixels are divided by the pixels of a patch; a rate stretches time.
    assert view_starts(cosmos3_config("nano"), VIEWS) == [0.0, 480.0, 992.0]
    assert view_starts(cosmos3_config("nano", view_offset_unit="pixel"), VIEWS) == [0.0, 15.0, 31.0]
    slow = cosmos3_config("nano", fps=12.0)
    assert video_positions(slow, torch.arange(3), (1, 1), ("head",), temporal_offset=5.0)[0].tolist() == [5.0, 7.0, 9.0]


def test_features_come_from_the_layer_asked_for(build):
    (latents, _, sigma), model = sample(), build()
    features, last = (model(latents, sigma, features_at=layer).features for layer in (1, 2))
    assert features.shape == (2, 3, 3, 2, 3, 24)
    assert not torch.allclose(features, last)
    with pytest.raises(ConfigError, match="counts layers from 1"):
        model(latents, sigma, features_at=3)


def test_text_conditions_and_padding_changes_nothing(build):
    (latents, _, sigma), model = sample(), build()
    ids, mask = torch.tensor([[3, 4, 5], [6, 7, 0]]), torch.tensor([[1, 1, 1], [1, 1, 0]])
    both = model(latents, sigma, text=model.encode_text(ids, mask)).velocity
    alone = model(latents[1:], sigma[1:], text=model.encode_text(ids[1:, :2])).velocity
    torch.testing.assert_close(both[1:], alone, rtol=1e-4, atol=1e-5)
    assert not torch.allclose(both, model(latents, sigma).velocity, atol=1e-3)
    with pytest.raises(ConfigError, match="no understanding tower"):
        build(towers="generation").encode_text(ids)


@pytest.mark.parametrize("prediction", ["velocity", "first_frame_residual"])
def test_a_fresh_model_stands_still_or_copies_the_first_frame(build, prediction):
    latents, maps, sigma = sample()
    model = build_world_model(build(prediction=prediction).config)
    model.initialise(torch.Generator().manual_seed(0))
    velocity = model(latents, sigma, action_maps=maps).velocity[:, :, :, 1:]
    if prediction == "velocity":
        assert not velocity.any()
    else:
        one_step = latents[:, :, :, 1:] - sigma.view(-1, 1, 1, 1, 1, 1) * velocity
        torch.testing.assert_close(one_step, latents[:, :, :, :1].expand_as(one_step))


@pytest.mark.usefixtures("unchecked_shapes")
def test_shapes_that_do_not_fit_are_refused(build):
    (latents, maps, sigma), model = sample(), build()
    for clip, given, error, message in (
        (latents[:, :2], {}, DataError, "Latents have the wrong shape"),
        (latents, {"action_maps": maps[:, :, :, :2]}, DataError, "Controls have the wrong shape"),
        (latents, {"views": ("head", "left_wrist", "tail")}, ConfigError, "Unknown or repeated view"),
    ):
        with pytest.raises(error, match=message):
            model(clip, sigma, **given)


@pytest.fixture(params=["mixture", "wan"])
def film(request, make_model):
    return make_model(network=request.param, action_conditioning="vectors", native_size=SIZE)


def test_a_new_branch_of_vectors_changes_nothing_and_is_trainable(film):
    latents, vectors, sigma = sample(vectors=True)
    film.initialise(torch.Generator().manual_seed(0))
    film.proj_out.weight.data.normal_(generator=torch.Generator().manual_seed(1))
    driven = film(latents, sigma, action_maps=vectors).velocity
    torch.testing.assert_close(driven, film(latents, sigma).velocity, **EXACT)
    driven.square().mean().backward()
    assert all(layer.weight.grad.abs().max() > 0 for layer in film.action_film.proj)


def test_every_layer_modulates_the_tokens_of_a_frame_by_its_own_vector(film):
    """Written out for one layer: x -> x (1 + s) + b with (s, b) linear in SiLU(linear(vector)), frame by frame."""
    film, (_, given, _) = film.action_film, sample(vectors=True)
    tokens = torch.randn(2, 3 * 9, 24, generator=torch.Generator().manual_seed(3))
    found = film(tokens, given, 1)
    for frame in range(3):
        hidden = torch.nn.functional.silu(given[:, 0, :SIZE, frame, 0, 0] @ film.hidden.weight.T + film.hidden.bias)
        out = hidden @ film.proj[1].weight.T + film.proj[1].bias
        own = slice(frame * 9, (frame + 1) * 9)
        torch.testing.assert_close(found[:, own], tokens[:, own] * (1 + out[:, None, :24]) + out[:, None, 24:])


def test_vectors_matter_in_every_pass_and_the_passes_agree(film, make_spec):
    latents, vectors, sigma = sample(frames=5, vectors=True)
    once, twice = (film(latents, sigma, action_maps=vectors * factor).velocity for factor in (1, 2))
    assert not torch.allclose(once, twice)
    spec, blocks = make_spec(), torch.stack((sigma, sigma), dim=1)
    whole = film.forward_teacher_forcing(latents, latents, blocks, action_maps=vectors, spec=spec)
    cache = KVCache(spec.sink_blocks, spec.recent_blocks)
    film.write_block(latents[:, :, :, :1], cache, action_maps=vectors[:, :, :, :1])
    first = film.forward_block(latents[:, :, :, 1:3], sigma, cache, action_maps=vectors[:, :, :, 1:3])
    torch.testing.assert_close(first, whole[:, :, :, 1:3], atol=1e-4, rtol=1e-4)


def test_a_model_of_both_is_the_model_of_maps_where_maps_are_given(make_model):
    """With the same weights, bit by bit; a view that takes the vector instead is another, and so are the views beside it."""
    torch.manual_seed(0)
    both, alone = (
        make_model(action_conditioning="either", native_size=SIZE, action_frames=4),
        make_model(action_frames=4),
    )
    alone.load_state_dict({name: value for name, value in both.state_dict().items() if "action_film" not in name})
    latents, _, sigma = sample()
    maps = torch.randn(2, 3, 4, 9, 3, 4, 6, generator=torch.Generator().manual_seed(2))
    controls = torch.cat((maps, torch.zeros(2, 3, 4, SIZE + 1, 3, 4, 6)), dim=3)
    found = both(latents, sigma, action_maps=controls.flatten(2, 3)).velocity
    assert torch.equal(found, alone(latents, sigma, action_maps=maps.flatten(2, 3)).velocity)
    controls[:, 1, :, :9], controls[:, 1, :, 9:] = 0, torch.arange(1.0, SIZE + 2)[:, None, None, None]
    other = both(latents, sigma, action_maps=controls.flatten(2, 3)).velocity
    assert all(not torch.allclose(found[:, view, :, 1:], other[:, view, :, 1:]) for view in range(3))
